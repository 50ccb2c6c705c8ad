"""Predictions with known truth: a scene's own depth and cameras, with errors of the size that networks show.

The sizes are those of VGGT (Wang et al. 2025). Its AUC@30 of relative poses is 85 to 88 (table 1), which is a mean
of three to five degrees for the worse of rotation and direction of translation over pairs: one to two degrees a
camera where errors are alike and independent. Depth errors of a few percent, a factor for a picture and one that
changes smoothly over it, are our choice: the paper gives none relative to depth. The world is the first camera's,
and its unit the mean distance of the points from there, as in section 3.4.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import CapabilityError, SettingsError, StageError
from toolkit.geometry.alignment import Similarity
from toolkit.geometry.cameras import Camera, ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.feedforward.prediction import Prediction, unproject
from toolkit.scene import Frame, Scene
from toolkit.settings import Choice, Integer, Number, Settings

Array = NDArray[np.float64]

#: Numerator and offset of the confidence: 1 where the error is large, as VGGT's, whose confidence is 1 + exp(x).
_SURE = 5.0
#: Spread of the confidence's logarithm that has nothing to do with the error.
_UNSURE = 0.3


class SimulatedNoiseSettings(Settings):
    """Errors of a simulated prediction, as standard deviations."""

    rotation = Number(1.0, bounds=(0.0, 45.0), unit="degrees", doc="Of each camera's rotation about each axis.")
    translation = Number(
        2.0,
        bounds=(0.0, 50.0),
        unit="%",
        doc="Of each camera's centre on each axis, by the mean distance of points.",
    )
    focal = Number(2.0, bounds=(0.0, 50.0), unit="%", doc="Of the focal length that all pictures share.")
    focal_each = Number(0.5, bounds=(0.0, 50.0), unit="%", doc="Of each picture's own focal length besides.")
    depth_scale = Number(3.0, bounds=(0.0, 50.0), unit="%", doc="Of the factor on all depths of a picture.")
    depth = Number(3.0, bounds=(0.0, 50.0), unit="%", doc="Of a factor on depth that changes smoothly.")
    smooth = Number(
        12.0, bounds=(0.5, 100.0), unit="% of the width", doc="Distance over which the smooth factor changes."
    )
    points = Choice(
        "depth",
        choices=("depth", "head"),
        doc="Points by the predicted depth and cameras, or by a head of their own with errors of their own.",
    )
    stride = Integer(
        1, bounds=(1, 99), unit="px", doc="Maps hold every so manieth pixel of every so manieth row; an odd number."
    )


def simulate_prediction(
    scene: Scene,
    depth_of: Callable[[Frame], NDArray[np.floating]],
    settings: SimulatedNoiseSettings,
    *,
    seed: int = 0,
) -> Prediction:
    """Return what a network might say of a scene whose truth is known.

    Parameters
    ----------
    scene:
        With true poses and distortion-free cameras of one size. Frames without a pose are left out.
    depth_of:
        Returns the true camera depth (H, W) of a frame at the centres of its picture's pixels; 0 where there is
        none.
    settings:
        The errors. With zeros the prediction is exact, apart from its world.
    seed:
        Of the errors.

    Raises
    ------
    CapabilityError
        For a camera with distortion, or that is no perspective camera.
    StageError
        For a scene without poses or without depth.
    SettingsError
        For an even stride: the centres of its maps' pixels would be no centres in the picture.
    """
    if settings.stride % 2 == 0:
        raise SettingsError(
            "The stride of a simulation is even", expected="an odd number", found=str(settings.stride)
        )
    frames = scene.registered
    if not frames:
        raise StageError("There is nothing to predict", expected="frames with true poses", found="none")
    cameras = [_pinhole(scene, frame, settings.stride) for frame in frames]
    poses = [pose for frame in frames if (pose := frame.cam_from_world) is not None]
    true_depth = np.stack(
        [_every(np.asarray(depth_of(frame), dtype=np.float64), settings.stride) for frame in frames]
    )
    valid = true_depth > 0
    if not valid.any():
        raise StageError("There is nothing to predict", expected="true depth", found="none in any picture")
    world, unit = _network_world(true_depth, cameras, poses, valid)
    poses = [world.apply_to_pose(pose) for pose in poses]
    depth = true_depth * world.scale
    rng = np.random.default_rng(seed)
    seen_cameras, seen_poses = _noisy_cameras(cameras, poses, settings, rng)
    factor = np.stack([_factor(shape, settings, rng) for shape in [depth.shape[1:]] * len(frames)])
    predicted = np.where(valid, depth * factor, 0.0).astype(np.float32)
    points = unproject(predicted, seen_cameras, seen_poses, valid)
    if settings.points == "head":
        # Errors of its own, about the true cameras: it does not know those of the camera head.
        own = np.stack([_factor(shape, settings, rng) for shape in [depth.shape[1:]] * len(frames)])
        points = unproject((depth * own).astype(np.float32), cameras, poses, valid)
        factor = own
    return Prediction(
        provider=f"simulated ({settings.rotation:g} degrees, {settings.depth:g} % depth, unit {unit:.4g})",
        names=tuple(frame.name for frame in frames),
        cameras=tuple(
            _whole(camera, scene.camera_of(frame), settings.stride)
            for camera, frame in zip(seen_cameras, frames, strict=True)
        ),
        cam_from_world=tuple(seen_poses),
        depth=predicted,
        confidence=_confidence(factor, valid, settings, rng),
        points=points,
        picture_from_map=np.tile([settings.stride, settings.stride, 0.0, 0.0], (len(frames), 1)),
    )


def _every(depth: Array, stride: int) -> Array:
    """Return the depth at the middles of whole blocks of ``stride`` by ``stride`` pixels."""
    height, width = (length // stride * stride for length in depth.shape)
    middle = stride // 2
    return depth[middle:height:stride, middle:width:stride]


def _pinhole(scene: Scene, frame: Frame, stride: int) -> ColmapCamera:
    """Return the camera of a frame in pixels of its map."""
    camera = scene.camera_of(frame)
    if not isinstance(camera, ColmapCamera) or not camera.is_pinhole:
        raise CapabilityError(
            f"Frame '{frame.name}' cannot be simulated",
            expected="a camera without distortion",
            found=camera.model if isinstance(camera, ColmapCamera) else type(camera).__name__,
        )
    k = camera.intrinsics / stride
    size = (camera.width // stride, camera.height // stride)
    return ColmapCamera("PINHOLE", *size, (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))


def _whole(camera: ColmapCamera, picture: Camera, stride: int) -> ColmapCamera:
    """Return a camera of a map in pixels of the picture."""
    return ColmapCamera("PINHOLE", picture.width, picture.height, tuple(stride * p for p in camera.params))


def _network_world(
    depth: Array, cameras: list[ColmapCamera], poses: list[RigidTransform], valid: NDArray[np.bool_]
) -> tuple[Similarity, float]:
    """Return ``network_from_world`` and the length of the network's unit in units of the scene."""
    first = poses[0]
    relative = [pose @ first.inverse() for pose in poses]
    points = unproject(depth.astype(np.float32), cameras, relative, valid)[valid]
    unit = float(np.linalg.norm(points.astype(np.float64), axis=1).mean())
    return Similarity(1 / unit, first.rotation, first.translation / unit), unit


def _noisy_cameras(
    cameras: list[ColmapCamera],
    poses: list[RigidTransform],
    settings: SimulatedNoiseSettings,
    rng: np.random.Generator,
) -> tuple[list[ColmapCamera], list[RigidTransform]]:
    from scipy.spatial.transform import Rotation

    shared = np.exp(settings.focal / 100 * rng.normal())
    seen_cameras, seen_poses = [], []
    for camera, pose in zip(cameras, poses, strict=True):
        fx, fy, cx, cy = camera.params
        factor = shared * np.exp(settings.focal_each / 100 * rng.normal())
        seen_cameras.append(
            ColmapCamera("PINHOLE", camera.width, camera.height, (fx * factor, fy * factor, cx, cy))
        )
        turn = Rotation.from_rotvec(np.radians(settings.rotation) * rng.normal(size=3)).as_matrix()
        rotation = turn @ pose.rotation
        # The mean distance of the points is one.
        centre = pose.centre + settings.translation / 100 * rng.normal(size=3)
        seen_poses.append(RigidTransform(rotation, -rotation @ centre))
    return seen_cameras, seen_poses


def _factor(shape: tuple[int, ...], settings: SimulatedNoiseSettings, rng: np.random.Generator) -> Array:
    """Return what the depth (H, W) of a picture is multiplied with."""
    from scipy import ndimage

    reach = settings.smooth / 100 * shape[1]
    smooth = ndimage.gaussian_filter(rng.normal(size=shape), reach, mode="wrap")
    smooth /= max(float(smooth.std()), 1e-12)
    logarithm = settings.depth_scale / 100 * rng.normal() + settings.depth / 100 * smooth
    factor: Array = np.exp(logarithm)
    return factor


def _confidence(
    factor: Array, valid: NDArray[np.bool_], settings: SimulatedNoiseSettings, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Return confidences that fall with the error, and vary besides."""
    scale = max(np.hypot(settings.depth, settings.depth_scale) / 100, 1e-6)
    sure = 1 + _SURE * np.exp(-np.abs(np.log(factor)) / scale + _UNSURE * rng.normal(size=factor.shape))
    return np.where(valid, sure, 0.0).astype(np.float32)
