"""Measures of trainings that refine poses: which poses count, and from where test photos are compared."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from toolkit.metrics.lpips import Lpips
from toolkit.recipes.base import RecipeContext
from toolkit.recipes.measure import measure_poses, measure_test_renders
from toolkit.scene import Scene
from toolkit.splat.train_settings import TrainSettings

if TYPE_CHECKING:
    from toolkit.splat.gaussians import Gaussians
    from toolkit.splat.train import TrainResult

REFINED_TESTS = "test_refined"


@dataclass(frozen=True, slots=True)
class JudgedPoses:
    """Poses after a training and what they are worth.

    Attributes
    ----------
    scene, flat_scene:
        The scene with its own cameras and with undistorted ones, in the world of the Gaussians.
    metrics:
        ``poses.*``: of the poses after the training. Where these were refined, of the training frames alone, for
        only those were; beside them ``start.*``, of the same frames before.
    reports:
        What there is to say of both, and of the similarity by which the test cameras moved along (``aligned``).
    """

    scene: Scene
    flat_scene: Scene
    metrics: dict[str, float | None]
    reports: dict[str, Any]


def judged_poses(scene: Scene, flat_scene: Scene, trained: TrainResult, reference: Scene | None) -> JudgedPoses:
    """Return the scenes as the training left them, with the measures of their poses.

    Raises
    ------
    StageError
        Where the refined poses tell no similarity (:func:`toolkit.splat.align_test.aligned_test_scene`).
    """
    from toolkit.splat.align_test import aligned_test_scene

    if not trained.poses:
        metrics, report = measure_poses(scene, reference)
        return JudgedPoses(scene, flat_scene, metrics, {"poses": report})
    aligned, flat = (aligned_test_scene(each, trained.poses) for each in (scene, flat_scene))
    before, before_report = measure_poses(training_only(scene), reference, name="start")
    after, after_report = measure_poses(training_only(aligned.scene), reference)
    reports = {"poses": after_report, "start": before_report, "aligned": flat.to_dict()}
    return JudgedPoses(aligned.scene, flat.scene, {**after, **before}, reports)


def measure_refined_test_renders(
    gaussians: Gaussians, flat_scene: Scene, settings: TrainSettings, lpips: Lpips, context: RecipeContext
) -> tuple[dict[str, float | None], dict[str, Any]]:
    """Return ``test_refined.*``: the measures of test photos whose own poses were fitted to the finished splat.

    Nothing where ``refine_test_steps`` is 0.
    """
    from toolkit.splat.align_test import refine_test_poses
    from toolkit.splat.evaluate import render_test_views

    if settings.refine_test_steps == 0:
        return {}, {}
    fitted = refine_test_poses(
        gaussians,
        flat_scene,
        settings,
        steps=settings.refine_test_steps,
        device=context.device,
        progress=context.progress,
    )
    _, metrics, report = measure_test_renders(
        render_test_views(gaussians, fitted, settings, device=context.device),
        len(fitted.of_split("test")),
        context.artifacts,
        lpips,
        context.progress,
        name=REFINED_TESTS,
    )
    pairs = zip(flat_scene.of_split("test"), fitted.of_split("test"), strict=True)
    kept = [before.name for before, after in pairs if after.cam_from_world is before.cam_from_world]
    return {**metrics, "test_refined.not_fitted": float(len(kept))}, {REFINED_TESTS: {**report, "not_fitted": kept}}


def training_only(scene: Scene) -> Scene:
    """Return the scene with poses of training frames only."""
    frames = (frame if frame.split == "train" else replace(frame, cam_from_world=None) for frame in scene.frames)
    return scene.replace(frames=tuple(frames))
