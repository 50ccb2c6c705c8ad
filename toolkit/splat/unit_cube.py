"""A scene scaled into the unit cube and back, for scenes of unknown extent.

NoposeGS has one learning rate for cameras whatever the scene's units are, so the trajectory is scaled to fit into
the unit cube first (A-3DGS, section 5.1). Training here takes its rates in scene extents and needs no such scaling;
scenes for other programs, or far from one in size, do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from toolkit.errors import StageError
from toolkit.geometry.alignment import Similarity
from toolkit.scene import Georeference, PosePrior, Scene
from toolkit.splat.gaussians import Gaussians


@dataclass(frozen=True, slots=True)
class UnitCube:
    """The way of a scene into the cube and back.

    Attributes
    ----------
    cube_from_scene:
        Scale and translation, no rotation: camera centres lie in the cube of side 1 around the origin afterwards,
        and the longest side of their box is between a half and 1. The scale is a power of two, so that scaling
        itself rounds nothing.
    georeference:
        Of the scene, which its copy in the cube does not have: that is not in metres.
    """

    cube_from_scene: Similarity
    georeference: Georeference | None

    @classmethod
    def of(cls, scene: Scene) -> UnitCube:
        """Return the way of this scene, by its camera centres.

        Raises
        ------
        StageError
            Where it has no two cameras at different places.
        """
        centres = scene.centres()
        side = float(np.ptp(centres, axis=0).max()) if len(centres) else 0.0
        if not side > 0:
            raise StageError(
                "Nothing says how large the scene is",
                expected="two or more camera centres apart from each other",
                found=f"{len(centres)} poses" + (" at one place" if len(centres) else ""),
                todo="Find poses first",
            )
        scale = 2.0 ** -math.ceil(math.log2(side))
        middle = (centres.min(axis=0) + centres.max(axis=0)) / 2
        return cls(Similarity(scale, np.eye(3), -scale * middle), scene.georeference)

    def into(self, scene: Scene) -> Scene:
        """Return the scene in the cube: poses, points and the sensors' positions with their sigmas."""
        return _moved(scene, self.cube_from_scene).replace(georeference=None)

    def back(self, scene: Scene) -> Scene:
        """Return a scene in the cube at its old size and place; the inverse of :meth:`into` up to rounding."""
        return _moved(scene, self.cube_from_scene.inverse()).replace(georeference=self.georeference)

    def gaussians_back(self, gaussians: Gaussians) -> Gaussians:
        """Return Gaussians that were trained in the cube at the scene's old size and place."""
        scene_from_cube = self.cube_from_scene.inverse()
        shift = gaussians.means.new_tensor(scene_from_cube.translation.tolist())
        return replace(
            gaussians,
            means=gaussians.means * scene_from_cube.scale + shift,
            log_scales=gaussians.log_scales + math.log(scene_from_cube.scale),
        )


def _moved(scene: Scene, similarity: Similarity) -> Scene:
    """Return a scene mapped by a similarity without rotation."""
    frames = tuple(
        replace(
            frame,
            cam_from_world=None if frame.cam_from_world is None else similarity.apply_to_pose(frame.cam_from_world),
            prior=_moved_prior(frame.prior, similarity),
        )
        for frame in scene.frames
    )
    points = scene.points
    if points is not None:
        points = replace(points, xyz=similarity.apply(points.xyz))
    return scene.replace(frames=frames, points=points)


def _moved_prior(prior: PosePrior | None, similarity: Similarity) -> PosePrior | None:
    if prior is None or prior.position is None:
        return prior
    sigma = prior.position_sigma
    return replace(
        prior,
        position=similarity.apply(prior.position),
        position_sigma=None if sigma is None else similarity.scale * sigma,
    )
