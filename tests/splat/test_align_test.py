"""Judging after refinement: known similarities are undone, test poses found from photos."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from tiny_scene import make_scene, true_gaussians

from toolkit.errors import SettingsError, StageError
from toolkit.geometry.alignment import Similarity
from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.image import psnr
from toolkit.metrics.lpips import Lpips
from toolkit.progress import silent
from toolkit.recipes.base import RecipeContext, RecipeInput, StageTime
from toolkit.recipes.cached import CachedStage
from toolkit.recipes.measure_refined import judged_poses, measure_refined_test_renders
from toolkit.recipes.steps import SCENE, PosedStages, train_and_measure
from toolkit.scene import Scene
from toolkit.scene.folder import write_scene
from toolkit.splat.align_test import aligned_test_scene, refine_test_poses
from toolkit.splat.evaluate import render_test_views
from toolkit.splat.lie import exp_se3
from toolkit.splat.pose_presets import POSE_PRESETS, pose_preset_settings
from toolkit.splat.pose_refine import pose_change
from toolkit.splat.train import TrainResult
from toolkit.splat.train_settings import Schedule, TrainSettings, camera_rate, means_rate
from toolkit.workspace import Workspace

KNOWN = Similarity(
    1.7,
    exp_se3(torch.tensor([0, 0, 0, 0.2, -0.4, 0.9], dtype=torch.float64)).numpy()[:3, :3],
    np.array([3.0, -2, 8]),
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_scene(tmp_path_factory.mktemp("aligned"))


def mapped(scene: Scene, split: str = "train") -> dict[str, RigidTransform]:
    return {
        frame.name: KNOWN.apply_to_pose(frame.cam_from_world)
        for frame in scene.frames
        if frame.split == split and frame.cam_from_world is not None
    }


def shaken(scene: Scene, split: str, degrees: float, seed: int = 0) -> Scene:
    """Turn each camera of a split by some degrees about a random axis."""
    generator = torch.Generator().manual_seed(seed)

    def turned(pose: RigidTransform) -> RigidTransform:
        axis = torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
        xi = torch.cat([torch.zeros(3, dtype=torch.float64), math.radians(degrees) * axis])
        return RigidTransform.from_matrix(exp_se3(xi).numpy()) @ pose

    frames = tuple(
        replace(frame, cam_from_world=turned(frame.cam_from_world))
        if frame.split == split and frame.cam_from_world is not None
        else frame
        for frame in scene.frames
    )
    return scene.replace(frames=frames)


def test_a_known_similarity_is_undone_exactly(scene: Scene) -> None:
    aligned = aligned_test_scene(scene, mapped(scene))
    for name, expected in mapped(scene, "test").items():
        found = aligned.scene.frame(name).cam_from_world
        assert found is not None
        # Rounding of float64 over a singular value decomposition.
        assert np.allclose(found.matrix, expected.matrix, atol=1e-12)
    assert scene.points is not None
    assert aligned.scene.points is not None
    assert np.allclose(aligned.scene.points.xyz, KNOWN.apply(scene.points.xyz), atol=1e-12)
    told = aligned.to_dict()
    assert told["scale"] == pytest.approx(1.7, rel=1e-12)
    assert told["rotation_deg"] == pytest.approx(math.degrees(math.hypot(0.2, 0.4, 0.9)), rel=1e-9)
    assert told["translation"] == pytest.approx([3, -2, 8])
    assert told["rms_residual"] == pytest.approx(0, abs=1e-12)
    assert told["rms_turn_deg"] == pytest.approx(0, abs=1e-5)


def test_test_renders_are_the_same_in_the_world_that_moved(scene: Scene) -> None:
    truth = true_gaussians()
    turned = RigidTransform(KNOWN.rotation, np.zeros(3)).quaternion
    gaussians = replace(
        truth,
        means=torch.from_numpy(KNOWN.apply(truth.means.numpy())).float(),
        quaternions=_product(torch.from_numpy(turned).float(), truth.quaternions),
        log_scales=truth.log_scales + math.log(KNOWN.scale),
    )
    aligned = aligned_test_scene(scene, mapped(scene)).scene
    before = list(render_test_views(truth, scene, TrainSettings()))
    after = list(render_test_views(gaussians, aligned, TrainSettings()))
    assert len(after) == 3
    for one, other in zip(before, after, strict=True):
        # float32 through other coordinates; one level of eight bits is 4e-3.
        assert np.abs(one.render - other.render).max() < 2e-3
    # Left where they were, the cameras would see something else.
    lost = next(iter(render_test_views(gaussians, scene, TrainSettings())))
    assert psnr(lost.render, lost.photo) < psnr(after[0].render, after[0].photo) - 10


def _product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Hamilton product of quaternions wxyz (4,) and (N, 4)."""
    w = a[0] * b[:, 0] - (a[1:] * b[:, 1:]).sum(-1)
    vector = a[0] * b[:, 1:] + b[:, :1] * a[1:] + torch.linalg.cross(a[1:].expand(len(b), 3), b[:, 1:])
    return torch.cat([w[:, None], vector], dim=1)


def test_what_the_similarity_leaves_is_reported(scene: Scene) -> None:
    refined = {f.name: f.cam_from_world for f in shaken(scene, "train", 2.0).frames if f.split == "train"}
    aligned = aligned_test_scene(scene, {name: pose for name, pose in refined.items() if pose is not None})
    # Two degrees each about axes of their own, less what one common turn takes of it.
    assert 1.0 < aligned.rms_turn_deg < 2.0


def test_a_scene_that_was_not_trained_on_is_refused(scene: Scene) -> None:
    refined = mapped(scene)
    del refined["03.png"]
    with pytest.raises(StageError, match="refined pose for each training frame .* found 1 of 6 .*'03.png' first"):
        aligned_test_scene(scene, refined)
    nothing = scene.replace(frames=tuple(replace(frame, split="test") for frame in scene.frames))
    with pytest.raises(StageError, match="found 0 of 0 without one"):
        aligned_test_scene(nothing, {})


def test_test_poses_are_found_from_their_photos_when_the_splat_is_the_truth(scene: Scene) -> None:
    off = shaken(scene, "test", 3.0)
    chosen = TrainSettings()
    found = refine_test_poses(true_gaussians(), off, chosen, steps=150)
    for frame in scene.frames:
        before, start, end = (s.frame(frame.name).cam_from_world for s in (scene, off, found))
        assert before is not None
        assert start is not None
        assert end is not None
        if frame.split == "train":
            assert end is start
        else:
            assert pose_change(before, start)[1] == pytest.approx(3)
            # Seen: 0.02 to 0.04 degrees; photos of 8 bits and this small tell about a tenth.
            assert pose_change(before, end)[1] < 0.15
    sharp = [psnr(v.render, v.photo) for v in render_test_views(true_gaussians(), found, chosen)]
    blurred = [psnr(v.render, v.photo) for v in render_test_views(true_gaussians(), off, chosen)]
    assert max(blurred) < 25  # dB
    # The rounding to 8 bits leaves about 59 dB where all pixels vary.
    assert min(sharp) > 45


def result_with(poses: dict[str, RigidTransform]) -> TrainResult:
    return cast(TrainResult, SimpleNamespace(poses=poses))


def test_measures_are_of_refined_training_poses_beside_those_of_the_start(scene: Scene) -> None:
    start = shaken(scene, "train", 2.0)
    judged = judged_poses(start, start, result_with(mapped(scene)), scene)
    assert judged.metrics["poses.sim3.rot_deg"] == pytest.approx(0, abs=1e-4)
    assert judged.metrics["start.sim3.rot_deg"] == pytest.approx(2, rel=0.01)
    assert judged.reports["aligned"]["rms_turn_deg"] > 0
    assert {"poses", "start"} <= judged.reports.keys()
    plain = judged_poses(start, start, result_with({}), scene)
    assert plain.scene is start
    assert plain.flat_scene is start
    assert not any(name.startswith("start") for name in plain.metrics)
    assert list(plain.reports) == ["poses"]


class NoLpips:
    """Measures nothing, as where there are no weights."""

    name, available, reason = "lpips", False, "of the test"

    def __call__(self, photo: object, render: object) -> None:
        return None


def test_test_renders_with_fitted_poses_have_columns_of_their_own(scene: Scene, tmp_path: Path) -> None:
    context = cast(RecipeContext, SimpleNamespace(device="cpu", artifacts=tmp_path, progress=silent))
    # LPIPS takes no pictures as small as these.
    off = shaken(scene, "test", 2.0)
    lpips = cast(Lpips, NoLpips())
    chosen = TrainSettings(refine_test_steps=60)
    metrics, report = measure_refined_test_renders(true_gaussians(), off, chosen, lpips, context)
    unfitted = [psnr(v.render, v.photo) for v in render_test_views(true_gaussians(), off, chosen)]
    assert metrics["test_refined.views"] == 3
    fitted = metrics["test_refined.psnr"]
    assert fitted is not None
    assert fitted > np.mean(unfitted) + 3  # dB
    assert len(list((tmp_path / "test_refined").glob("*.png"))) == 6
    assert list(report) == ["test_refined"]
    assert (metrics["test_refined.not_fitted"], report["test_refined"]["not_fitted"]) == (0, [])
    nowhere = true_gaussians().map(lambda tensor: tensor[:0])
    metrics, report = measure_refined_test_renders(nowhere, off, chosen, lpips, context)
    # Nothing covers these photos, so that nothing tells their poses: it says so.
    assert metrics["test_refined.not_fitted"] == 3
    assert report["test_refined"]["not_fitted"] == [frame.name for frame in off.of_split("test")]
    assert measure_refined_test_renders(true_gaussians(), off, TrainSettings(), lpips, context) == ({}, {})


def test_a_recipe_reports_refined_and_start_poses_and_both_kinds_of_test_renders(
    scene: Scene, tmp_path: Path
) -> None:
    write_scene(scene, tmp_path / "posed" / SCENE)
    posed = cast(
        CachedStage,
        SimpleNamespace(
            folder=tmp_path / "posed", time=StageTime("posed", 0.0), output=SimpleNamespace(key="k"), report={}
        ),
    )
    context = RecipeContext(Workspace(tmp_path / "work"), tmp_path, tmp_path / "checkpoint", 0, "cpu", silent)
    chosen = TrainSettings(steps=30, background="black", refine_poses=True, refine_test_steps=5)
    data = RecipeInput(scene.without_poses(), scene, "f")
    result = train_and_measure(data, PosedStages((posed,), {}), chosen, context, cast(Lpips, NoLpips()))
    # The start was the truth, so what the training moved is an error.
    assert result.metrics["start.sim3.rot_deg"] == pytest.approx(0, abs=1e-6)
    moved = result.metrics["poses.sim3.rot_deg"]
    assert moved is not None
    assert 0 < moved < 1
    assert {"test.psnr", "test_refined.psnr"} <= result.metrics.keys()
    assert {"aligned", "start", "poses", "test_refined"} <= result.reports.keys()
    before, after = (s.frame("01.png").cam_from_world for s in (scene, result.scene))
    assert before is not None
    assert after is not None
    assert not np.array_equal(before.matrix, after.matrix)


@pytest.mark.parametrize(
    ("name", "camera", "means"), [("orbslam-noposegs", 1e-3, 1e-3), ("sensor-dpt", 1.5e-3, 1.6e-4)]
)
def test_presets_have_the_papers_values(name: str, camera: float, means: float) -> None:
    chosen = pose_preset_settings(name)
    schedule = Schedule.of(chosen)
    assert chosen.refine_poses
    assert chosen.steps == 30_000
    assert schedule.densifies_after(30_000)
    assert (chosen.opacity_cost, chosen.max_anisotropy) == (0.01, 10)
    assert [schedule.most_gaussians_at(step) == 256_000 for step in (10_000, 10_001)] == [True, False]
    rates = [rate(chosen, step) for rate in (camera_rate, means_rate) for step in (1, 30_000)]
    assert rates == pytest.approx([camera, 1e-5, means, 1.6e-5])


@pytest.mark.parametrize("name", POSE_PRESETS)
def test_presets_are_valid_and_say_what_they_are_for(name: str) -> None:
    assert pose_preset_settings(name).refine_poses
    assert POSE_PRESETS[name].doc


def test_an_unknown_preset_is_told_with_those_there_are() -> None:
    with pytest.raises(
        SettingsError, match="Unknown preset 'slam'; expected one of orbslam-noposegs, sensor-dpt, poses-short"
    ):
        pose_preset_settings("slam")
