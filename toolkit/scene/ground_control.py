"""Ground control points as OpenDroneMap's ``gcp_list.txt``.

Format: docs.opendronemap.org, "Ground control points": a coordinate system in the first line, then one line for
each observation. Empty lines and lines that begin with # are skipped, as OpenDroneMap does.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.files import write_text
from toolkit.geometry.geodesy import Origin, enu_from_geodetic
from toolkit.optional import require
from toolkit.scene.colmap_model import check_name

Array = NDArray[np.float64]

_COLUMNS = ("geo_x", "geo_y", "geo_z", "im_x", "im_y")
_LONGEST_CRS = 1000
_CRS_FORMS = "'EPSG:n', 'WGS84 UTM 16N' (or S), or a PROJ string '+proj=...'"


@dataclass(frozen=True, slots=True)
class GroundControl:
    """P points on the ground with known coordinates, and where they were marked in T places of pictures.

    Attributes
    ----------
    crs:
        The coordinate system as OpenDroneMap writes it: ``EPSG:n``, ``WGS84 UTM 16N`` or a PROJ string.
    xyz:
        (P, 3) coordinates in it, x before y whatever the system's own order of axes is: easting, northing and
        height, or longitude, latitude and height.
    names:
        P names, no two alike, without spaces; empty for points without name, whose coordinates then differ.
    point_indices:
        (T,) which point each observation is of.
    images:
        T file names of pictures, without spaces.
    pixels:
        (T, 2) x and y as they stand in the file, of the picture as stored (EXIF orientation not applied), counted
        from its top-left corner: the first pixel's centre is (0.5, 0.5), as everywhere here, so nothing is shifted.
        Programs in which points are marked count so; OpenSfM, which reads the file within OpenDroneMap, takes the
        same numbers to count from the first pixel's centre. The two differ by half a pixel.

    Raises
    ------
    DataError
        Where the parts do not fit together, or a file could not hold them.
    """

    crs: str
    xyz: Array
    names: tuple[str, ...]
    point_indices: NDArray[np.int64]
    images: tuple[str, ...]
    pixels: Array

    def __post_init__(self) -> None:
        points, marks = len(self.names), len(self.images)
        shapes = {"xyz": (points, 3), "point_indices": (marks,), "pixels": (marks, 2)}
        for name, shape in shapes.items():
            found = np.shape(getattr(self, name))
            if found != shape:
                raise DataError(
                    f"Ground control's {name} do not fit", expected=f"shape {shape}", found=f"shape {found}"
                )
        if not np.isfinite(self.xyz).all():
            raise DataError("Ground control has coordinates that are not finite")
        if not (np.isfinite(self.pixels).all() and (self.pixels >= 0).all()):
            raise DataError("Ground control has pixels that are not finite, or negative")
        if marks and not (self.point_indices.min() >= 0 and self.point_indices.max() < points):
            raise DataError("Ground control has observations of no point", expected=f"indices below {points}")
        for name in (*filter(None, self.names), *self.images):
            check_name(name)
            if name.split() != [name]:
                raise DataError(
                    f"The name {name!r} cannot stand in a gcp_list.txt", expected="a name without spaces"
                )
        keys = set()
        for name, row in zip(self.names, self.xyz.tolist(), strict=True):
            key = _key(name, row)
            if key in keys:
                raise DataError(f"Ground control has the point {key} twice", expected="names that differ")
            keys.add(key)

    def geodetic(self) -> Array:
        """Return latitude and longitude on WGS84 in degrees, and altitude (P, 3), of the points.

        The third number is passed on as it is written: metres above whatever the surveyor measured from (the
        ellipsoid, or a geoid), because the files do not tell. Geoid and ellipsoid are up to 100 m apart.

        Raises
        ------
        DataError
            Where the coordinate system is not known, or a point lies outside of it.
        MissingDependencyError
            Where pyproj is not installed.
        """
        pyproj = require("pyproj")
        # Without always_xy, systems such as EPSG:4326 and EPSG:2180 would want north before east.
        transformer = pyproj.Transformer.from_crs(
            _checked_crs(self.crs, "this ground control"), pyproj.CRS.from_epsg(4326), always_xy=True
        )
        longitude, latitude = transformer.transform(self.xyz[:, 0], self.xyz[:, 1])
        geodetic = np.column_stack([latitude, longitude, self.xyz[:, 2]]).astype(np.float64)
        bad = np.flatnonzero(~np.isfinite(geodetic).all(axis=1) | (np.abs(geodetic[:, 0]) > 90))
        if len(bad):
            raise DataError(
                f"The point {_key(self.names[bad[0]], self.xyz[bad[0]].tolist())} lies outside of '{self.crs}'",
                found=f"coordinates {self.xyz[bad[0]].tolist()}, and {len(bad) - 1} more",
                todo="Check the first line of the file, and that x (east) stands before y (north)",
            )
        return geodetic

    def enu(self, origin: Origin) -> Array:
        """Return metres east, north and up (P, 3) of an origin (latitude, longitude, altitude).

        Altitudes are those of :meth:`geodetic`: the origin's must be measured from the same zero.

        Raises
        ------
        DataError, MissingDependencyError
            As :meth:`geodetic`.
        """
        return enu_from_geodetic(self.geodetic(), origin)


def _key(name: str, xyz: list[float]) -> str | tuple[float, ...]:
    """Return what tells a point from the others: its name, or where it has none, its coordinates."""
    return name or tuple(xyz)


def read_gcp_list(path: Path) -> GroundControl:
    """Read ``gcp_list.txt``: the points in the order in which they first appear, observations in the file's.

    Rows are ``geo_x geo_y geo_z im_x im_y image_name [gcp_name] [extras]``, separated by spaces or tabs. Rows
    without a name are of one point where their coordinates are equal. Extras are not kept.

    Raises
    ------
    DataError
        Where the file is missing or empty, the coordinate system is not known, or a row has too few columns, no
        numbers, negative pixels, or other coordinates than an earlier row of the same name. The message names the
        line.
    MissingDependencyError
        Where pyproj is not installed.
    """
    try:
        # Editors on Windows put a byte-order mark first.
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise DataError(f"{path} is missing", expected="a gcp_list.txt") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"Cannot read {path}", expected="a gcp_list.txt", found=str(error)) from error
    lines = [(number, line.strip()) for number, line in enumerate(text.split("\n"), start=1)]
    lines = [(number, line) for number, line in lines if line and not line.startswith("#")]
    if not lines:
        raise DataError(f"{path} is empty", expected=f"a coordinate system in its first line: {_CRS_FORMS}")
    crs = lines[0][1].strip("'\"")
    _checked_crs(crs, f"line {lines[0][0]} of {path}")
    if len(lines) == 1:
        raise DataError(f"{path} has no ground control points", expected="rows after the coordinate system")
    # For each point: its number, coordinates and line.
    seen: dict[str | tuple[float, ...], tuple[int, list[float], int]] = {}
    names: list[str] = []
    indices: list[int] = []
    images: list[str] = []
    pixels: list[list[float]] = []
    for line_number, line in lines[1:]:
        numbers, image, name = _row(line, f"line {line_number} of {path}")
        xyz = numbers[:3]
        index, first_xyz, first_line = seen.setdefault(_key(name, xyz), (len(names), xyz, line_number))
        if index == len(names):
            names.append(name)
        elif first_xyz != xyz:
            raise DataError(
                f"Lines {first_line} and {line_number} of {path} give the point '{name}' different coordinates",
                expected=str(first_xyz),
                found=str(xyz),
                todo="Correct one of them, or give it another name",
            )
        indices.append(index)
        images.append(image)
        pixels.append(numbers[3:])
    return GroundControl(
        crs=crs,
        xyz=np.array([xyz for _, xyz, _ in seen.values()]),
        names=tuple(names),
        point_indices=np.array(indices, dtype=np.int64),
        images=tuple(images),
        pixels=np.array(pixels),
    )


def write_gcp_list(gcp: GroundControl, path: Path) -> None:
    """Write ``gcp_list.txt`` in one step, the observations of a point beside each other, numbers to the last digit.

    Raises
    ------
    DataError
        Where the coordinate system is not known, or a point has no observation: the file holds nothing else.
    MissingDependencyError
        Where pyproj is not installed.
    RunError
        When the disk is full or the folder may not be written.
    """
    _checked_crs(gcp.crs, "this ground control")
    unseen = np.flatnonzero(np.bincount(gcp.point_indices, minlength=len(gcp.names)) == 0)
    if not len(gcp.names) or len(unseen):
        point = _key(gcp.names[unseen[0]], gcp.xyz[unseen[0]].tolist()) if len(unseen) else "no point"
        raise DataError(
            f"Cannot write {path}", expected="points with one observation at least", found=f"{point} without"
        )
    rows = [gcp.crs]
    for number in np.argsort(gcp.point_indices, kind="stable").tolist():
        index = int(gcp.point_indices[number])
        values = [*gcp.xyz[index].tolist(), *gcp.pixels[number].tolist()]
        rows.append("\t".join([*map(repr, values), gcp.images[number], gcp.names[index]]).rstrip("\t"))
    write_text(path, "\n".join(rows) + "\n")


def _row(line: str, where: str) -> tuple[list[float], str, str]:
    """Return the five numbers, the picture and the name (or nothing) of a row."""
    words = line.split()
    if len(words) <= len(_COLUMNS):
        raise DataError(
            f"Too few columns in {where}",
            expected=f"{' '.join(_COLUMNS)} image_name [gcp_name]",
            found=f"{len(words)} columns: {line[:80]!r}",
        )
    numbers = []
    for column, word in zip(_COLUMNS, words, strict=False):
        try:
            number = float(word)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise DataError(f"{column} is no finite number in {where}", found=repr(word[:40]))
        if column.startswith("im_") and number < 0:
            raise DataError(
                f"A negative pixel {column} in {where}", expected="0 or more from the top-left corner", found=word
            )
        numbers.append(number)
    return numbers, words[len(_COLUMNS)], words[len(_COLUMNS) + 1] if len(words) > len(_COLUMNS) + 1 else ""


def _checked_crs(text: str, where: str) -> Any:
    """Return pyproj's horizontal coordinate system of one of OpenDroneMap's three forms."""
    pyproj = require("pyproj")
    utm = re.fullmatch(r"WGS84\s+UTM\s+(\d{1,2})\s*([NS])", text.strip(), re.IGNORECASE)
    if utm and 1 <= int(utm[1]) <= 60:
        return pyproj.CRS.from_epsg((32600 if utm[2] in "Nn" else 32700) + int(utm[1]))
    unknown = DataError(
        f"Unknown coordinate system in {where}",
        expected=_CRS_FORMS,
        found=repr(text[:80]),
        todo="epsg.io lists the codes",
    )
    known = re.fullmatch(r"EPSG:\d{1,9}", text.strip(), re.IGNORECASE) or "+proj" in text
    if not known or len(text) > _LONGEST_CRS or len(text.splitlines()) != 1:
        raise unknown
    try:
        crs = pyproj.CRS.from_user_input(text.strip())
    except pyproj.exceptions.CRSError as error:
        raise unknown from error
    if not (crs.is_projected or crs.is_geographic):
        raise DataError(
            f"The coordinate system in {where} has no east and north",
            expected="a projected or a geographic one",
            found=f"{text!r} ({crs.type_name})",
        )
    return crs.to_2d()
