"""A lens of many coefficients, refined from poses that a simpler one has found.

While the mapper has few frames, a small turn apart, they do not tell the coefficients of a strong distortion: with
OPENCV_FISHEYE, from a guessed focal length, it fits whatever the first frames say and loses those that follow. Two
radial coefficients find the poses; all coefficients then start at the lens that comes nearest.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final

from toolkit.poses.camera_start import nearest_camera, with_cameras
from toolkit.poses.sfm import SfmSettings, adjust_model
from toolkit.poses.sfm_result import SfmResult, sfm_result
from toolkit.poses.triangulation import triangulate, triangulation_options
from toolkit.progress import Progress, silent
from toolkit.scene import scene_from_pycolmap
from toolkit.scene.colmap import colmap_camera

#: The model that finds the poses for one of more coefficients.
SIMPLER: Final = {
    "OPENCV": "RADIAL",
    "FULL_OPENCV": "RADIAL",
    "FISHEYE": "RADIAL_FISHEYE",
    "OPENCV_FISHEYE": "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE": "RADIAL_FISHEYE",
}
# Points of the simple lens are missing where it fits worst, at the edge of the pictures: they come with the first
# round, and move the lens in the second.
_ROUNDS: Final = 2
# How far a ray may miss a point while the lens is the simple one's.
_DEGREES: Final = 2.0


def refine_lens(
    found: SfmResult,
    database_path: Path,
    model: str,
    settings: SfmSettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
    work_dir: Path,
) -> SfmResult:
    """Give a reconstruction cameras of another model, triangulate again and adjust everything.

    Parameters
    ----------
    found:
        With another camera model.
    database_path:
        The features and verified matches that it was made from. It is only read.
    model:
        COLMAP's name.
    settings:
        Of the reconstruction.
    seed:
        Of every random choice.
    progress:
        Raises to cancel.
    work_dir:
        Folder for files that are needed meanwhile and removed at the end.

    Raises
    ------
    DataError, CapabilityError
        For a database that is damaged, and cameras that are none of COLMAP's.
    """
    start = time.perf_counter()
    used = {frame.camera_id: colmap_camera(found.scene, frame.camera_id) for frame in found.scene.frames}
    cameras = {number: nearest_camera(camera, model) for number, camera in used.items()}
    before = {number: camera.to_pycolmap(number) for number, camera in cameras.items()}
    scene = with_cameras(found.scene, cameras)
    options = triangulation_options(
        degrees=_DEGREES,
        pixels=settings.max_error,
        min_angle=settings.min_angle,
        seed=seed,
        min_matches=settings.min_matches,
        threads=settings.threads,
        adjusted=True,
    )
    for _ in range(_ROUNDS):
        refined = triangulate(scene, database_path, options, progress=progress, work_dir=work_dir)
        report = adjust_model(refined, scene, settings, progress)
        scene = scene_from_pycolmap(refined, scene.image_dir, like=scene)
    return sfm_result(
        refined,
        scene,
        models=found.models,
        before=before,
        adjustment=report,
        seconds={**found.seconds, "lens": time.perf_counter() - start},
    )
