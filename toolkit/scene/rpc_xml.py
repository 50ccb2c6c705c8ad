"""RPCs in XML: DIMAP (Pleiades, SPOT 6 and 7) and DigitalGlobe's ``isd``."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from toolkit.errors import DataError
from toolkit.geometry.rpc import Rpc
from toolkit.geometry.rpc_terms import TERMS
from toolkit.scene.rpc_fields import (
    AXES,
    POLYNOMIALS,
    ViewFacts,
    facts,
    number,
    pixels,
    read_bytes,
    rpc_from_fields,
)
from toolkit.scene.rpc_text import check_specification, digital_globe_fields

# DIMAP counts pixels from 1, RPC00B from 0.
_FIRST_PIXEL = 1.0


def read_rpc_xml(path: Path) -> tuple[Rpc, ViewFacts, str]:
    """Read an RPC from XML and return it, what else there is, and the name of the format.

    Of DIMAP's two models the inverse one leads from the ground to the picture, as RPC00B does; the direct one is
    not looked at. DIMAP counts pixels from (1, 1), which is taken off. Size, sun and time stand in the ``DIM_``
    file beside an ``RPC_`` file.

    Raises
    ------
    DataError
        Where the file is missing, no XML, uses entities, is of another kind or version, or its numbers are no
        RPC00B.
    """
    root = _parse(path)
    if root.tag == "isd":
        return *_digital_globe(root, str(path)), "DigitalGlobe XML"
    if root.find(".//Global_RFM") is None:
        raise DataError(
            f"{path} has no RPC",
            expected="DIMAP with a 'Global_RFM', or DigitalGlobe's 'isd'",
            found=f"XML of '{root.tag[:40]}'",
        )
    version = _version(root)
    if version == 1:
        return _dimap_one(root, str(path)), _dimap_facts(root, str(path)), "DIMAP 1"
    if version != 2:
        raise DataError(
            f"{path} is of a version of DIMAP that is not read",
            expected="version 1 or 2",
            found=f"version {version}" if version else "no version",
            todo="Convert the picture to a GeoTIFF with an RPC tag: later versions count pixels differently",
        )
    beside = _description(path)
    described = ViewFacts() if beside is None else _dimap_facts(_parse(beside), str(beside))
    return _dimap_two(root, str(path)), described, "DIMAP 2"


def dimap_tile_size(path: Path) -> tuple[int, int] | None:
    """Return width and height in pixels of the tiles of a picture, by the description beside its ``RPC_`` file.

    None where there is no description, or it tells of no regular tiles without overlap.

    Raises
    ------
    DataError
        Where the description is damaged.
    """
    beside = _description(path)
    tiling = None if beside is None else _parse(beside).find(".//Tile_Set/Regular_Tiling")
    size = None if tiling is None else tiling.find("NTILES_SIZE")
    if tiling is None or size is None:
        return None
    overlaps = [_text(tiling, f"OVERLAP_{side}") or "0" for side in ("COL", "ROW")]
    width = pixels(size.get("ncols"), f"ncols in {beside}")
    height = pixels(size.get("nrows"), f"nrows in {beside}")
    if width is None or height is None or any(number(text, f"OVERLAP in {beside}") for text in overlaps):
        return None
    return width, height


def _description(path: Path) -> Path | None:
    """Return the ``DIM_`` file that belongs to an ``RPC_`` file."""
    beside = path.with_name(re.sub(r"^RPC_", "DIM_", path.name))
    return beside if beside != path and beside.is_file() else None


def _parse(path: Path) -> Element:
    data = read_bytes(path)
    try:
        root: Element = fromstring(data, forbid_dtd=True)
    except DefusedXmlException as error:
        raise DataError(
            f"{path} declares entities, which no RPC needs", expected="plain XML", found=type(error).__name__
        ) from error
    except (ParseError, ValueError, LookupError) as error:
        raise DataError(f"{path} is cut off or no XML", found=str(error)) from error
    return root


def _text(root: Element, way: str) -> str | None:
    found = root.find(way)
    return None if found is None or found.text is None else found.text.strip()


def _version(root: Element) -> int | None:
    """Return the version of DIMAP: an attribute of the format, or of the profile in the first one."""
    for name in ("METADATA_FORMAT", "METADATA_PROFILE"):
        element = root.find(f"Metadata_Identification/{name}")
        match = re.match(r"(\d{1,4})(\.|$)", element.get("version", "")) if element is not None else None
        if match is not None:
            return int(match[1])
    return None


def _dimap_two(root: Element, where: str) -> Rpc:
    fields: dict[str, object] = {}
    for axis in AXES:
        for kind in ("OFF", "SCALE"):
            value = _text(root, f".//Global_RFM/RFM_Validity/{axis}_{kind}")
            if value is not None:
                fields[f"{axis}_{kind}"] = value
    for name in POLYNOMIALS:
        texts = [_text(root, f".//Global_RFM/Inverse_Model/{name}_{i}") for i in range(1, len(TERMS) + 1)]
        if any(text is not None for text in texts):
            fields[name] = [text for text in texts if text is not None]
    return rpc_from_fields(_counted_from_zero(fields, where), where)


def _dimap_one(root: Element, where: str) -> Rpc:
    fields: dict[str, object] = {}
    names = {"LINE": "Row", "SAMP": "Col", "LAT": "Lat", "LONG": "Lon", "HEIGHT": "Alt"}
    for axis, name in names.items():
        for kind, letter in (("SCALE", "A"), ("OFF", "B")):
            value = _text(root, f".//Global_RFM/RFM_Validity/{name}/{letter}")
            if value is not None:
                fields[f"{axis}_{kind}"] = value
    for axis, name in (("LINE", "F_ROW"), ("SAMP", "F_COL")):
        values = (_text(root, f".//Global_RFM/Inverse_Model/{name}") or "").split()
        fields[f"{axis}_NUM_COEFF"], fields[f"{axis}_DEN_COEFF"] = values[: len(TERMS)], values[len(TERMS) :]
    return rpc_from_fields(_counted_from_zero(fields, where), where)


def _counted_from_zero(fields: dict[str, object], where: str) -> dict[str, object]:
    for name in ("LINE_OFF", "SAMP_OFF"):
        if name in fields:
            fields[name] = number(fields[name], f"{name} in {where}") - _FIRST_PIXEL
    return fields


def _dimap_facts(root: Element, where: str) -> ViewFacts:
    source = ".//Strip_Source"
    day, hour = _text(root, f"{source}/IMAGING_DATE"), _text(root, f"{source}/IMAGING_TIME")
    # Three places a picture: at its first, middle and last line.
    suns = root.findall(".//Solar_Incidences")
    sun = suns[len(suns) // 2] if suns else Element("none")
    return facts(
        where,
        width=_text(root, "Raster_Data/Raster_Dimensions/NCOLS") or _text(root, "Raster_Dimensions/NCOLS"),
        height=_text(root, "Raster_Data/Raster_Dimensions/NROWS") or _text(root, "Raster_Dimensions/NROWS"),
        acquired=f"{day}T{hour}" if day and hour else None,
        sun_elevation=_text(sun, "SUN_ELEVATION"),
        sun_azimuth=_text(sun, "SUN_AZIMUTH"),
    )


def _digital_globe(root: Element, where: str) -> tuple[Rpc, ViewFacts]:
    check_specification(_text(root, "RPB/SPECID"), f"SPECID of {where}")

    def value(name: str) -> str | None:
        plain = _text(root, f"RPB/IMAGE/{name.upper()}")
        return plain if plain is not None else _text(root, f"RPB/IMAGE/{name.upper()}List/{name.upper()}")

    described = facts(
        where,
        width=_text(root, "IMD/NUMCOLUMNS"),
        height=_text(root, "IMD/NUMROWS"),
        acquired=_text(root, "IMD/IMAGE/FIRSTLINETIME") or _text(root, "IMD/IMAGE/TLCTIME"),
        sun_elevation=_text(root, "IMD/IMAGE/MEANSUNEL"),
        sun_azimuth=_text(root, "IMD/IMAGE/MEANSUNAZ"),
    )
    return rpc_from_fields(digital_globe_fields(value), where), described
