"""Every camera model adjusted on the same observations, from its own poses and from those of the best one."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.colmap_job import run_colmap
from toolkit.poses.camera_judge import Judged, adjust_on, t_scale
from toolkit.poses.camera_start import nearest_camera, with_cameras
from toolkit.poses.held_out import MatchedTracks
from toolkit.progress import Progress, ProgressEvent
from toolkit.scene import Scene
from toolkit.scene.colmap import colmap_camera


@dataclass(frozen=True, slots=True)
class JudgedFit:
    """A model on the common observations; ``started_from`` names the model whose poses it began with."""

    judged: Judged
    started_from: str
    noise: float


def within(tracks: MatchedTracks, common: NDArray[np.bool_]) -> MatchedTracks:
    """Return what is left of the tracks in some frames, where that is two observations beside the withheld one."""
    rows = common[tracks.frame]
    left = dataclasses.replace(
        tracks,
        track=tracks.track[rows],
        frame=tracks.frame[rows],
        keypoint=tracks.keypoint[rows],
        pixel=tracks.pixel[rows],
        held_out=tracks.held_out[rows],
    )
    return left.of(np.bincount(left.track[~left.held_out], minlength=left.count) >= 2)


def used_cameras(scene: Scene) -> dict[int, ColmapCamera]:
    """Return the cameras of registered frames by their numbers."""
    used = sorted({frame.camera_id for frame in scene.registered})
    return {number: colmap_camera(scene, number) for number in used}


def fit_all(
    found: Mapping[str, Scene],
    names: Sequence[str],
    common: NDArray[np.bool_],
    tracks: MatchedTracks,
    *,
    restart: bool,
    refine_principal_point: bool,
    threads: int,
    seconds: dict[str, float],
    progress: Progress,
) -> tuple[dict[str, JudgedFit], dict[str, str]]:
    """Return the best fit of every model on the common tracks, and why the other models have none.

    A fit whose focal length is no lens's (below a tenth or above ten times the picture's longer side) is none.

    Parameters
    ----------
    found:
        Poses and lens by model, of those whose own structure from motion succeeded.
    names:
        All models.
    common:
        (F,) frames that all of ``found`` placed.
    tracks:
        Those that judge.
    restart:
        Whether every model is adjusted from the poses and the lens of the best one, too, and once more where a
        special case of it fits better; then also models whose own structure from motion failed have a fit.
    refine_principal_point, threads:
        As of :func:`~toolkit.poses.camera_judge.adjust_on`.
    seconds:
        Wall time by model; what an adjustment takes is added.
    progress:
        Told of every adjustment; raises to cancel.
    """
    fits: dict[str, JudgedFit] = {}
    odd: dict[str, str] = {}
    total = len(found) + (len(names) - 1 if restart else 0)

    def attempt(done: int, name: str, start: Scene, origin: str) -> None:
        began = time.perf_counter()
        frames = tuple(
            frame if kept else dataclasses.replace(frame, cam_from_world=None)
            for frame, kept in zip(start.frames, common.tolist(), strict=True)
        )
        placed = start.replace(frames=frames, points=None)
        made = run_colmap(
            lambda _: adjust_on(placed, tracks, refine_principal_point=refine_principal_point, threads=threads),
            lambda: ProgressEvent("camera_models.judge", done, total, name),
            progress,
        )
        seconds[name] += time.perf_counter() - began
        reason = odd_focal(made.scene)
        if reason:
            odd[name] = reason
            return
        noise = t_scale(np.nan_to_num(made.residuals[~tracks.held_out], nan=_FAR))
        if name not in fits or noise < fits[name].noise:
            fits[name] = JudgedFit(made, origin, noise)

    for done, (name, scene) in enumerate(found.items()):
        attempt(done, name, scene, name)
    if not restart or not fits:
        progress(ProgressEvent("camera_models.judge", total, total))
        return fits, {name: reason for name, reason in odd.items() if name not in fits}
    best = min(fits, key=lambda name: fits[name].noise)
    start = fits[best].judged.scene
    for done, name in enumerate((each for each in names if each != best), start=len(found)):
        attempt(done, name, _with_model(start, name), best)
    for name in names:
        simple = _SPECIAL_CASE.get(name, "")
        if simple in fits and (name not in fits or fits[simple].noise < fits[name].noise):
            attempt(total, name, _with_model(fits[simple].judged.scene, name), simple)
    progress(ProgressEvent("camera_models.judge", total, total))
    return fits, {name: reason for name, reason in odd.items() if name not in fits}


def odd_focal(scene: Scene) -> str:
    """Return what is wrong with a scene's focal lengths, or an empty text."""
    for camera in used_cameras(scene).values():
        for place in camera.to_pycolmap().focal_length_idxs():
            part = camera.params[place] / max(camera.width, camera.height)
            if not _LEAST_FOCAL <= part <= _MOST_FOCAL:
                focal, size = f"{camera.params[place]:.4g} px", f"{camera.width} x {camera.height} px"
                return f"adjusted to a focal length of {focal}, which no lens has for pictures of {size}"
    return ""


def _with_model(scene: Scene, model: str) -> Scene:
    cameras = {number: nearest_camera(camera, model) for number, camera in used_cameras(scene).items()}
    return with_cameras(scene, cameras)


#: Residual in pixels of a point that has no image.
_FAR = 40.0
# Focal lengths of lenses as parts of the picture's longer side: COLMAP's limits.
_LEAST_FOCAL, _MOST_FOCAL = 0.1, 10.0

# A model and one that it becomes where some of its parameters are zero: it cannot fit worse than that.
_SPECIAL_CASE = {
    "PINHOLE": "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL": "SIMPLE_PINHOLE",
    "RADIAL": "SIMPLE_RADIAL",
    "OPENCV": "RADIAL",
    "FULL_OPENCV": "OPENCV",
    "FISHEYE": "SIMPLE_FISHEYE",
    "SIMPLE_RADIAL_FISHEYE": "SIMPLE_FISHEYE",
    "RADIAL_FISHEYE": "SIMPLE_RADIAL_FISHEYE",
    "OPENCV_FISHEYE": "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE": "OPENCV_FISHEYE",
    "SIMPLE_DIVISION": "SIMPLE_PINHOLE",
    "DIVISION": "SIMPLE_DIVISION",
}
