"""RPC cameras in files: one reader for all formats, and which file belongs to which picture."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from toolkit.errors import DataError
from toolkit.geometry.rpc import Rpc
from toolkit.scene.raster_io import NITF_ENDINGS, RASTER_ENDINGS, open_raster
from toolkit.scene.rpc_fields import ViewFacts, facts, rpc_from_fields
from toolkit.scene.rpc_json import read_rpc_json
from toolkit.scene.rpc_text import read_geom, read_rpb, read_rpc_txt
from toolkit.scene.rpc_xml import dimap_tile_size, read_rpc_xml

# Names of metadata in pictures, the first that is there counts: NITF's extensions, and our own.
_ACQUIRED = ("ACQUISITION_TIME", "NITF_CSDIDA_TIME", "NITF_STDIDC_ACQUISITION_DATE")
_SUN_ELEVATION = ("SUN_ELEVATION", "NITF_CSEXRA_SUN_ELEVATION", "NITF_USE00A_SUN_EL")
_SUN_AZIMUTH = ("SUN_AZIMUTH", "NITF_CSEXRA_SUN_AZIMUTH", "NITF_USE00A_SUN_AZ")
# What only files with an RPC say; JSON and XML stand beside pictures for other reasons, too.
_MARKS = (b"RPC00B", b"Global_RFM", b"LINE_OFF", b"line_off", b"row_offset")
_LOOK_AT = 2**20


@dataclass(frozen=True, slots=True)
class RpcFile:
    """What a file told of a view.

    Attributes
    ----------
    path, kind:
        The file and the name of its format.
    rpc:
        The camera.
    width, height:
        Size in pixels of the picture that the RPC belongs to, or None where the file does not tell.
    acquired:
        When the picture was taken, UTC, or None.
    sun_elevation, sun_azimuth:
        Degrees above the horizon and clockwise from north, or None.
    """

    path: Path
    kind: str
    rpc: Rpc
    width: int | None = None
    height: int | None = None
    acquired: datetime | None = None
    sun_elevation: float | None = None
    sun_azimuth: float | None = None


def read_rpc(path: Path) -> RpcFile:
    """Read the RPC in a file, whatever its format.

    - ``.tif``, ``.tiff``, ``.ntf``, ``.nitf``: the tags of a GeoTIFF (RPCCoefficientTag) or NITF (RPC00B, RPC00A);
      files beside it are not looked at (:func:`picture_rpc` does).
    - ``.rpb``: DigitalGlobe, with the ``.IMD`` beside it.
    - ``.xml``: DIMAP 1 and 2, with the ``DIM_`` file beside an ``RPC_`` file, and DigitalGlobe's XML.
    - ``.geom``: the Orfeo ToolBox.
    - ``.json``: by the names of GDAL, rasterio or Sat-NeRF.
    - all others: text with a line ``LINE_OFF: ...`` for each number (``_RPC.TXT``, ``.rpc``).

    All formats are brought to RPC00B's pixels, where (0, 0) is the centre of the top-left one.

    Raises
    ------
    DataError
        Where the file is missing, cut off or damaged, has no RPC, or its numbers are none; the message names the
        file and the number.
    MissingDependencyError
        For a picture where rasterio is not installed.
    """
    ending = path.suffix.lower()
    kind = _KINDS.get(ending, "RPC text")
    if ending in RASTER_ENDINGS:
        found = _tags(path)
        if found is None:
            raise DataError(
                f"Picture {path} has no RPC in its tags",
                expected="a GeoTIFF or NITF with an RPC",
                todo="Read the file with the RPC that came with it",
            )
        return found
    if ending == ".xml":
        rpc, told, kind = read_rpc_xml(path)
    elif ending == ".rpb":
        rpc, told = read_rpb(path)
    elif ending == ".geom":
        rpc, told = read_geom(path)
    elif ending == ".json":
        rpc, told = read_rpc_json(path)
    else:
        rpc, told = read_rpc_txt(path)
    return _rpc_file(path, kind, rpc, told)


_KINDS = {".rpb": "RPB", ".geom": "OTB geometry", ".json": "JSON"}


def _rpc_file(path: Path, kind: str, rpc: Rpc, told: ViewFacts) -> RpcFile:
    return RpcFile(path, kind, rpc, told.width, told.height, told.acquired, told.sun_elevation, told.sun_azimuth)


def _tags(path: Path) -> RpcFile | None:
    """Return the RPC in a picture's tags, None where it has none."""
    with open_raster(path) as dataset:
        fields, tags = dataset.tags(ns="RPC"), dataset.tags()
        kind = "GeoTIFF tags" if dataset.driver == "GTiff" else dataset.driver
        width, height = dataset.width, dataset.height
    if not fields:
        return None
    told = facts(
        str(path),
        width=width,
        height=height,
        acquired=_first(tags, _ACQUIRED),
        sun_elevation=_first(tags, _SUN_ELEVATION),
        sun_azimuth=_first(tags, _SUN_AZIMUTH),
    )
    return _rpc_file(path, kind, rpc_from_fields(fields, str(path)), told)


def _first(tags: Mapping[str, Any], names: Iterable[str]) -> Any:
    return next((tags[name] for name in names if tags.get(name)), None)


def tags_from_facts(told: RpcFile) -> dict[str, str]:
    """Return sun and time of a view as the tags of a GeoTIFF, from which they are read back."""
    tags = {
        _ACQUIRED[0]: None if told.acquired is None else told.acquired.isoformat(),
        _SUN_ELEVATION[0]: told.sun_elevation,
        _SUN_AZIMUTH[0]: told.sun_azimuth,
    }
    return {name: str(value) for name, value in tags.items() if value is not None}


def by_name(files: Iterable[Path]) -> dict[str, Path]:
    """Return files by their names in small letters, the first one of each name."""
    named: dict[str, Path] = {}
    for path in files:
        named.setdefault(path.name.lower(), path)
    return named


def side_file(picture: Path, among: Mapping[str, Path] | None = None) -> Path | None:
    """Return the file with the RPC that belongs to a picture by its name, None where there is none.

    For ``IMG_a_R1C1.TIF`` these are, the first that is there: ``IMG_a_R1C1`` with ``.RPB``, ``_RPC.TXT``, ``.RPC``,
    ``.GEOM``, ``.XML``, ``_RPC.JSON`` or ``.JSON``, and ``RPC_a_R1C1.XML`` or ``RPC_a.XML``, in letters of either
    case. ``.XML`` and ``.JSON`` count where they hold an RPC.

    Parameters
    ----------
    picture:
        Its path.
    among:
        The files to choose from (:func:`by_name`); by default those in the picture's folder.
    """
    if among is None:
        among = by_name(sorted(picture.parent.iterdir()) if picture.parent.is_dir() else ())
    for name in side_names(picture.name):
        found = among.get(name)
        if found is not None and found.is_file() and (not name.endswith((".xml", ".json")) or _marked(found)):
            return found
    return None


def side_names(picture: str) -> tuple[str, ...]:
    """Return the names, in small letters, of files in which the RPC of a picture may be."""
    stem = Path(picture).stem.lower()
    endings = (".rpb", "_rpc.txt", ".rpc", ".geom", ".xml", "_rpc.json", ".json")
    dimap = stem.removeprefix("img_")
    whole = re.sub(r"_r\d+c\d+$", "", dimap)
    return (*(stem + ending for ending in endings), *dict.fromkeys(f"rpc_{name}.xml" for name in (dimap, whole)))


def has_rpc_names(names: Iterable[str]) -> bool:
    """Return whether, by their names alone, some file of a folder is a picture with an RPC in it or beside it.

    A ``.xml`` or ``.json`` of a picture's name says nothing without being opened.
    """
    lower = {name.lower() for name in names}
    pictures = [name for name in lower if name.endswith(RASTER_ENDINGS)]
    telling = (name for picture in pictures for name in side_names(picture) if not name.endswith((".json", ".xml")))
    dimap = any(name in lower for picture in pictures for name in side_names(picture) if name.startswith("rpc_"))
    return dimap or any(name.endswith(NITF_ENDINGS) for name in pictures) or any(name in lower for name in telling)


def _marked(path: Path) -> bool:
    """Return whether a file says somewhere that it holds an RPC."""
    last = b""
    with path.open("rb") as handle:
        while piece := handle.read(_LOOK_AT):
            if any(mark in last + piece for mark in _MARKS):
                return True
            last = piece[-max(map(len, _MARKS)) :]
    return False


def picture_rpc(picture: Path, beside: Path | None) -> RpcFile | None:
    """Return the RPC of a picture: that of a file that belongs to it, else that in its tags, None for neither.

    A file that tells of a larger picture belongs to the whole of which this one is a part: the RPC is
    shifted by the part's corner, which the picture's transform gives (1 and 1 pixel, no rotation, no map). For
    tiles of DIMAP (``_R2C1``) it is shifted by the tiles before, whose size stands in the ``DIM_`` file.

    Parameters
    ----------
    picture:
        GeoTIFF or NITF.
    beside:
        What :func:`side_file` finds, or any other file with its RPC; None for that in the tags.

    Raises
    ------
    DataError
        Where a file is damaged, or the file beside the picture belongs to one of another size, or the place of a
        tile is not known.
    """
    if beside is None:
        return _tags(picture)
    found = read_rpc(beside)
    with open_raster(picture) as dataset:
        size, transform, mapped = (dataset.width, dataset.height), dataset.transform, dataset.crs is not None
    tile = re.search(r"_R(\d+)C(\d+)$", picture.stem, re.IGNORECASE) if found.kind.startswith("DIMAP") else None
    if tile is not None:
        corner = _tile_corner(picture, beside, int(tile[1]), int(tile[2]))
    elif (found.width or size[0], found.height or size[1]) != size:
        left, top = corner = transform.c, transform.f
        shifted = (transform.a, transform.b, transform.d, transform.e) == (1, 0, 0, 1) and not mapped
        inside = 0 <= left <= (found.width or 0) - size[0] and 0 <= top <= (found.height or 0) - size[1]
        if not (shifted and inside and (left or top)):
            raise DataError(
                f"{beside} belongs to another picture than {picture}",
                expected=f"{size[0]}x{size[1]} pixels, or the place of this part in the whole as its transform",
                found=f"{found.width}x{found.height} pixels",
                todo="Cut pictures with crop_raster, which keeps their RPC",
            )
    else:
        corner = (0.0, 0.0)
    rpc = found.rpc.cropped(*corner) if any(corner) else found.rpc
    return dataclasses.replace(found, rpc=rpc, width=size[0], height=size[1])


def _tile_corner(picture: Path, beside: Path, row: int, column: int) -> tuple[float, float]:
    """Return where in the whole picture the top left corner of a tile lies; rows and columns count from 1."""
    if (row, column) == (1, 1):
        return 0.0, 0.0
    size = dimap_tile_size(beside)
    if size is None or row < 1 or column < 1:
        raise DataError(
            f"Picture {picture} is one tile of several, and its RPC that of the whole",
            expected="the size of tiles without overlap in the DIM_ file beside it",
            found=f"row {row}, column {column}, and no such size",
            todo="Put the DIM_ file beside it, or join the tiles to one picture (gdalbuildvrt, gdal_translate)",
        )
    return float((column - 1) * size[0]), float((row - 1) * size[1])
