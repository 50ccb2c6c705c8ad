"""Plausible RPCs and the files that hold them, for the tests of their readers."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np

from toolkit.geometry.rpc import Rpc
from toolkit.scene.raster_io import write_raster
from toolkit.scene.rpc_fields import AXES, POLYNOMIALS, fields_from_rpc, rpc_from_fields

CORNERS = np.array([[0.5, 0.5], [399.5, 0.5], [0.5, 299.5], [200.25, 100.75]])


def sample_rpc(
    seed: int = 0, *, place: tuple[float, float] = (43.26, 5.44), lean: tuple[float, float] = (0.1, -0.05)
) -> Rpc:
    """Return the RPC of a picture of 400 x 300 pixels of about half a metre.

    Parameters
    ----------
    seed:
        Of the small higher terms.
    place:
        Latitude and longitude of its middle.
    lean:
        Half pictures by which its line and sample move over half the range of heights.
    """
    rng = np.random.default_rng(seed)
    polynomials = rng.normal(size=(4, 20)) * 1e-5
    polynomials[0, 1:4] += (0.02, -1.0, lean[0])
    polynomials[2, 1:4] += (1.0, 0.03, lean[1])
    polynomials[[1, 3], 0] = 1.0
    line_num, line_den, sample_num, sample_den = (tuple(row) for row in polynomials.tolist())
    return Rpc(
        line_num=line_num,
        line_den=line_den,
        sample_num=sample_num,
        sample_den=sample_den,
        line_offset=149.5,
        line_scale=150.0,
        sample_offset=199.5,
        sample_scale=200.0,
        latitude_offset=place[0],
        latitude_scale=0.000675,
        longitude_offset=place[1],
        longitude_scale=0.00123,
        height_offset=100.0,
        height_scale=250.0,
    )


def scalars(rpc: Rpc) -> dict[str, float]:
    """Return the ten offsets and scales by GDAL's names."""
    fields = fields_from_rpc(rpc)
    return {f"{axis}_{kind}": float(fields[f"{axis}_{kind}"]) for kind in ("OFF", "SCALE") for axis in AXES}


def coefficients(rpc: Rpc) -> dict[str, list[float]]:
    """Return the four polynomials by GDAL's names."""
    fields = fields_from_rpc(rpc)
    return {name: [float(word) for word in fields[name].split()] for name in POLYNOMIALS}


def rpc_txt(rpc: Rpc) -> str:
    lines = [f"{name}: {value!r} pixels" for name, value in scalars(rpc).items()]
    lines += [f"{name}_{i}: {v!r}" for name, values in coefficients(rpc).items() for i, v in enumerate(values, 1)]
    return "\r\n".join(lines) + "\r\n"


def rpb(rpc: Rpc) -> str:
    names = {"LINE": "line", "SAMP": "samp", "LAT": "lat", "LONG": "long", "HEIGHT": "height"}
    kinds = {"OFF": "Offset", "SCALE": "Scale"}
    lines = ['satId = "WV02";', 'bandId = "P";', 'SpecId = "RPC00B";', "BEGIN_GROUP = IMAGE", "\terrBias = 1.2;"]
    for name, value in scalars(rpc).items():
        axis, _, kind = name.partition("_")
        lines.append(f"\t{names[axis]}{kinds[kind]} = {value!r};")
    for name, values in coefficients(rpc).items():
        listed = ",\n".join(f"\t\t\t{value!r}" for value in values)
        axis, kind, _ = name.lower().split("_")
        lines.append(f"\t{axis}{kind.title()}Coef = (\n{listed});")
    return "\n".join([*lines, "END_GROUP = IMAGE", "END;"]) + "\n"


def geom(rpc: Rpc, *, width: int = 400, height: int = 300) -> str:
    lines = [f"{name.lower()}:  {value!r}" for name, value in scalars(rpc).items()]
    lines += [
        f"{k.lower()}_{i:02d}:  {v!r}" for k, values in coefficients(rpc).items() for i, v in enumerate(values)
    ]
    lines += [f"number_lines:  {height}", f"number_samples:  {width}", "polynomial_format:  B"]
    lines += [
        'support_data.azimuth_angle:  """149.1 149.0 148.9 """',
        'support_data.elevation_angle:  """59.7 59.8 59.9 """',
        "support_data.time_range_start:  2013-08-05T10:42:19.4970580Z",
        "support_data.type:  ossimPleiadesDimapSupportData",
    ]
    return "\n".join(sorted([*lines, "type:  ossimPleiadesModel"])) + "\n"


def dimap(rpc: Rpc, version: str = "2.15") -> str:
    """Return DIMAP 2 with pixels from 1; its direct model holds numbers that are not to be read."""
    numbers = scalars(rpc)
    # Added as text is what a reader takes off again to the bit: these offsets are halves.
    numbers |= {name: numbers[name] + 1 for name in ("LINE_OFF", "SAMP_OFF")}
    inverse = "".join(
        f"<{name}_{i}>{v!r}</{name}_{i}>"
        for name, values in coefficients(rpc).items()
        for i, v in enumerate(values, 1)
    )
    direct = "".join(f"<{name}_{i}>7.0</{name}_{i}>" for name in POLYNOMIALS for i in range(1, 21))
    validity = "".join(f"<{name}>{value!r}</{name}>" for name, value in numbers.items())
    return (
        '<?xml version="1.0" encoding="UTF-8" standalone="no"?>\n<Dimap_Document><Metadata_Identification>'
        f'<METADATA_FORMAT version="{version}">DIMAP</METADATA_FORMAT></Metadata_Identification>'
        "<Rational_Function_Model><Global_RFM>"
        f"<Direct_Model>{direct}</Direct_Model><Inverse_Model>{inverse}</Inverse_Model>"
        f"<RFM_Validity>{validity}</RFM_Validity></Global_RFM></Rational_Function_Model></Dimap_Document>\n"
    )


def dimap_one(rpc: Rpc) -> str:
    numbers, lists = scalars(rpc), coefficients(rpc)
    names = {"LONG": "Lon", "LAT": "Lat", "HEIGHT": "Alt", "SAMP": "Col", "LINE": "Row"}
    numbers |= {name: numbers[name] + 1 for name in ("LINE_OFF", "SAMP_OFF")}
    validity = "".join(
        f"<{name}><A>{numbers[axis + '_SCALE']!r}</A><B>{numbers[axis + '_OFF']!r}</B></{name}>"
        for axis, name in names.items()
    )
    column, row = (
        " ".join(map(repr, [*lists[f"{axis}_NUM_COEFF"], *lists[f"{axis}_DEN_COEFF"]])) for axis in ("SAMP", "LINE")
    )
    return (
        '<PHR_Dimap_Document><Metadata_Identification><METADATA_PROFILE version="1.4">PHR</METADATA_PROFILE>'
        "<METADATA_FORMAT>DIMAP_PHR</METADATA_FORMAT></Metadata_Identification>"
        "<Geoposition><Rational_Sensor_Model><Global_RFM><Direct_Model><F_LON>1 2</F_LON></Direct_Model>"
        f"<Inverse_Model><F_COL>{column}</F_COL><F_ROW>{row}</F_ROW></Inverse_Model>"
        f"<RFM_Validity>{validity}</RFM_Validity></Global_RFM></Rational_Sensor_Model></Geoposition>"
        "<Raster_Dimensions><NROWS>300</NROWS><NCOLS>400</NCOLS></Raster_Dimensions></PHR_Dimap_Document>\n"
    )


def digital_globe_xml(rpc: Rpc) -> str:
    names = {"OFF": "OFFSET", "SCALE": "SCALE"}
    tags = ""
    for name, value in scalars(rpc).items():
        axis, _, kind = name.partition("_")
        tags += f"<{axis}{names[kind]}>{value!r}</{axis}{names[kind]}>"
    for name, values in coefficients(rpc).items():
        tag = name.replace("_", "").removesuffix("F")
        tags += f"<{tag}List><{tag}>{' '.join(map(repr, values))} </{tag}></{tag}List>"
    return (
        '<?xml version="1.0" encoding="UTF-8" standalone="yes"?>\n'
        "<isd><IMD><NUMROWS>300</NUMROWS><NUMCOLUMNS>400</NUMCOLUMNS><IMAGE><SATID>WV02</SATID>"
        "<FIRSTLINETIME>2015-09-30T10:56:56.973685Z</FIRSTLINETIME>"
        "<MEANSUNAZ>162.1</MEANSUNAZ><MEANSUNEL>40.3</MEANSUNEL></IMAGE></IMD>"
        f"<RPB><SATID>WV02</SATID><SPECID>RPC00B</SPECID><IMAGE>{tags}</IMAGE></RPB></isd>\n"
    )


def gdal_json(rpc: Rpc) -> str:
    """Return numbers as text and lists with blanks, as ``gdalinfo -json`` does."""
    return json.dumps({"metadata": {"": {}, "RPC": fields_from_rpc(rpc)}})


def satnerf_json(rpc: Rpc) -> str:
    axes = {"LINE": "row", "SAMP": "col", "LAT": "lat", "LONG": "lon", "HEIGHT": "alt"}
    kinds = {"OFF": "offset", "SCALE": "scale"}
    table: dict[str, object] = {}
    for name, value in scalars(rpc).items():
        axis, _, kind = name.partition("_")
        table[f"{axes[axis]}_{kinds[kind]}"] = value
    for name, values in coefficients(rpc).items():
        axis, kind, _ = name.split("_")
        table[f"{axes[axis]}_{kind.lower()}"] = values
    told = {"width": 400, "height": 300, "sun_elevation": "+50.8", "sun_azimuth": "150.3"}
    return json.dumps({"img": "a.tif", **told, "acquisition_date": "20141005160138", "rpc": table})


#: Writer of each text format by the name of its file.
WRITERS = {
    "a_RPC.TXT": rpc_txt,
    "a.RPB": rpb,
    "a.geom": geom,
    "RPC_a.XML": dimap,
    "a.xml": digital_globe_xml,
    "DIM_a.XML": dimap_one,
    "a.json": satnerf_json,
    "a_rpc.json": gdal_json,
}


def write_picture(path: Path, rpc: Rpc | None = None, *, seed: int = 0, bands: int = 1) -> Path:
    """Write a picture of 400 x 300 pixels of 11 bits, with the RPC in its tags where one is given."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    write_raster(path, rng.integers(100, 1500, (bands, 300, 400)).astype(np.uint16), rpc=rpc)
    return path


RPC = sample_rpc(7)


def write(folder: Path, name: str, text: str | None = None) -> Path:
    path = folder / name
    path.write_bytes((WRITERS[name](RPC) if text is None else text).encode())
    return path


def gdal_reads(path: Path) -> Rpc:
    """Return the RPC that GDAL finds for a picture, in its tags or in what lies beside it."""
    import rasterio

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(path) as dataset:
            return rpc_from_fields(dataset.tags(ns="RPC"), f"GDAL's {path.name}")


def places(rpc: Rpc) -> np.ndarray:
    """Return a grid of places (N, 3) over the RPC's volume."""
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 4)] * 3), axis=-1).reshape(-1, 3)
    scale = [rpc.latitude_scale, rpc.longitude_scale, abs(rpc.height_scale)]
    return grid * scale + [rpc.latitude_offset, rpc.longitude_offset, rpc.height_offset]


def apart(one: Rpc, other: Rpc) -> float:
    """Return the largest distance in pixels between what two RPCs say."""
    return float(np.abs(one.project(places(one)) - other.project(places(one), extrapolate=True)).max())
