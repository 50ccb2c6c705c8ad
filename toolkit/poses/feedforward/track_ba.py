"""Bundle adjustment of a prediction on real tracks: features matched between its pictures.

A network's cameras are off by a degree or two, and nothing in its single pass compares a point's images. Here
features are matched and verified between the pictures, points begin where the predicted cameras' rays meet, or
where predicted depth puts them, and cameras and points are adjusted by COLMAP's Ceres adjuster, in rounds with ever
tighter limits.

The gauge: the first picture's pose and, of a second one, the coordinate of its place along the longest side of the
baseline are fixed (COLMAP's ``TWO_CAMS_FROM_WORLD``): six numbers of a motion and one distance, which sets the
scale. So the world stays about where the prediction put it.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.files import disk_errors
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.scene_matches import match_scene
from toolkit.poses.feedforward.depth_fit import DepthFit, fit_depth
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.prediction_scene import prediction_scene
from toolkit.poses.feedforward.track_result import TrackAdjustment, reprojection_errors
from toolkit.poses.feedforward.track_rounds import TrackAdjustSettings, TrackRounds
from toolkit.poses.feedforward.tracks import meeting_points
from toolkit.progress import Progress, silent
from toolkit.scene import Scene, Tracks

Array = NDArray[np.float64]

_LEAST_PICTURES = 2


def adjust_on_tracks(
    scene: Scene,
    prediction: Prediction,
    settings: TrackAdjustSettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
    work_dir: Path | None = None,
) -> TrackAdjustment:
    """Adjust the cameras of a prediction on features that are matched between its pictures.

    Parameters
    ----------
    scene:
        With the pictures. Its own cameras and poses are not used.
    prediction:
        Of at least two of its pictures.
    settings:
        As declared.
    seed:
        Of RANSAC.
    progress:
        Raises to cancel.
    work_dir:
        Where the features' database is written, ``matches.db``; None: nowhere that stays.

    Raises
    ------
    StageError
        For fewer than two pictures, and where too few matches agree with the predicted cameras.
    DataError
        For pictures that are missing or damaged.
    """
    if len(prediction) < _LEAST_PICTURES:
        raise StageError(
            "Bundle adjustment compares pictures", expected="a prediction of at least 2", found=str(len(prediction))
        )
    start = prediction_scene(scene, prediction, None, shared_camera=settings.intrinsics == "shared")
    start = start.replace(frames=start.registered)  # the others are not matched
    begin = time.perf_counter()
    if work_dir is not None:
        with disk_errors(work_dir, "writing"):
            work_dir.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="tracks.", dir=work_dir) as name:
        temporary = Path(name)
        database = (work_dir or temporary) / "matches.db"
        matched = match_scene(start, database, settings.features, settings.pairs, seed=seed, progress=progress)
        rounds = TrackRounds(start, prediction, database, settings, seed, progress, temporary)
        found = rounds.run()
    adjusted, reasons = _without_weak(found, settings)
    tracks, xyz = _tracks_of(adjusted)
    before = reprojection_errors(start, tracks, meeting_points(start, tracks, len(xyz)))
    fit = fit_depth(adjusted, prediction, tracks, xyz, settings.depth)
    return TrackAdjustment(
        _in_frames_of(scene, adjusted),
        _refined(prediction, adjusted, fit),
        before,
        reprojection_errors(adjusted, tracks, xyz),
        tuple(rounds.reports),
        rounds.focal_sigma,
        {n: float(s) for n, s in zip(prediction.names, fit.scale, strict=True) if np.isfinite(s)},
        fit.before,
        fit.after,
        reasons,
        {**matched.seconds, "adjustment": time.perf_counter() - begin - sum(matched.seconds.values())},
    )


def _tracks_of(scene: Scene) -> tuple[Tracks, Array]:
    assert scene.points is not None
    assert scene.points.tracks is not None
    return scene.points.tracks, scene.points.xyz


def _without_weak(scene: Scene, settings: TrackAdjustSettings) -> tuple[Scene, dict[str, str]]:
    """Return the scene without the poses of pictures that hardly anything holds, and why they have none."""
    reasons: dict[str, str] = {}
    while True:
        tracks, _ = _tracks_of(scene)
        seen = np.bincount(tracks.frame, minlength=len(scene))
        weak = {
            frame.name: f"{seen[i]} points, {settings.min_points} needed"
            for i, frame in enumerate(scene.frames)
            if frame.cam_from_world is not None and seen[i] < settings.min_points
        }
        if not weak:
            break
        reasons.update(weak)
        frames = tuple(
            dataclasses.replace(frame, cam_from_world=None) if frame.name in weak else frame
            for frame in scene.frames
        )
        held = np.array([frame.cam_from_world is not None for frame in frames])[tracks.frame]
        held &= (np.bincount(tracks.point[held], minlength=len(scene.points or ())) >= _LEAST_PICTURES)[
            tracks.point
        ]
        assert scene.points is not None
        scene = scene.replace(frames=frames, points=scene.points.observed(held))
    if len(scene.registered) < _LEAST_PICTURES:
        raise StageError(
            "Hardly any picture is held by the points",
            expected=f"at least {_LEAST_PICTURES} pictures with {settings.min_points} points each",
            found=", ".join(f"{name}: {reason}" for name, reason in list(reasons.items())[:5]),
            todo="Match more features, or lower min_points",
        )
    return scene, reasons


def _refined(prediction: Prediction, adjusted: Scene, fit: DepthFit) -> Prediction:
    """Return the prediction of the adjusted pictures, with its depth fitted to the points."""
    left = [i for i, name in enumerate(prediction.names) if adjusted.frame(name).cam_from_world is not None]
    chosen = prediction.chosen(left)
    cameras, poses = [], []
    for name in chosen.names:
        frame = adjusted.frame(name)
        camera = adjusted.camera_of(frame)
        assert isinstance(camera, ColmapCamera)
        assert frame.cam_from_world is not None
        cameras.append(camera)
        poses.append(frame.cam_from_world)
    return dataclasses.replace(
        chosen,
        cameras=tuple(cameras),
        cam_from_world=tuple(poses),
        depth=chosen.depth * fit.factor[left],
    ).with_points_from_depth()


def _in_frames_of(scene: Scene, adjusted: Scene) -> Scene:
    """Return the adjusted scene with all frames of the scene in their order; the others have no pose."""
    number = {frame.name: i for i, frame in enumerate(adjusted.frames)}
    place = {frame.name: i for i, frame in enumerate(scene.frames)}
    frames, cameras = [], dict(adjusted.cameras)
    free = max((*adjusted.cameras, *scene.cameras)) + 1
    others: dict[int, int] = {}
    for frame in scene.frames:
        if frame.name in number:
            frames.append(adjusted.frames[number[frame.name]])
            continue
        new = others.setdefault(frame.camera_id, free + len(others))
        cameras[new] = scene.cameras[frame.camera_id]
        frames.append(dataclasses.replace(frame, camera_id=new, cam_from_world=None, prior=None))
    tracks, _ = _tracks_of(adjusted)
    moved = np.array([place[frame.name] for frame in adjusted.frames])[tracks.frame]
    assert adjusted.points is not None
    points = dataclasses.replace(adjusted.points, tracks=Tracks(tracks.point, moved, tracks.pixel))
    return adjusted.replace(frames=tuple(frames), cameras=cameras, points=points)
