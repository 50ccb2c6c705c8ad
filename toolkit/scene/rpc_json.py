"""RPCs in JSON: the names of GDAL (``LINE_OFF``), of rasterio (``line_off``) and of Sat-NeRF (``row_offset``)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from toolkit.errors import DataError
from toolkit.files import read_json
from toolkit.geometry.rpc import Rpc
from toolkit.scene.rpc_fields import AXES, LARGEST, POLYNOMIALS, ViewFacts, facts, rpc_from_fields

_SHORT = {"LINE": "row", "SAMP": "col", "LAT": "lat", "LONG": "lon", "HEIGHT": "alt"}
_SHORT_POLYNOMIALS = ("row_num", "row_den", "col_num", "col_den")


def read_rpc_json(path: Path) -> tuple[Rpc, ViewFacts]:
    """Read an RPC from JSON.

    The table with it is the file itself, its ``rpc``, or ``metadata`` / ``RPC`` as ``gdalinfo -json`` writes it.
    Coefficients are lists of numbers or texts with blanks between them. Beside an ``rpc``, ``width``, ``height``,
    ``acquisition_date``, ``sun_elevation`` and ``sun_azimuth`` are read.

    Raises
    ------
    DataError
        Where the file is missing, no JSON, has no such table, or its numbers are no RPC.
    """
    if path.is_file() and path.stat().st_size > LARGEST:
        raise DataError(
            f"{path} is too large for a file with an RPC", expected=f"at most {LARGEST // 2**20} MiB of text"
        )
    record = read_json(path)
    table = rpc_table(record)
    if table is None:
        found = ", ".join(map(str, list(record)[:6])) if isinstance(record, dict) else type(record).__name__
        raise DataError(
            f"{path} has no RPC",
            expected="a table with 'LINE_OFF' or 'row_offset', or one named 'rpc'",
            found=found,
        )
    return rpc_from_fields(table, str(path)), _described(record, str(path))


def rpc_table(record: Any) -> dict[str, object] | None:
    """Return the fields of an RPC, by GDAL's names, out of a JSON file's content; None where it has none."""
    if not isinstance(record, Mapping):
        return None
    metadata = record.get("metadata")
    inner = metadata.get("RPC") if isinstance(metadata, Mapping) else None
    for table in (record, record.get("rpc"), record.get("RPC"), inner):
        if not isinstance(table, Mapping):
            continue
        upper = {str(key).upper(): value for key, value in table.items()}
        if "LINE_OFF" in upper:
            return upper
        if "row_offset" in table:
            return _long_names(table)
    return None


def _long_names(table: Mapping[str, object]) -> dict[str, object]:
    pairs = [(f"{axis}_OFF", f"{_SHORT[axis]}_offset") for axis in AXES]
    pairs += [(f"{axis}_SCALE", f"{_SHORT[axis]}_scale") for axis in AXES]
    pairs += zip(POLYNOMIALS, _SHORT_POLYNOMIALS, strict=True)
    return {name: table[theirs] for name, theirs in pairs if theirs in table}


def _described(record: Mapping[str, Any], where: str) -> ViewFacts:
    return facts(
        where,
        width=record.get("width"),
        height=record.get("height"),
        acquired=record.get("acquisition_date"),
        sun_elevation=record.get("sun_elevation"),
        sun_azimuth=record.get("sun_azimuth"),
    )
