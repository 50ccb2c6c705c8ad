"""RPCs in text files: ``_RPC.TXT``, DigitalGlobe's ``.RPB`` and the Orfeo ToolBox's ``.geom``."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path

from toolkit.errors import DataError
from toolkit.geometry.rpc import Rpc
from toolkit.scene.rpc_fields import AXES, POLYNOMIALS, ViewFacts, facts, read_text, rpc_from_fields

_KEY = re.compile(r"[A-Za-z][\w.]*")
_NUMBERED = re.compile(r"((?:LINE|SAMP)_(?:NUM|DEN)_COEFF)_(\d{1,4})")

#: What DigitalGlobe calls the axes, in the files and, in capitals, in their XML.
DIGITAL_GLOBE = {"LINE": "line", "SAMP": "samp", "LAT": "lat", "LONG": "long", "HEIGHT": "height"}
_DIGITAL_GLOBE_POLYNOMIALS = ("lineNumCoef", "lineDenCoef", "sampNumCoef", "sampDenCoef")
_PLEIADES_GEOM = "ossimPleiadesDimapSupportData"


def digital_globe_fields(get: Callable[[str], object | None]) -> dict[str, object]:
    """Return the fields of GDAL's metadata out of DigitalGlobe's, which ``get`` gives by their name, or None."""
    pairs = [(f"{axis}_OFF", f"{name}Offset") for axis, name in DIGITAL_GLOBE.items()]
    pairs += [(f"{axis}_SCALE", f"{name}Scale") for axis, name in DIGITAL_GLOBE.items()]
    pairs += zip(POLYNOMIALS, _DIGITAL_GLOBE_POLYNOMIALS, strict=True)
    found = {name: get(theirs) for name, theirs in pairs}
    return {name: value for name, value in found.items() if value is not None}


def check_specification(value: object, where: str) -> None:
    """Refuse polynomials whose terms come in another order, as in RPC00A. Raises :class:`DataError`."""
    if value is not None and str(value).strip().strip('"').upper() not in ("RPC00B", "B"):
        raise DataError(
            f"{where} is no RPC00B",
            expected="terms in the order of RPC00B",
            found=repr(value)[:40],
            todo="Convert it to a GeoTIFF with an RPC tag",
        )


def read_rpc_txt(path: Path) -> tuple[Rpc, ViewFacts]:
    """Read a text file with a line ``LINE_OFF: +005124.00 pixels`` for each number (GeoEye, IKONOS, SkySat, GDAL).

    Raises
    ------
    DataError
        Where the file is missing, no such text, cut off, or its numbers are no RPC.
    """
    fields: dict[str, object] = {}
    lists: dict[str, dict[int, str]] = {}
    for key, value in _lines(path).items():
        name = key.upper()
        numbered = _NUMBERED.fullmatch(name)
        if numbered is None:
            fields[name] = _word(value)
        else:
            lists.setdefault(numbered[1], {})[int(numbered[2])] = _word(value)
    return rpc_from_fields(fields | _ordered(lists, 1), str(path)), ViewFacts()


def read_geom(path: Path) -> tuple[Rpc, ViewFacts]:
    """Read the keyword list that the Orfeo ToolBox writes beside a picture.

    Its pixels count from (0, 0) already. The size is that of the whole picture, also where the file lies beside a
    cut-out. For Pleiades, elevation and azimuth angle are those of the sun, first, middle and last line: the
    middle one is taken.

    Raises
    ------
    DataError
        Where the file is missing, no such list, cut off, or its numbers are no RPC00B.
    """
    lines = _lines(path)
    values = {key: _word(value) for key, value in lines.items()}
    if "polynomial_format" not in values or "type" not in values:
        raise DataError(
            f"{path} is cut off or no geometry of the Orfeo ToolBox",
            expected="the keys 'polynomial_format' and 'type'",
            found=", ".join(list(values)[:4]) or "none",
        )
    check_specification(values["polynomial_format"], f"polynomial_format of {path}")
    lists: dict[str, dict[int, str]] = {}
    for key, value in values.items():
        numbered = _NUMBERED.fullmatch(key.upper())
        if numbered is not None:
            lists.setdefault(numbered[1], {})[int(numbered[2])] = value
    scalars = {f"{axis}_{kind}": f"{axis}_{kind}".lower() for axis in AXES for kind in ("OFF", "SCALE")}
    fields = {name: values[key] for name, key in scalars.items() if key in values}
    pleiades = values.get("support_data.type") == _PLEIADES_GEOM
    read = facts(
        str(path),
        width=values.get("number_samples"),
        height=values.get("number_lines"),
        acquired=values.get("support_data.time_range_start") or values.get("support_data.image_date"),
        sun_elevation=_middle(lines, "support_data.elevation_angle") if pleiades else None,
        sun_azimuth=_middle(lines, "support_data.azimuth_angle") if pleiades else None,
    )
    return rpc_from_fields(fields | _ordered(lists, 0), str(path)), read


def read_rpb(path: Path) -> tuple[Rpc, ViewFacts]:
    """Read DigitalGlobe's ``.RPB``, with size, sun and time from the ``.IMD`` of the same name where there is one.

    Raises
    ------
    DataError
        Where a file is missing, no such text, cut off, or its numbers are no RPC00B.
    """
    values = _assignments(path)
    if values.get("END_GROUP") != "IMAGE":
        raise DataError(
            f"{path} is cut off or no .RPB file", expected="a group 'IMAGE' with its end", found="no end of it"
        )
    check_specification(values.get("specid"), f"SpecId of {path}")
    rpc = rpc_from_fields(digital_globe_fields(lambda name: _listed(values.get(name.lower()))), str(path))
    beside = next(
        (path.with_suffix(ending) for ending in (".IMD", ".imd") if path.with_suffix(ending).is_file()), None
    )
    return rpc, ViewFacts() if beside is None else _imd(beside)


def _imd(path: Path) -> ViewFacts:
    values = _assignments(path)
    return facts(
        str(path),
        width=values.get("numcolumns"),
        height=values.get("numrows"),
        acquired=values.get("firstlinetime") or values.get("tlctime"),
        sun_elevation=values.get("meansunel") or values.get("sunel"),
        sun_azimuth=values.get("meansunaz") or values.get("sunaz"),
    )


def _lines(path: Path) -> dict[str, str]:
    """Return what follows each ``key:``, in order."""
    text = read_text(path)
    if text and text[-1] not in "\r\n":
        # 1.234E-05 cut off after 1.234 is a number, too.
        raise DataError(
            f"{path} may be cut off",
            expected="a line break at the end of the last line",
            found=repr(text[-30:]),
            todo="Copy it again, or add the line break where the last number is whole",
        )
    found: dict[str, str] = {}
    for line in text.splitlines():
        key, colon, value = (part.strip() for part in line.partition(":"))
        if not (colon and _KEY.fullmatch(key)):
            continue
        if _word(found.setdefault(key, value)) != _word(value):
            raise DataError(f"{path} has '{key}' twice", found=f"{_word(found[key])} and {_word(value)}"[:80])
    return found


def _word(value: str) -> str:
    """Return the first word of a value: the unit, if any, stands behind it."""
    return value.split(maxsplit=1)[0] if value else ""


def _middle(lines: Mapping[str, str], key: str) -> str | None:
    """Return the middle one of three numbers in triple quotes, None where there are no such three."""
    value = lines.get(key, "")
    numbers = value.strip('"').split()
    return numbers[1] if value.startswith('"""') and value.endswith('"""') and len(numbers) == 3 else None


def _assignments(path: Path) -> dict[str, str]:
    """Return what follows each ``key =``: keys in small letters, but for ``END_GROUP``."""
    found: dict[str, str] = {}
    lines = iter(read_text(path).splitlines())
    for line in lines:
        key, equals, value = (part.strip() for part in line.partition("="))
        if not (equals and key):
            continue
        if value.startswith("("):
            # A list goes on up to its bracket, mostly over lines.
            rest = [value]
            while ")" not in rest[-1] and (more := next(lines, None)) is not None:
                rest.append(more)
            value = "".join(rest)
        found[key if key == "END_GROUP" else key.lower()] = value.rstrip("; \t").strip('"')
    return found


def _listed(value: str | None) -> object | None:
    if value is not None and value.startswith("("):
        return [item.strip() for item in value.strip("()").split(",")]
    return value


def _ordered(lists: Mapping[str, Mapping[int, str]], first: int) -> dict[str, object]:
    """Return lists in the order of their numbers, an empty one where these are not those from ``first`` on."""
    made: dict[str, object] = {}
    for name, values in lists.items():
        whole = sorted(values) == list(range(first, first + len(values)))
        made[name] = [values[i] for i in sorted(values)] if whole else []
    return made
