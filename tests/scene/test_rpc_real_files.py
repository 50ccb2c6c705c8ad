"""RPC files of ten sensors, against GDAL, against each other and against the sun."""

from __future__ import annotations

import math
import shutil
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rpc_samples import apart, gdal_reads, write_picture

from toolkit.scene.rpc_fields import fields_from_rpc
from toolkit.scene.rpc_files import RpcFile, read_rpc

pytest.importorskip("rasterio", reason="rasterio is not installed: pip install 'sightline-toolkit[geo]'")
pytestmark = pytest.mark.real


def real_files(real_data: Path) -> list[Path]:
    folders = [real_data / name for name in ("sat_rpc_only", "sat_rpc_shareloc", "sat_pleiades_s2p")]
    endings = {".tif", ".ntf", ".xml", ".txt", ".json", ".geom", ".rpc", ".rpc_adj"}
    found = [path for folder in folders for path in sorted(folder.rglob("*")) if path.suffix.lower() in endings]
    return [
        path
        for path in found
        if path.name not in ("config.json", "expected_dsm.tif", "left_image.tif", "right_image.tif")
    ]


def test_every_real_file_is_read(real_data: Path) -> None:
    files = real_files(real_data)
    assert len(files) == 28
    for path in files:
        found = read_rpc(path)
        rpc = found.rpc
        # Projection and localisation undo each other, all over the picture.
        steps = np.stack(np.meshgrid(*[np.linspace(-0.9, 0.9, 5)] * 2), axis=-1).reshape(-1, 2)
        pixels = [rpc.sample_offset, rpc.line_offset] + steps * [rpc.sample_scale, rpc.line_scale]
        there = rpc.project(rpc.locate(pixels, rpc.height_offset))
        assert np.abs(there - pixels).max() < 1e-5, path


def test_gdal_reads_the_same_of_real_files(real_data: Path, tmp_path: Path) -> None:
    compared = 0
    for path in real_files(real_data):
        if path.suffix.lower() in (".tif", ".ntf"):
            judged = gdal_reads(path)
        elif path.suffix.lower() in (".txt", ".rpc", ".rpc_adj", ".xml"):
            dimap_file = b"Dimap_Document" in path.read_bytes()[:4096]
            beside = "RPC_a.XML" if dimap_file else "a.XML" if path.suffix.lower() == ".xml" else "a_RPC.TXT"
            folder = tmp_path / f"{compared}"
            picture = write_picture(folder / ("IMG_a_R1C1.TIF" if dimap_file else "a.TIF"))
            shutil.copyfile(path, folder / beside)
            judged = gdal_reads(picture)
        else:
            continue
        compared += 1
        # Offsets of up to 67,000 pixels with 15 digits.
        assert apart(read_rpc(path).rpc, judged) < 1e-8, path
    assert compared == 22


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (
            "PHR1B_P_201709281038045_SEN_PRG_FC_178608-001.geom",
            "RPC_PHR1B_P_201709281038045_SEN_PRG_FC_178608-001.XML",
        ),
        (
            "PHR1B_P_201709281038393_SEN_PRG_FC_178609-001.geom",
            "RPC_PHR1B_P_201709281038393_SEN_PRG_FC_178609-001.XML",
        ),
        ("phr_ventoux/left_image.geom", "phr_ventoux/RPC_PHR1B_P_201308051042194_SEN_690908101-001.XML"),
    ],
)
def test_two_formats_of_one_picture_agree(real_data: Path, one: str, other: str) -> None:
    folder = real_data / "sat_rpc_shareloc" / "rpc"
    # Both have 15 digits or more; a pixel that counts from 1 would be 1 px, the direct model kilometres.
    assert apart(read_rpc(folder / one).rpc, read_rpc(folder / other).rpc) < 1e-7


def sun_of(when: datetime, latitude: float, longitude: float) -> tuple[float, float]:
    """Return elevation and azimuth by the low-precision formulas of the Astronomical Almanac (0.01 degrees)."""
    days = (when - datetime(2000, 1, 1, 12, tzinfo=UTC)).total_seconds() / 86400
    mean, anomaly = 280.460 + 0.9856474 * days, math.radians(357.528 + 0.9856003 * days)
    along = math.radians(mean + 1.915 * math.sin(anomaly) + 0.020 * math.sin(2 * anomaly))
    tilt = math.radians(23.439 - 4e-7 * days)
    ascension = math.degrees(math.atan2(math.cos(tilt) * math.sin(along), math.cos(along)))
    declination = math.asin(math.sin(tilt) * math.sin(along))
    hour = math.radians(15 * (18.697374558 + 24.06570982441908 * days) + longitude - ascension)
    phi = math.radians(latitude)
    up = math.sin(phi) * math.sin(declination) + math.cos(phi) * math.cos(declination) * math.cos(hour)
    east = -math.cos(declination) * math.sin(hour)
    north = math.cos(phi) * math.sin(declination) - math.sin(phi) * math.cos(declination) * math.cos(hour)
    return math.degrees(math.asin(up)), math.degrees(math.atan2(east, north)) % 360


def test_the_sun_stood_where_the_files_say(real_data: Path) -> None:
    known: list[RpcFile] = [
        found for found in map(read_rpc, real_files(real_data)) if found.sun_elevation is not None
    ]
    assert {found.kind for found in known} == {"JSON", "DigitalGlobe XML", "OTB geometry"}
    for found in known:
        assert found.acquired is not None
        elevation, azimuth = sun_of(found.acquired, found.rpc.latitude_offset, found.rpc.longitude_offset)
        # The files give it for the middle of a picture, some with the azimuth off by half a degree.
        assert found.sun_elevation == pytest.approx(elevation, abs=0.3), found.path
        assert found.sun_azimuth == pytest.approx(azimuth, abs=1.0), found.path


def test_two_tiles_of_one_view_in_two_styles_of_json_agree(real_data: Path) -> None:
    folder = real_data / "sat_rpc_only"
    tile = read_rpc(folder / "jax_068_001_rpc_gdal.json").rpc
    other = read_rpc(folder / "rpcm_samples" / "JAX_068_001_RGB.json").rpc
    pixels = np.array([[0.5, 0.5], [745.5, 0.5], [0.5, 814.5], [400.0, 400.0]])
    # Two cut-outs of one picture: a shift, but for the fit that one of the two RPCs went through.
    shift = np.concatenate([tile.project(other.locate(pixels, height)) - pixels for height in (-20.0, 30.0)])
    assert np.ptp(shift, axis=0).max() < 0.05
    assert np.all(np.abs(shift.mean(axis=0) - [632.3, 612.0]) < 0.1)


def test_tags_are_those_that_the_file_holds(real_data: Path) -> None:
    """GeoTIFF's RPCCoefficientTag has 92 numbers: two errors, ten offsets and scales, four polynomials."""
    for path in sorted((real_data / "sat_pleiades_s2p" / "triplet").glob("img_*.tif")):
        with Image.open(path) as picture:
            numbers = picture.tag_v2[50844]
        fields = fields_from_rpc(read_rpc(path).rpc)
        names = [
            f"{axis}_{kind}" for kind in ("OFF", "SCALE") for axis in ("LINE", "SAMP", "LAT", "LONG", "HEIGHT")
        ]
        names += ["LINE_NUM_COEFF", "LINE_DEN_COEFF", "SAMP_NUM_COEFF", "SAMP_DEN_COEFF"]
        mine = [float(word) for name in names for word in fields[name].split()]
        # GDAL hands them on with 15 digits.
        np.testing.assert_allclose(mine, numbers[2:], rtol=1e-14, atol=0)
