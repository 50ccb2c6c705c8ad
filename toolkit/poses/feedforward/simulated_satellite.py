"""Simulated predictions of satellite pictures: a network's idea of cameras that it has never seen.

Networks learn from pictures of ordinary lenses, and their errors are of the size of what they look at. A pinhole
that is fitted to an RPC stands 600 km away: a degree of its rotation is ten kilometres on the ground, and a percent
of its depth six. So each RPC camera is replaced by one of an ordinary lens from where the satellite is seen, as far
away as shows the ground in the same scale, and errors are made for that one. Then all cameras go back along their
own axes until they have the field of view that the network is to have said: what is wrong on the ground stays the
same.

Which field of view a network says of a picture from orbit, the simulation does not know. It matters: in a wide one
high things are seen displaced towards the rim, which they are not in the picture.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import StageError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.geometry.rpc_fit import fit_affine_camera
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.simulated import SimulatedNoiseSettings, simulate_prediction
from toolkit.scene import Frame, Scene

Array = NDArray[np.float64]

#: Degrees across the longer side of a picture: the lens that errors are made for, and a long one.
ORDINARY, LONG = 30.0, 3.0

_EXACT = dict.fromkeys(("rotation", "translation", "focal", "focal_each", "depth", "depth_scale"), 0.0)


def near_camera(
    camera: RpcCamera, box: ArrayLike, field_of_view: float = ORDINARY
) -> tuple[ColmapCamera, RigidTransform]:
    """Return the near pinhole that stands for an RPC camera, and its ``cam_from_world``.

    Parameters
    ----------
    box:
        (2, 3) lower and upper corner of the ground in metres of the camera's world. In the plane through its
        middle, square to the line of sight, both cameras see the same, up to the RPC's skew.
    field_of_view:
        Degrees across the longer side.

    Raises
    ------
    DataError
        As :func:`toolkit.geometry.rpc_fit.fit_affine_camera`.
    """
    fitted = fit_affine_camera(camera, box)
    affine = fitted.camera
    assert isinstance(affine, AffineCamera)
    # The rotation in the picture's plane that is nearest to what the affine camera does there; the diagonal of what
    # is left are pixels per metre across and down, the rest is skew.
    u, _, vt = np.linalg.svd(affine.intrinsics[:2, :2])
    turn = np.eye(3)
    turn[:2, :2] = u @ vt
    rotation = turn @ fitted.cam_from_world.rotation
    scales = np.diag(affine.intrinsics[:2, :2] @ (u @ vt).T)
    half = 0.5 * max(camera.width, camera.height)
    distance = half / np.tan(np.radians(field_of_view) / 2) / float(scales.mean())
    middle = np.array([camera.width, camera.height]) / 2
    seen = np.append((np.array([affine.cx, affine.cy]) - middle) / scales, distance)
    pinhole = ColmapCamera("PINHOLE", camera.width, camera.height, (*(scales * distance), *middle))
    return pinhole, RigidTransform(rotation, seen - rotation @ _middle(box))


def simulate_satellite_prediction(
    scene: Scene,
    points_of: Callable[[Frame], NDArray[np.floating]],
    box: ArrayLike,
    settings: SimulatedNoiseSettings,
    *,
    field_of_view: float = LONG,
    seed: int = 0,
) -> Prediction:
    """Return what a network might say of satellite pictures whose truth is known.

    Parameters
    ----------
    scene:
        With true RPC cameras, of one picture size.
    points_of:
        Returns the places (H, W, 3) in the scene's world that the middles of a frame's pixels show; NaN where none
        is known.
    box:
        (2, 3) lower and upper corner of the ground, metres in the scene's world.
    settings:
        The errors, of cameras with a field of view of :data:`ORDINARY` degrees.
    field_of_view:
        Degrees across the longer side that the network says, up to its error.
    seed:
        Of the errors.

    Raises
    ------
    StageError
        Where a frame has no RPC camera, and as
        :func:`~toolkit.poses.feedforward.simulated.simulate_prediction`.
    """
    frames, cameras = [], {}
    for number, frame in enumerate(scene.frames, start=1):
        camera = scene.camera_of(frame)
        if not isinstance(camera, RpcCamera):
            raise StageError(
                f"Frame '{frame.name}' has no RPC camera",
                expected="satellite pictures",
                found=type(camera).__name__,
            )
        cameras[number], pose = near_camera(camera, box)
        frames.append(dataclasses.replace(frame, camera_id=number, cam_from_world=pose))
    near = scene.replace(cameras=cameras, frames=tuple(frames), points=None)

    depths = {frame.name: _depth(frame, points_of(frame)) for frame in near.frames}
    said, exact = (
        simulate_prediction(near, lambda frame: depths[frame.name], errors, seed=seed)
        for errors in (settings, settings.replace(_EXACT))
    )
    times = np.tan(np.radians(ORDINARY) / 2) / np.tan(np.radians(field_of_view) / 2)
    middle = _in_network_world(_middle(box), near, exact, depths, settings.stride)
    moved = _from_afar(said, said.depth, middle, times)
    if settings.points == "depth":
        return moved
    # A point head has errors of its own about the true cameras, which are those of the prediction without errors.
    heads = [
        pose.apply(places.reshape(-1, 3).astype(np.float64))[:, 2].reshape(places.shape[:2])
        for pose, places in zip(exact.cam_from_world, said.points, strict=True)
    ]
    return dataclasses.replace(moved, points=_from_afar(exact, np.array(heads), middle, times).points)


def _middle(box: ArrayLike) -> Array:
    """Return the middle (3,) of a box (2, 3)."""
    middle: Array = np.asarray(box, dtype=np.float64).mean(axis=0)
    return middle


def _in_network_world(
    place: Array, near: Scene, exact: Prediction, depths: Mapping[str, Array], stride: int
) -> Array:
    """Return a place (3,) of the scene in the world of its exact prediction: through the first picture's camera."""
    first = near.frames[0]
    assert first.cam_from_world is not None
    true = depths[first.name][stride // 2 :: stride, stride // 2 :: stride]
    height, width = exact.depth.shape[1:]
    scale = np.median(exact.depth[0][exact.valid[0]] / true[:height, :width][exact.valid[0]])
    return exact.cam_from_world[0].inverse().apply(scale * first.cam_from_world.apply(place[None]))[0]


def _depth(frame: Frame, places: NDArray[np.floating]) -> Array:
    """Return the depth (H, W) of places (H, W, 3) in a frame's camera; 0 where none is known."""
    assert frame.cam_from_world is not None
    flat = np.asarray(places, dtype=np.float64).reshape(-1, 3)
    return np.nan_to_num(frame.cam_from_world.apply(flat)[:, 2].reshape(places.shape[:2]))


def _from_afar(prediction: Prediction, depth: NDArray[np.floating], middle: Array, times: float) -> Prediction:
    """Return a prediction whose cameras are so many times farther from a place, their focal lengths as many times.

    In the plane of the place, square to its axis, each camera sees what it saw. Depth and points are those of depth
    (F, H, W) in the cameras as they were.
    """
    cameras = tuple(
        dataclasses.replace(one, params=(times * one.params[0], times * one.params[1], *one.params[2:]))
        for one in prediction.cameras
    )
    away = np.array([(times - 1) * pose.apply(middle[None])[0, 2] for pose in prediction.cam_from_world])
    poses = tuple(
        RigidTransform(pose.rotation, pose.translation + np.array([0.0, 0.0, back]))
        for pose, back in zip(prediction.cam_from_world, away, strict=True)
    )
    farther = np.where(prediction.valid, depth + away[:, None, None], 0.0).astype(np.float32)
    return dataclasses.replace(
        prediction, cameras=cameras, cam_from_world=poses, depth=farther
    ).with_points_from_depth()
