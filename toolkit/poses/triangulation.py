"""COLMAP's triangulation under poses that are given."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pycolmap

from toolkit.files import disk_errors
from toolkit.matching.colmap_job import run_colmap
from toolkit.matching.database import copy_database, require_same_frames
from toolkit.poses.camera_start import write_cameras
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene import Scene
from toolkit.scene.colmap import colmap_camera

# COLMAP compares rays by angles; below this rounding and distortion decide.
_LEAST_ANGLE = 0.5
# Enough that wrong observations stand out from those of points that were made of two rays.
_FEW_STEPS = 5


def triangulation_options(
    *,
    degrees: float,
    pixels: float,
    min_angle: float,
    seed: int,
    min_matches: int = 15,
    threads: int = 0,
    adjusted: bool = False,
) -> pycolmap.IncrementalPipelineOptions:
    """Return options for ``pycolmap.triangulate_points``.

    Parameters
    ----------
    degrees:
        By how much a ray may miss a point: the error of the poses; at least half a degree.
    pixels:
        The same in the pictures, for points that are merged, completed and kept.
    min_angle:
        Points whose rays meet under a smaller angle are left out, in degrees.
    seed:
        Of COLMAP's random choices.
    min_matches:
        Pairs with fewer inliers are not used.
    threads:
        0: as many as there are cores.
    adjusted:
        Whether points and poses are adjusted afterwards: then COLMAP refines the points a little only.
    """
    options = pycolmap.IncrementalPipelineOptions(
        min_num_matches=min_matches, num_threads=threads or -1, random_seed=seed
    )
    if adjusted:
        options.ba_global_max_refinements, options.ba_global_max_num_iterations = 1, _FEW_STEPS
    options.mapper.random_seed = seed
    options.mapper.filter_max_reproj_error = pixels
    options.mapper.filter_min_tri_angle = min_angle
    triangulation = options.triangulation
    triangulation.random_seed = seed
    triangulation.min_angle = min_angle
    angle = max(degrees, _LEAST_ANGLE)
    triangulation.create_max_angle_error = triangulation.continue_max_angle_error = angle
    triangulation.re_max_angle_error = angle
    triangulation.merge_max_reproj_error = triangulation.complete_max_reproj_error = pixels
    return options


def triangulate(
    scene: Scene,
    database_path: Path,
    options: pycolmap.IncrementalPipelineOptions,
    *,
    progress: Progress = silent,
    work_dir: Path,
) -> pycolmap.Reconstruction:
    """Return the scene's poses and cameras, which stay as they are, with points made anew from all matches.

    Parameters
    ----------
    scene:
        With poses; its points are not used.
    database_path:
        With the features and verified matches of its frames. It is only read, and its cameras are not used.
    options:
        From :func:`triangulation_options`.
    progress:
        Raises to cancel.
    work_dir:
        Folder for files that are needed meanwhile and removed at the end.

    Raises
    ------
    DataError
        For a database that is missing, damaged or of another scene.
    """
    require_same_frames(database_path, scene)
    with disk_errors(work_dir, "writing"):
        work_dir.mkdir(parents=True, exist_ok=True)
    placed = len(scene.registered)
    with tempfile.TemporaryDirectory(dir=work_dir, prefix=".points.", suffix=".tmp") as temporary:
        # COLMAP changes a database by opening it, and writes the model to the folder and to one beside it.
        copy = Path(temporary) / "matches.db"
        copy_database(database_path, copy)
        # COLMAP wants cameras of the same models in both.
        used = sorted({frame.camera_id for frame in scene.frames})
        write_cameras(copy, {number: colmap_camera(scene, number) for number in used})
        return run_colmap(
            lambda _: pycolmap.triangulate_points(
                scene.replace(points=None).to_pycolmap(),
                copy,
                scene.image_dir,
                Path(temporary) / "model",
                clear_points=True,
                options=options,
                refine_intrinsics=False,
            ),
            lambda: ProgressEvent("triangulate", placed, len(scene)),
            progress,
        )
