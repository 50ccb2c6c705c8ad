"""A scene moved and scaled into the cube from -1 to 1, with the way back kept."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from toolkit.errors import CapabilityError, StageError
from toolkit.geometry.alignment import Similarity
from toolkit.geometry.cameras import ColmapCamera
from toolkit.scene.scene import Frame, PosePrior, Scene


@dataclass(frozen=True, slots=True)
class NormalisedScene:
    """A scene whose points and camera centres lie in the cube from -1 to 1.

    Attributes
    ----------
    scene:
        Poses, points and priors in normalised units; pixels, cameras and splits as they were. It has no
        georeference: its units are no metres.
    world_from_normalised:
        The way back; its rotation is the identity.
    """

    scene: Scene
    world_from_normalised: Similarity


def normalised(scene: Scene) -> NormalisedScene:
    """Return the scene with the middle of its box at the origin and half of the box's longest side as the unit.

    The box holds all points and all camera centres, so both lie in [-1, 1] on every axis, as in section 3.1 of
    Matzke et al. ("Evaluating Gaussian splatting maps for absolute visual localization of UAVs"). Nothing is
    turned: colours that depend on the direction stay right on the way back.

    Raises
    ------
    StageError
        Where there are neither points nor poses, or all are at one place.
    CapabilityError
        For a posed frame whose camera is not perspective: its pixels would no longer fit.
    """
    for frame in scene.registered:
        if not isinstance(scene.camera_of(frame), ColmapCamera):
            raise CapabilityError(
                "The scene cannot be scaled",
                expected="perspective cameras, which see the same at every scale",
                found=f"{type(scene.camera_of(frame)).__name__} for frame '{frame.name}'",
            )
    xyz = np.zeros((0, 3)) if scene.points is None else scene.points.xyz
    places = np.concatenate([xyz, scene.centres()])
    extent = np.ptp(places, axis=0).max() if len(places) else 0.0
    if not extent > 0:
        raise StageError(
            "The scene has no size to be scaled by",
            expected="points and camera centres at different places",
            found=f"{len(xyz)} points and {len(scene.registered)} poses"
            + (", all at one place" * bool(len(places))),
            todo="Find poses and points first",
        )
    middle = 0.5 * (places.min(axis=0) + places.max(axis=0))
    world_from_normalised = Similarity(0.5 * extent, np.eye(3), middle)
    back = world_from_normalised.inverse()
    points = scene.points
    if points is not None:
        # Rounding may leave the farthest ones a hair outside.
        points = dataclasses.replace(points, xyz=np.clip(back.apply(points.xyz), -1.0, 1.0))
    frames = tuple(_moved(frame, back) for frame in scene.frames)
    return NormalisedScene(scene.replace(frames=frames, points=points, georeference=None), world_from_normalised)


def _moved(frame: Frame, normalised_from_world: Similarity) -> Frame:
    pose, prior = frame.cam_from_world, frame.prior
    if prior is not None:
        prior = _moved_prior(prior, normalised_from_world)
    if pose is not None:
        pose = normalised_from_world.apply_to_pose(pose)
    return dataclasses.replace(frame, cam_from_world=pose, prior=prior)


def _moved_prior(prior: PosePrior, normalised_from_world: Similarity) -> PosePrior:
    position, sigma = prior.position, prior.position_sigma
    return dataclasses.replace(
        prior,
        position=None if position is None else normalised_from_world.apply(position[None])[0],
        position_sigma=None if sigma is None else normalised_from_world.scale * sigma,
    )
