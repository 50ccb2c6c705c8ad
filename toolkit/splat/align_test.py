"""Judging splats whose training poses were refined: the test cameras follow, by a similarity or by their photos.

Where all training cameras are free the world may have drifted, turned and grown while it was learned. A test camera
that stayed where it was then sees another scene than its photo shows, whatever the splat is worth. There are two
remedies. They answer different questions, so they are reported apart:

- :func:`aligned_test_scene` moves all test cameras by the one similarity that the training cameras made. Test
  photos have no part in it. Errors that the test cameras' poses had from the start stay, and count.
- :func:`refine_test_poses` moves every test camera until the splat looks like its photo (as BARF does, Lin et al.
  2021, section 4.2). What is left is the error of the splat alone, as far as the photo tells the pose.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from toolkit.errors import StageError
from toolkit.geometry.alignment import Similarity, align_poses
from toolkit.geometry.rigid import RigidTransform, rotation_angle
from toolkit.progress import Progress, silent, track
from toolkit.scene import Points, Scene
from toolkit.splat.chain_settings import RelativePoseSettings
from toolkit.splat.evaluate import raster_settings
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.images import load_photo
from toolkit.splat.relative_pose import find_relative_pose
from toolkit.splat.train_settings import TrainSettings

#: Share of a test photo that must be covered.
_LEAST_COVERED: Final = 0.1
#: A test pose counts however unlike its photo the splat still is: that is what is measured.
_ANY_LOSS: Final = 2.0


@dataclass(frozen=True, slots=True)
class AlignedScene:
    """A scene moved to where its training cameras went.

    Attributes
    ----------
    scene:
        Training frames have their refined poses, other frames with a pose and the points were mapped.
    refined_from_original:
        The similarity, fitted to the training cameras alone.
    rms_residual:
        Root mean square distance of the training cameras from their mapped starts, in refined scene units.
    rms_turn_deg:
        The same of their orientations, in degrees.
    """

    scene: Scene
    refined_from_original: Similarity
    rms_residual: float
    rms_turn_deg: float

    def to_dict(self) -> dict[str, Any]:
        """Return the similarity and what it leaves, ready for JSON."""
        similarity = self.refined_from_original
        return {
            "scale": similarity.scale,
            "rotation_deg": math.degrees(rotation_angle(similarity.rotation)),
            "translation": similarity.translation.tolist(),
            "rms_residual": self.rms_residual,
            "rms_turn_deg": self.rms_turn_deg,
        }


def aligned_test_scene(original: Scene, refined: Mapping[str, RigidTransform]) -> AlignedScene:
    """Return the scene with refined training poses, and everything else moved to fit them.

    Parameters
    ----------
    original:
        With the poses that the training began with, or with reference poses.
    refined:
        Poses ``cam_from_world`` of training frames after the training, by name.

    Raises
    ------
    StageError
        Where a training frame with a pose has no refined one, or the poses tell no similarity.
    """
    train = original.of_split("train")
    missing = [frame.name for frame in train if frame.name not in refined]
    if missing or not train:
        raise StageError(
            "Cannot align a scene with its refined poses",
            expected="a refined pose for each training frame with a pose",
            found=f"{len(missing)} of {len(train)} without one" + (f", '{missing[0]}' first" if missing else ""),
            todo="Give the scene that was trained on",
        )
    before = [frame.cam_from_world for frame in train if frame.cam_from_world is not None]
    after = [refined[frame.name] for frame in train]
    similarity = align_poses(before, after, with_scale=True)
    mapped = [similarity.apply_to_pose(pose) for pose in before]
    distances = [np.linalg.norm(a.centre - b.centre) for a, b in zip(mapped, after, strict=True)]
    turns = [rotation_angle(a.rotation @ b.rotation.T) for a, b in zip(mapped, after, strict=True)]
    frames = tuple(
        replace(
            frame,
            cam_from_world=refined[frame.name]
            if frame.split == "train"
            else similarity.apply_to_pose(frame.cam_from_world),
        )
        if frame.cam_from_world is not None
        else frame
        for frame in original.frames
    )
    return AlignedScene(
        original.replace(frames=frames, points=_mapped(original.points, similarity)),
        similarity,
        rms_residual=float(np.sqrt(np.mean(np.square(distances)))),
        rms_turn_deg=math.degrees(float(np.sqrt(np.mean(np.square(turns))))),
    )


def _mapped(points: Points | None, similarity: Similarity) -> Points | None:
    return None if points is None else replace(points, xyz=similarity.apply(points.xyz))


def refine_test_poses(
    gaussians: Gaussians,
    scene: Scene,
    settings: TrainSettings,
    *,
    steps: int,
    device: str = "cpu",
    progress: Progress = silent,
) -> Scene:
    """Return the scene with each test pose moved to where the frozen Gaussians look most like its photo.

    By :func:`toolkit.splat.relative_pose.find_relative_pose`, from coarse to fine, with the loss of the training. A
    photo of which the Gaussians cover less than a tenth keeps its pose: it tells none.

    Parameters
    ----------
    steps:
        At most, for each test frame.

    Raises
    ------
    NumericalError
        Where a pose is no longer finite.
    """
    frozen = gaussians.detach()
    search = RelativePoseSettings(
        steps=steps, lambda_dssim=settings.lambda_dssim, min_overlap=_LEAST_COVERED, max_loss=_ANY_LOSS
    )
    poses: dict[str, RigidTransform] = {}
    for frame in track(scene.of_split("test"), "splat.test_poses", progress):
        if frame.cam_from_world is None:
            continue
        photo = load_photo(scene, frame, settings.max_side, device=device)
        found = find_relative_pose(frozen, photo, frame.cam_from_world, search, raster_settings(settings))
        if found.cam_from_world is not None:
            poses[frame.name] = found.cam_from_world
    frames = tuple(
        replace(frame, cam_from_world=poses[frame.name]) if frame.name in poses else frame for frame in scene.frames
    )
    return scene.replace(frames=frames)
