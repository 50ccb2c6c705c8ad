"""A prediction as a scene: frames with cameras and poses, and the points that are surest."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.scene import Points, Scene
from toolkit.settings import Integer, Number, Settings

_GREY = 128


class PredictionPointSettings(Settings):
    """Which points of a prediction become points of a scene."""

    share = Number(
        60.0, bounds=(0.1, 100.0), unit="%", doc="Of a picture's predicted pixels, so many of the surest are taken."
    )
    max_points = Integer(200000, bounds=(1, 50000000), doc="Most points, drawn at random over all pictures.")


def prediction_scene(
    scene: Scene,
    prediction: Prediction,
    settings: PredictionPointSettings | None = None,
    *,
    shared_camera: bool = False,
    seed: int = 0,
) -> Scene:
    """Return the scene's frames with the cameras and poses of a prediction.

    The world is the prediction's, of unknown scale: priors and georeference are left out. Frames that the
    prediction lacks keep their cameras and have no pose.

    Parameters
    ----------
    scene:
        With the pictures.
    prediction:
        Of all or some of them, by name.
    settings:
        Which points are taken; None: no points.
    shared_camera:
        Whether pictures of one size share a camera, with the medians of the predicted parameters.
    seed:
        Of the choice of points.

    Raises
    ------
    DataError
        Where a picture of the prediction is not in the scene.
    """
    known = {frame.name for frame in scene.frames}
    unknown = [name for name in prediction.names if name not in known]
    if unknown:
        raise DataError(
            "The prediction has pictures that the scene does not have",
            expected="the scene's frames",
            found=", ".join(unknown[:5]),
        )
    cameras = _shared(prediction.cameras) if shared_camera else list(prediction.cameras)
    index = {name: i for i, name in enumerate(prediction.names)}
    first_free = max(scene.cameras, default=0) + 1
    numbers: dict[ColmapCamera, int] = {}
    frames = []
    for frame in scene.frames:
        if frame.name not in index:
            frames.append(dataclasses.replace(frame, cam_from_world=None, prior=None))
            continue
        i = index[frame.name]
        # A camera of its own for each picture, even where two happen to be equal, unless they are to share one.
        number = numbers.setdefault(cameras[i], first_free + len(numbers)) if shared_camera else first_free + i
        frames.append(
            dataclasses.replace(frame, camera_id=number, cam_from_world=prediction.cam_from_world[i], prior=None)
        )
    new = {f.camera_id: cameras[index[f.name]] for f in frames if f.name in index}
    kept = {f.camera_id: scene.cameras[f.camera_id] for f in frames if f.name not in index}
    points = None if settings is None else confident_points(prediction, settings, seed=seed)
    return scene.replace(cameras={**kept, **new}, frames=tuple(frames), points=points, georeference=None)


def confident_points(prediction: Prediction, settings: PredictionPointSettings, *, seed: int = 0) -> Points:
    """Return the surest points of each picture of a prediction, coloured where it has colours."""
    xyz, rgb = [], []
    for i in range(len(prediction)):
        valid = prediction.valid[i]
        if not valid.any():
            continue
        confidence = prediction.confidence[i]
        least = np.quantile(confidence[valid], 1 - settings.share / 100)
        taken = valid & (confidence >= least)
        xyz.append(prediction.points[i][taken].astype(np.float64))
        grey = np.full((int(taken.sum()), 3), _GREY, dtype=np.uint8)
        rgb.append(grey if prediction.colours is None else prediction.colours[i][taken])
    places, colours = np.concatenate(xyz), np.concatenate(rgb)
    if len(places) > settings.max_points:
        rows = np.sort(np.random.default_rng(seed).permutation(len(places))[: settings.max_points])
        places, colours = places[rows], colours[rows]
    return Points(places, colours)


def _shared(cameras: Sequence[ColmapCamera]) -> list[ColmapCamera]:
    """Return for each picture the camera that all of its size share."""
    made = {}
    for size in {(camera.width, camera.height) for camera in cameras}:
        of_size = [camera.params for camera in cameras if (camera.width, camera.height) == size]
        made[size] = ColmapCamera("PINHOLE", *size, tuple(np.median(of_size, axis=0).tolist()))
    return [made[camera.width, camera.height] for camera in cameras]
