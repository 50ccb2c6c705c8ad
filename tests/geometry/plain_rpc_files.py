"""Plain readers of RPCs in JSON and text, for tests of the camera alone."""

from __future__ import annotations

import json
from pathlib import Path

from toolkit.geometry.rpc import Rpc


def real_rpcs(data: Path) -> dict[str, Rpc]:
    """Return the RPCs in JSON and text under ``sat_rpc_only`` by file name."""
    files = sorted((data / "sat_rpc_only").rglob("*"))
    found = {path.name: rpc_of_json(path) for path in files if path.suffix == ".json"}
    texts = (".txt", ".rpc", ".rpc_adj")
    return found | {path.name: rpc_of_text(path) for path in files if path.suffix.lower() in texts}


def rpc_of_json(path: Path) -> Rpc:
    table = json.loads(path.read_text())["rpc"]
    if "LINE_OFF" in table:
        axes = {"line": "LINE", "sample": "SAMP", "latitude": "LAT", "longitude": "LONG", "height": "HEIGHT"}
        ends = {"num": "NUM_COEFF", "den": "DEN_COEFF", "offset": "OFF", "scale": "SCALE"}
    else:
        axes = {"line": "row", "sample": "col", "latitude": "lat", "longitude": "lon", "height": "alt"}
        ends = {"num": "num", "den": "den", "offset": "offset", "scale": "scale"}
    wanted = [f"{axis}_{end}" for axis in axes for end in ("offset", "scale")]
    wanted += ["line_num", "line_den", "sample_num", "sample_den"]
    return Rpc(
        **{name: table["{}_{}".format(axes[(pair := name.split("_"))[0]], ends[pair[1]])] for name in wanted}
    )


def rpc_of_text(path: Path) -> Rpc:
    table = {key.strip(): float(value.split()[0]) for key, value in _pairs(path)}
    pairs = {"line": "LINE", "sample": "SAMP", "latitude": "LAT", "longitude": "LONG", "height": "HEIGHT"}
    scalars = {
        f"{ours}_{end}": table[f"{theirs}_{short}"]
        for ours, theirs in pairs.items()
        for end, short in (("offset", "OFF"), ("scale", "SCALE"))
    }
    polynomials = {
        f"{ours}_{part}": tuple(table[f"{theirs}_{part.upper()}_COEFF_{i}"] for i in range(1, 21))
        for ours, theirs in (("line", "LINE"), ("sample", "SAMP"))
        for part in ("num", "den")
    }
    return Rpc(**scalars, **polynomials)


def _pairs(path: Path) -> list[tuple[str, str]]:
    parts = [line.partition(":") for line in path.read_text().splitlines()]
    return [(key, value) for key, colon, value in parts if colon and value.strip()]
