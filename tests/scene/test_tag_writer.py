"""Tags that are written are read again; what cannot be written is refused."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import ExifTags, Image

from toolkit.errors import DataError
from toolkit.geometry.attitude import Attitude
from toolkit.geometry.geodesy import enu_from_geodetic
from toolkit.scene.exif import PhotoTags, read_tags
from toolkit.scene.tag_writer import exif_block, xmp_packet

SIZE = (40, 30)

angles = st.floats(-360, 360)
attitudes = st.builds(Attitude, angles, angles, angles)
sigmas = st.floats(1e-6, 1000)
words = st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=1, max_size=12)
places = st.tuples(st.floats(-90, 90), st.floats(-180, 180), st.floats(-1000, 50_000)).filter(
    lambda place: max(map(abs, place[:2])) > 1e-9
)


def maybe(strategy: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    return st.one_of(st.none(), strategy)


tags_of_drones = st.builds(
    PhotoTags,
    camera=st.lists(words, max_size=3).map(" ".join),
    focal=maybe(st.floats(0.21, 1.79).map(lambda share: share * math.hypot(*SIZE))),
    position=maybe(places),
    above_ellipsoid=maybe(st.booleans()),
    position_sigma=maybe(st.tuples(sigmas, sigmas, sigmas)),
    relative_altitude=maybe(st.floats(-50_000, 50_000)),
    gimbal=maybe(attitudes),
    flight=maybe(attitudes),
    orientation=maybe(st.integers(1, 8)),
    time=maybe(st.floats(-2.2e9, 4.1e9)),  # years 1900 to 2099
)


def written(tags: PhotoTags, size: tuple[int, int] = SIZE) -> Image.Image:
    file = io.BytesIO()
    Image.new("RGB", size, (90, 120, 40)).save(file, "JPEG", exif=exif_block(tags, *size), xmp=xmp_packet(tags))
    return Image.open(io.BytesIO(file.getvalue()))


def round_trip(tags: PhotoTags, size: tuple[int, int] = SIZE) -> PhotoTags:
    with written(tags, size) as picture:
        return read_tags(picture)


def same_angles(got: Attitude | None, meant: Attitude | None) -> bool:
    if got is None or meant is None:
        return got is meant
    pairs = ((got.yaw, meant.yaw), (got.pitch, meant.pitch), (got.roll, meant.roll))
    return all(abs(a - b) < 1e-6 for a, b in pairs)


@settings(max_examples=300)
@given(tags_of_drones)
def test_what_is_written_is_read_again(tags: PhotoTags) -> None:
    got = round_trip(tags)
    assert got.doubts == ()
    assert got.camera == tags.camera
    assert got.orientation == tags.orientation
    assert got.focal == (None if tags.focal is None else pytest.approx(tags.focal, rel=1e-4))
    # Microseconds are written; float64 holds seconds since 1970 to a quarter of one.
    assert got.time == (None if tags.time is None else pytest.approx(tags.time, abs=1.5e-6, rel=0))
    below = tags.position is not None and tags.position[2] < 0
    assert got.above_ellipsoid is (False if tags.above_ellipsoid is None and below else tags.above_ellipsoid)
    if tags.position is None:
        assert got.position is None
    else:
        assert got.position is not None
        assert max(abs(enu_from_geodetic([got.position], tags.position)[0])) < 1e-3  # metres
    assert same_angles(got.gimbal, tags.gimbal)
    assert same_angles(got.flight, tags.flight)
    for found, meant in (
        (got.relative_altitude, tags.relative_altitude),
        (got.position_sigma, tags.position_sigma),
    ):
        assert found == (None if meant is None else pytest.approx(meant, abs=1e-4))


def test_nothing_known_writes_nothing() -> None:
    assert round_trip(PhotoTags()) == PhotoTags()


def test_the_tags_are_the_standards_and_djis() -> None:
    tags = PhotoTags(
        camera="DJI FC6310 S",
        focal=30.0,
        position=(-33.5, -70.75, 612.25),
        above_ellipsoid=True,
        position_sigma=(0.01, 0.02, 0.03),
        relative_altitude=59.5,
        gimbal=Attitude(12.5, -45.0, 0.5),
        flight=Attitude(-170.0, 1.0, -2.0),
        orientation=1,
        time=1780308000.25,
    )
    with written(tags) as picture:
        exif = picture.getexif()
        photo, gps = exif.get_ifd(ExifTags.IFD.Exif), exif.get_ifd(ExifTags.IFD.GPSInfo)
        packet = picture.info["xmp"].decode()
    assert (exif[0x010F], exif[0x0110], exif[0x0112]) == ("DJI", "FC6310 S", 1)
    assert (photo[0x9003], photo[0x9291], photo[0x9011]) == ("2026:06:01 10:00:00", "250000", "+00:00")
    assert float(photo[0x920A]) == pytest.approx(30 * 36 / 40)  # millimetres on full frame
    assert (gps[1], [float(part) for part in gps[2]]) == ("S", [33.0, 30.0, 0.0])
    assert (gps[3], [float(part) for part in gps[4]]) == ("W", [70.0, 45.0, 0.0])
    assert (gps[5], float(gps[6])) == (b"\x02", 612.25)  # EXIF 3.0: above the ellipsoid
    for text in (
        'AltitudeType="RtkAlt"',
        'AbsoluteAltitude="+612.2500"',
        'RelativeAltitude="+59.5000"',
        'GimbalYawDegree="+12.5000000"',
        'GimbalPitchDegree="-45.0000000"',
        'FlightYawDegree="-170.0000000"',
        'FlightRollDegree="-2.0000000"',
        'RtkFlag="50"',
        'RtkStdLon="0.010000"',
        'RtkStdLat="0.020000"',
        'RtkStdHgt="0.030000"',
    ):
        assert f"drone-dji:{text}" in packet


def test_colmap_reads_the_same(tmp_path: Path) -> None:
    tags = PhotoTags(camera="DJI FC6310", focal=44.5, position=(-33.512345, 151.212345, 612.25), orientation=6)
    with written(tags) as picture:
        data = picture.fp.getvalue()
    (tmp_path / "a.jpg").write_bytes(data)
    bitmap = pycolmap.Bitmap.read(str(tmp_path / "a.jpg"), True)
    assert bitmap is not None
    assert bitmap.exif_focal_length() == pytest.approx(44.5, rel=1e-4)
    assert bitmap.exif_latitude() == pytest.approx(-33.512345, abs=1e-8)
    assert bitmap.exif_longitude() == pytest.approx(151.212345, abs=1e-8)
    assert bitmap.exif_altitude() == pytest.approx(612.25)


@pytest.mark.parametrize(
    ("above_ellipsoid", "altitude", "reference"),
    [(None, 5.0, None), (None, -5.0, 1), (False, 5.0, 0), (False, -5.0, 1), (True, 5.0, 2), (True, -5.0, 3)],
)
def test_the_altitude_says_above_what_it_is(
    above_ellipsoid: bool | None, altitude: float, reference: int | None
) -> None:
    tags = PhotoTags(position=(48.0, 9.0, altitude), above_ellipsoid=above_ellipsoid)
    with written(tags) as picture:
        gps = picture.getexif().get_ifd(ExifTags.IFD.GPSInfo)
        assert gps.get(5) == (None if reference is None else bytes([reference]))
        assert read_tags(picture).position == pytest.approx((48.0, 9.0, altitude))


def test_seconds_are_never_sixty() -> None:
    latitude = 48 - 1e-13  # rounds up to the next degree
    with written(PhotoTags(position=(latitude, 9.0, 0.0))) as picture:
        assert [float(part) for part in picture.getexif().get_ifd(ExifTags.IFD.GPSInfo)[2]] == [48.0, 0.0, 0.0]


@pytest.mark.parametrize("share", [2.5, 5.0, 20.0])
def test_a_long_lens_is_written_in_whole_millimetres(share: float) -> None:
    focal = share * math.hypot(*SIZE)
    got = round_trip(PhotoTags(focal=focal))
    assert got.doubts == ()
    assert got.focal == pytest.approx(focal, abs=0.5 / math.hypot(36, 24) * math.hypot(*SIZE))


POSITIONED = PhotoTags(position=(48.0, 9.0, 600.0))


@pytest.mark.parametrize(
    ("tags", "message"),
    [
        (
            replace(POSITIONED, position=(91.0, 9.0, 0.0)),
            r"latitude cannot be written.*-90 to 90 degrees; found 91",
        ),
        (replace(POSITIONED, position=(48.0, -180.5, 0.0)), r"longitude .*-180 to 180 degrees; found -180\.5"),
        (replace(POSITIONED, position=(math.nan, 9.0, 0.0)), "latitude .*found nan"),
        (replace(POSITIONED, position=(48.0, math.inf, 0.0)), "longitude .*found inf"),
        (replace(POSITIONED, position=(48.0, 9.0, math.nan)), "altitude .*-1000 to 50000 m; found nan"),
        (replace(POSITIONED, position=(48.0, 9.0, 99_999.0)), "altitude .*found 99999"),
        (replace(POSITIONED, position=(0.0, 0.0, 5.0)), "position .*a place other than 0, 0"),
        (replace(POSITIONED, position=(1e-12, -1e-12, 5.0)), "position .*a place other than 0, 0"),
        (PhotoTags(focal=math.nan), "focal length .*found nan"),
        (PhotoTags(focal=0.0), "focal length .*10 to 1500 px for 40 x 30 px; found 0 px"),
        (PhotoTags(focal=0.15 * 50.0), r"focal length .*found 7\.5 px"),
        (PhotoTags(focal=2000.0), "focal length .*found 2000 px"),
        (PhotoTags(orientation=0), "orientation .*1 to 8; found 0"),
        (PhotoTags(orientation=9), "orientation .*found 9"),
        (PhotoTags(time=math.nan), "capture time .*years 1 to 9999; found nan"),
        (PhotoTags(time=1e300), r"capture time .*found 1e\+300"),
        (PhotoTags(time=-math.inf), "capture time .*found -inf"),
        (PhotoTags(camera="Caméra"), "camera .*printable ASCII characters; found 'Caméra'"),
        (PhotoTags(camera="A\0B"), "camera .*printable ASCII"),
        (PhotoTags(relative_altitude=math.nan), "relative altitude .*found nan"),
        (PhotoTags(relative_altitude=1e6), "relative altitude .*-50000 to 50000 m"),
        (PhotoTags(gimbal=Attitude(0.0, -361.0)), "pitch angle .*-360 to 360 degrees; found -361"),
        (PhotoTags(flight=Attitude(1e300, 0.0)), "yaw angle .*-360 to 360"),
        (
            PhotoTags(position_sigma=(1.0, 0.0, 1.0)),
            "standard deviation of the position .*1e-06 to 1000 m; found 0",
        ),
        (PhotoTags(position_sigma=(1.0, 1.0, -1.0)), "standard deviation .*found -1"),
        (PhotoTags(position_sigma=(math.nan, 1.0, 1.0)), "standard deviation .*found nan"),
    ],
)
def test_what_cannot_be_written_is_refused(tags: PhotoTags, message: str) -> None:
    with pytest.raises(DataError, match=message):
        written(tags)


def test_a_picture_without_pixels_is_refused() -> None:
    with pytest.raises(
        DataError, match="size of the picture .*at least 1 x 1 px; found 0 x 30.*Mend it, or leave it out"
    ):
        exif_block(PhotoTags(), 0, 30)
