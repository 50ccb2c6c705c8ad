"""A splat as a map on disk: the Gaussians in the world's units, and what one must know to ask them for poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from toolkit.errors import DataError
from toolkit.files import read_json, write_json
from toolkit.geometry.alignment import Similarity
from toolkit.scene import Georeference
from toolkit.scene.records import georeference_from_record, georeference_record
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.ply import read_splats, write_splats
from toolkit.splat.rasterize import Kind

#: Names of the files in a map's folder.
MAP, SPLAT = "map.json", "splat.ply"
_FORMAT: Final = "sightline-map"
_VERSION: Final = 1


@dataclass(frozen=True, slots=True, eq=False)
class StoredMap:
    """A splat in its world.

    Attributes
    ----------
    gaussians:
        In world units: metres east, north and up where there is a georeference.
    kind:
        ``"2d"`` disks or ``"3d"`` ellipsoids.
    world_from_normalised:
        From the cube from -1 to 1 in which it was trained.
    georeference:
        Origin of the world, or None where the world is of its own.
    settings:
        Of the training.
    counts:
        Points and Gaussians by what they are: ``sparse``, ``dense``, ``initial``, ``gaussians``, ...
    """

    gaussians: Gaussians
    kind: Kind
    world_from_normalised: Similarity
    georeference: Georeference | None
    settings: Mapping[str, Any] = field(default_factory=dict)
    counts: Mapping[str, float] = field(default_factory=dict)


def write_map(stored: StoredMap, folder: Path) -> None:
    """Write ``splat.ply`` and then ``map.json`` into a folder.

    Raises
    ------
    NumericalError
        Where a parameter is not finite.
    RunError
        When the disk is full or the folder may not be written.
    """
    # A map without its record is none: the record goes last.
    (folder / MAP).unlink(missing_ok=True)
    write_splats(stored.gaussians, folder / SPLAT)
    similarity = stored.world_from_normalised
    write_json(
        folder / MAP,
        {
            "format": _FORMAT,
            "version": _VERSION,
            "splat": SPLAT,
            "kind": stored.kind,
            "world_from_normalised": {
                "scale": similarity.scale,
                "rotation": similarity.rotation.tolist(),
                "translation": similarity.translation.tolist(),
            },
            "georeference": georeference_record(stored.georeference),
            "settings": dict(stored.settings),
            "counts": dict(stored.counts),
        },
    )


def read_map(folder: Path) -> StoredMap:
    """Read the map in a folder.

    Raises
    ------
    DataError
        Where a file is missing or damaged, or of another format or version.
    """
    path = folder / MAP
    record = read_json(path)
    kind = record.get("format") if isinstance(record, dict) else None
    if not isinstance(record, dict) or kind != _FORMAT or record.get("version") != _VERSION:
        raise DataError(
            f"{path} is no map of this version",
            expected=f"format '{_FORMAT}', version {_VERSION}",
            found=f"format '{kind}'" + (f", version {record.get('version')}" if isinstance(record, dict) else ""),
        )
    try:
        frame = record["world_from_normalised"]
        similarity = Similarity(
            float(frame["scale"]), np.array(frame["rotation"], float), np.array(frame["translation"], float)
        )
        found, settings, counts = record["kind"], dict(record["settings"]), dict(record["counts"])
        georeference = georeference_from_record(record["georeference"], str(path))
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path} is damaged", expected="what write_map writes", found=repr(error)) from error
    if found not in ("2d", "3d"):
        raise DataError(f"{path} is damaged", expected="kind '2d' or '3d'", found=repr(found))
    return StoredMap(read_splats(folder / SPLAT), found, similarity, georeference, settings, counts)
