"""The true surface of samples: of the filmed engine and of flights over the town."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, ToolkitError
from toolkit.files import read_json
from toolkit.geometry.ray_casting import MeshCaster
from toolkit.geometry.surface import Mesh
from toolkit.samples.engine import open_engine
from toolkit.samples.make import SampleSettings, depth_path, read_depth, town_of_sample
from toolkit.scene import Frame, Scene
from toolkit.scene.mesh_files import read_mesh

_RECORD = "sample.json"


def sample_folder(scene: Scene) -> Path | None:
    """Return the folder of the sample whose pictures a scene has, or None where they are of no sample."""
    folder = scene.image_dir.parent
    return folder if (folder / _RECORD).is_file() else None


def true_surface(folder: Path) -> Mesh:
    """Return the very triangles that the pictures of a sample were cast against, in the world of its true poses.

    Of the engine that is the whole rotor (casing and icon are painted over its pictures and are no surface); of a
    town all of it, whatever the flight saw.

    Raises
    ------
    DataError
        Where the folder holds no sample, or a damaged one.
    """
    record = _record(folder)
    if record.get("kind") == "engine":
        return read_mesh(open_engine(folder).mesh)
    try:
        settings, seed = SampleSettings.from_dict(record["settings"]), int(record["seed"])
    except (KeyError, TypeError, ValueError, ToolkitError) as error:
        raise DataError(f"{folder / _RECORD} is damaged", found=str(error)) from error
    town = town_of_sample(settings, seed).mesh
    return Mesh(town.vertices.astype(np.float64), town.triangles.astype(np.int32))


def true_depth(folder: Path, frame: Frame, *, caster: MeshCaster | None = None) -> NDArray[np.float32]:
    """Return the true depth (H, W) of a frame of a sample: z in metres at pixel centres, 0 where nothing was met.

    Parameters
    ----------
    caster:
        Of :func:`true_surface`, for frames of a sample that was made without depth maps; made where it is None.

    Raises
    ------
    DataError
        Where the folder holds no sample or a damaged one.
    """
    if depth_path(folder, frame).is_file():
        return read_depth(folder, frame)
    from toolkit.scene.folder import read_scene

    scene = read_scene(folder)
    posed = scene.frame(frame.name)
    if posed.cam_from_world is None:
        raise DataError(f"Frame '{frame.name}' of {folder} has no pose", expected="the true one", found="none")
    return (caster or MeshCaster(true_surface(folder))).depth(scene.camera_of(posed), posed.cam_from_world)


def _record(folder: Path) -> dict[str, Any]:
    record = read_json(folder / _RECORD)
    if not isinstance(record, dict):
        raise DataError(f"{folder / _RECORD} is damaged", expected="an object", found=type(record).__name__)
    return record
