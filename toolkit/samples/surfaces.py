"""The true surface and depth of engine, town, nadir flight and city, and depth that is not quite true."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, ToolkitError
from toolkit.files import disk_errors, read_json
from toolkit.geometry.ray_casting import MeshCaster
from toolkit.geometry.surface import DepthView, Mesh
from toolkit.samples.city import open_city
from toolkit.samples.engine import open_engine
from toolkit.samples.make import SampleSettings, depth_path, read_depth, town_of_sample
from toolkit.samples.nadir_flight import KIND as NADIR
from toolkit.samples.nadir_queries import town_of_record
from toolkit.samples.town import Town
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
    town or a city all of it, whatever the pictures show.

    Raises
    ------
    DataError
        Where the folder holds no sample, or a damaged one.
    """
    record = _record(folder)
    if record.get("kind") == "engine":
        return read_mesh(open_engine(folder).mesh)
    if record.get("kind") == "city":
        return open_city(folder).city.mesh
    town = (town_of_record(folder, record) if record.get("kind") == NADIR else _town(folder, record)).mesh
    return Mesh(town.vertices.astype(np.float64), town.triangles.astype(np.int32))


def _town(folder: Path, record: dict[str, Any]) -> Town:
    """Return the town of a flight of :func:`toolkit.samples.make.make_sample`."""
    try:
        settings, seed = SampleSettings.from_dict(record["settings"]), int(record["seed"])
    except (KeyError, TypeError, ValueError, ToolkitError) as error:
        raise DataError(f"{folder / _RECORD} is damaged", found=str(error)) from error
    return town_of_sample(settings, seed)


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
    if _record(folder).get("kind") == "city":
        raise DataError(
            f"{folder} is a city seen from orbit, whose pictures have no depth maps",
            expected="a flight over the town or a filmed engine",
            todo="Compare heights: open_city(folder).dsm",
        )
    from toolkit.scene.folder import read_scene

    scene = read_scene(folder)
    posed = scene.frame(frame.name)
    if posed.cam_from_world is None:
        raise DataError(f"Frame '{frame.name}' of {folder} has no pose", expected="the true one", found="none")
    return (caster or MeshCaster(true_surface(folder))).depth(scene.camera_of(posed), posed.cam_from_world)


def write_disturbed_depth(
    views: Iterable[DepthView],
    truth: Mesh,
    folder: Path,
    *,
    scale: float = 0.3,
    shift: float = 0.2,
    noise: float = 0.01,
    smooth: float = 6.0,
    seed: int = 0,
) -> Path:
    """Write true depth as a network might guess it, an array for each view, and return the folder.

    Of each view the true depth z becomes s z (1 + n) + t: the scale s is drawn evenly from a factor of 1 +-
    ``scale``, the shift t from +- ``shift`` median depths, and n is noise that varies slowly over the picture.

    Parameters
    ----------
    views:
        Whose cameras and poses count, in the world of ``truth``; arrays are of their size.
    folder:
        For ``<name>.npy`` (H, W) float32, 0 where a ray meets nothing; made where it is missing.
    noise:
        Standard deviation of n.
    smooth:
        Pixels over which n stays about the same.

    Raises
    ------
    RunError
        Where the disk refuses.
    """
    from scipy.ndimage import gaussian_filter

    caster, random = MeshCaster(truth), np.random.default_rng(seed)
    for view in views:
        depth = caster.depth(view.camera, view.cam_from_world)
        wave = gaussian_filter(random.standard_normal(depth.shape), smooth, mode="reflect")
        wave *= noise / max(float(wave.std()), 1e-12)
        by = 1 + scale * random.uniform(-1, 1)
        known = depth > 0
        offset = shift * random.uniform(-1, 1) * float(np.median(depth[known])) if known.any() else 0.0
        made = np.where(known, np.maximum(by * depth * (1 + wave) + offset, 1e-6), 0).astype(np.float32)
        path = folder / f"{view.name}.npy"
        with disk_errors(path, "writing"):
            path.parent.mkdir(parents=True, exist_ok=True)
            np.save(path, made)
    return folder


def _record(folder: Path) -> dict[str, Any]:
    record = read_json(folder / _RECORD)
    if not isinstance(record, dict):
        raise DataError(f"{folder / _RECORD} is damaged", expected="an object", found=type(record).__name__)
    return record
