"""From photos of a small flight to a trained and measured map, and queries placed in it."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from toolkit.errors import StageError
from toolkit.files import read_json
from toolkit.geometry.surface import Cloud
from toolkit.matching.pairs import PairSettings
from toolkit.progress import silent
from toolkit.recipes.base import RecipeContext, RecipeInput
from toolkit.recipes.map_geometry import GEOMETRY
from toolkit.recipes.map_poses import map_pairs, position_residuals
from toolkit.recipes.map_steps import BuiltMap, MapSettings, map_stages
from toolkit.recipes.map_train import EARLY, ORIGINS, start_points
from toolkit.recipes.uav_maps import HELD, UavMapSettings, with_camera
from toolkit.samples.make import SampleSettings, make_sample
from toolkit.scene import PosePrior, Scene
from toolkit.scene.dataset import capture_fingerprint
from toolkit.scene.mesh_files import read_cloud
from toolkit.splat.map_file import read_map
from toolkit.workspace import Workspace

FLIGHT = {
    "town.extent": 150.0,
    "town.buildings": 15,
    "town.trees": 8,
    "town.mast": False,
    "flight.pattern": "lawnmower",
    "flight.frames": 15,
    "flight.height": 60.0,
    "flight.radius": 22.0,
    "flight.side_overlap": 60.0,
    "flight.image_width": 160,
    "flight.image_height": 120,
    "flight.samples": 1,
    "sensors.position_sigma_east": 0.2,
    "sensors.position_sigma_north": 0.2,
    "sensors.position_sigma_up": 0.2,
    "points": 500,
}
QUICK = {
    "features.max_features": 1500,
    "sfm.init_min_inliers": 30,
    "sfm.init_min_angle": 4.0,
    "sfm.multiple_models": False,
    "sfm.threads": 1,
    "sfm.refine_focal": False,
    "sfm.refine_distortion": False,
    "sfm.refine_principal_point": False,
    "stereo.search.levels": 2,
    "stereo.search.iterations": 2,
    "stereo.search.radius": 3,
    "stereo.search.geometric": False,
    "stereo.choice.views": 3,
    "train.steps": 24,
    "train.max_side": 80,
    "train.sh_degree": 1,
    "train.max_gaussians": 3000,
    "most_dense": 1200,
}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> RecipeInput:
    truth = make_sample(tmp_path_factory.mktemp("flight") / "town", SampleSettings().replace(FLIGHT))
    frames = [dataclasses.replace(f, split="test" if i % 3 == 1 else "train") for i, f in enumerate(truth.frames)]
    truth = truth.replace(frames=tuple(frames))
    return RecipeInput(truth.without_poses(), truth, capture_fingerprint(truth))


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return Workspace(tmp_path_factory.mktemp("stages"))


def context_in(folder: Path, workspace: Workspace) -> RecipeContext:
    return RecipeContext(workspace, folder / "artifacts", folder / "checkpoint", 0, "cpu", silent)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("run")


@pytest.fixture(scope="module")
def built(data: RecipeInput, workspace: Workspace, place: Path) -> BuiltMap:
    return map_stages(data, MapSettings().replace(QUICK), context_in(place, workspace))


def test_the_map_is_of_its_own_photos_and_the_queries_are_placed_in_it(built: BuiltMap, data: RecipeInput) -> None:
    metrics = built.metrics
    assert metrics["sfm.images"] == metrics["sfm.registered"] == 10
    assert metrics["queries"] == metrics["queries.placed"] == 5
    assert len(built.scene.of_split("test")) == 5
    points = built.scene.points
    assert points is not None
    assert points.tracks is not None
    queries = {i for i, frame in enumerate(data.scene.frames) if frame.split == "test"}
    assert not queries & set(points.tracks.frame.tolist())
    # In metres, east-north-up: cameras of known focal length at 60 m, pictures of 160 pixels (0.5 m each).
    assert built.scene.georeference == data.scene.georeference
    for split in ("train", "test"):
        assert (metrics[f"poses.{split}.none.pos"] or math.inf) < 0.6
    assert 0 < (metrics["sfm.position_residual"] or math.inf) < 0.8
    assert built.scene.cameras == data.scene.cameras
    assert [frame.split for frame in built.scene.frames] == [frame.split for frame in data.scene.frames]


def test_the_gaussians_are_in_metres_and_know_where_they_began(built: BuiltMap, place: Path) -> None:
    middle = built.gaussians.means.median(dim=0).values
    # The ground is at 0 and the cameras are at 60.
    assert -3 < float(middle[2]) < 15
    assert built.metrics["splat.initial"] == built.metrics["sfm.points"]
    trained = next(stage for stage in built.stages if stage.time.name == "train-map")
    origins = load_file(trained.folder / ORIGINS)["origins"]
    assert origins.shape == built.gaussians.means.shape
    assert built.scene.points is not None
    apart = np.linalg.norm(origins.numpy()[:50, None] - built.scene.points.xyz[None], axis=2).min(axis=1)
    # To and from normalised units in float32.
    assert apart.max() < 1e-3


def test_both_checkpoints_are_told_with_queries_and_photos_apart(built: BuiltMap) -> None:
    early, late = built.trained["checkpoints"]
    assert (early["step"], late["step"]) == (round(EARLY * 24), 24)
    assert late["psnr_training"] > early["psnr_training"]
    assert late["psnr_test"] == built.metrics["test.psnr"]
    assert late["psnr_training"] == built.metrics["training.psnr"]
    assert early["psnr_test"] == built.metrics["test.psnr.early"]
    assert late["psnr_test"] != late["psnr_training"]
    assert late["gaussians"] == built.metrics["splat.gaussians"] == len(built.gaussians)
    assert 0 < early["seconds"] < late["seconds"]


def test_its_geometry_is_measured(built: BuiltMap, place: Path) -> None:
    report, metrics = built.reports["map-geometry"], built.metrics
    assert set(report["depth"]["all"]) == {"bias", "spread", "std", "within", "pixels"}
    # Stereo at a third of a metre a pixel; what 24 steps of training leave is not judged.
    assert abs(metrics["map.stereo_bias"] or math.inf) < 0.5
    assert (metrics["map.stereo_spread"] or math.inf) < 0.5
    assert 0 < (metrics["map.reliable_share"] or 0) <= 1
    assert metrics["map.c2c_median"] == report["centres_to_cloud"]["all"]["median"]
    assert metrics["map.moved_vertical"] == report["displacement"]["all"]["vertical"]["median"]
    tensors = load_file(place / "artifacts" / GEOMETRY)
    assert float(tensors["distance"].median()) == pytest.approx(metrics["map.c2c_median"], rel=0.02)
    assert set(tensors) == {"centres", "distance", "horizontal", "vertical", "opacity"}


def test_the_artifacts_are_a_map_that_can_be_opened(built: BuiltMap, place: Path) -> None:
    stored = read_map(place / "artifacts")
    assert torch.equal(stored.gaussians.means, built.gaussians.means)
    assert stored.kind == "2d"
    assert stored.georeference == built.scene.georeference
    assert stored.counts["sparse"] == built.metrics["sfm.points"]
    assert stored.counts["dense"] == built.metrics["fused.points"]
    assert stored.settings["steps"] == 24
    assert len(read_cloud(place / "artifacts" / "fused.ply")) == built.metrics["fused.points"]
    json.dumps(built.reports, allow_nan=False)


def test_another_start_reuses_all_that_comes_before(
    built: BuiltMap, data: RecipeInput, workspace: Workspace, tmp_path: Path
) -> None:
    settings = MapSettings().replace({**QUICK, "start": "dense"})
    dense = map_stages(data, settings, context_in(tmp_path, workspace))
    assert [s.time.name for s in dense.stages if not s.time.reused] == ["train-map", "map-geometry"]
    points = dense.trained["points"]
    assert 600 < points["thinned"] == points["initial"] <= 1200
    assert points["dense_per_sparse"] == points["dense"] / points["sparse"]
    again = map_stages(data, settings, context_in(tmp_path, workspace))
    assert all(stage.time.reused for stage in again.stages)
    assert again.metrics == dense.metrics


def test_queries_are_matched_with_map_photos_only(data: RecipeInput) -> None:
    roles = [frame.split for frame in data.scene.frames]
    for method in ("exhaustive", "sequential", "spatial"):
        pairs = map_pairs(data.scene, PairSettings(method=method, overlap=2, quadratic=False, neighbours=3))
        kinds = {(roles[i], roles[j]) for i, j in pairs.index}
        assert ("test", "test") not in kinds
        assert ("train", "train") in kinds
        partners = [
            sum(int(i in pair) for pair in pairs.index.tolist()) for i, r in enumerate(roles) if r == "test"
        ]
        expected = {"exhaustive": 10, "sequential": 4, "spatial": 3}[method]
        assert partners == [expected] * 5
        assert np.all(pairs.index[:, 0] < pairs.index[:, 1])


def test_a_query_without_position_is_matched_with_all_map_photos(data: RecipeInput) -> None:
    bare = dataclasses.replace(data.scene.frames[1], prior=None)
    scene = data.scene.replace(frames=(data.scene.frames[0], bare, *data.scene.frames[2:]))
    pairs = map_pairs(scene, PairSettings(method="spatial", neighbours=3))
    assert sum(1 in pair for pair in pairs.index.tolist()) == 10


def test_queries_far_from_every_map_photo_are_matched_with_none(data: RecipeInput) -> None:
    far = dataclasses.replace(data.scene.frames[1], prior=PosePrior(np.array([9000.0, 0, 60])))
    scene = data.scene.replace(frames=(data.scene.frames[0], far, *data.scene.frames[2:]))
    pairs = map_pairs(scene, PairSettings(method="spatial", neighbours=3, max_distance=100.0))
    assert not any(1 in pair for pair in pairs.index.tolist())


@pytest.mark.parametrize("split", ["train", "test"])
def test_a_capture_of_one_kind_is_refused(data: RecipeInput, workspace: Workspace, tmp_path: Path, split) -> None:
    frames = tuple(dataclasses.replace(frame, split=split) for frame in data.scene.frames)
    only = RecipeInput(data.scene.replace(frames=frames), None, "one kind")
    found = "15 and 0" if split == "train" else "0 and 15"
    with pytest.raises(StageError, match=rf"photos of both kinds; .*found {found}\. Tell in scene\.json"):
        map_stages(only, MapSettings(), context_in(tmp_path, workspace))


def test_a_world_without_positions_has_no_residuals(data: RecipeInput, built: BuiltMap) -> None:
    assert position_residuals(built.scene.replace(georeference=None)) is None
    bare = tuple(dataclasses.replace(frame, prior=None) for frame in built.scene.frames)
    assert position_residuals(built.scene.replace(frames=bare)) is None
    moved = [
        dataclasses.replace(frame, prior=PosePrior(frame.cam_from_world.centre + np.array([3.0, 0.0, -4.0])))
        for frame in built.scene.frames
        if frame.cam_from_world is not None
    ]
    told = position_residuals(built.scene.replace(frames=tuple(moved), points=None))
    assert told is not None
    assert told["frames"] == 10
    assert told["median"] == pytest.approx(5.0)
    assert (told["median_horizontal"], told["median_vertical"]) == (pytest.approx(3.0), pytest.approx(4.0))


def test_a_dense_start_without_colours_is_grey(data: RecipeInput) -> None:
    scene: Scene = data.scene
    points, counts = start_points(scene, Cloud(np.random.default_rng(0).random((30, 3))), "dense", 100)
    assert points is not None
    assert np.all(points.rgb == 128)
    assert counts == {"sparse": 0.0, "dense": 30.0, "dense_per_sparse": 30.0, "thinned": 30.0, "voxel": 0.0}


def test_the_held_map_runs_to_poses_of_its_queries(data: RecipeInput, workspace: Workspace, tmp_path: Path) -> None:
    """The whole recipe: stages up to stereo's are those of the other maps, and every part leaves its measures."""
    quick = {
        **QUICK,
        "scenarios.methods": "ours",
        "scenarios.sfm_train": False,
        "ours.polish.use": False,
        "ours.fan.most": 0,
        "ours.judge.min_inliers": 8,
        "ours.judge.min_likeness": -1.0,
    }
    settings = HELD.settings_type().replace(quick)
    assert settings.depth_loss.weight > 0
    result = HELD.run(data, settings, context_in(tmp_path, workspace))
    reused = [time.name for time in result.times if time.reused]
    assert "stereo" in reused
    assert "train-map" not in reused
    assert result.gaussians is not None
    assert len(result.test_views) == 5
    for scenario in ("sfm-test", "calc-test", "sfm-test-pos10"):
        # 24 steps make no map to be found in; that every query has an answer, and is counted, is what counts here.
        record = read_json(tmp_path / "artifacts" / "localize" / f"ours.{scenario}.json")
        rows, key = record["queries"], f"localize.ours.{scenario}"
        assert len(rows) == 5
        assert all(row["found"] != bool(row["reason"]) for row in rows)
        assert result.metrics[f"{key}.found"] == pytest.approx(sum(row["found"] for row in rows) / 5)
        assert (result.metrics[f"{key}.mte_m"] is None) == (not any(row["found"] for row in rows))
    assert result.metrics["test.psnr"] is not None


def test_depth_that_is_held_follows_stereo(data: RecipeInput, workspace: Workspace, tmp_path: Path) -> None:
    longer = {**QUICK, "start": "dense", "train.steps": 150, "depth_loss.final_weight": 0.0}
    spread = {}
    for weight in (0.0, 1.0):
        built = map_stages(
            data,
            MapSettings().replace({**longer, "depth_loss.weight": weight}),
            context_in(tmp_path / str(weight), workspace),
        )
        spread[weight] = built.metrics["map.depth_spread_all"]
    assert spread[0.0] is not None
    assert spread[1.0] is not None
    assert spread[1.0] < spread[0.0]


@pytest.mark.parametrize(("camera", "told", "refined"), [("auto", True, False), ("auto", False, True)])
@pytest.mark.parametrize("forced", ["", "keep", "refine"])
def test_known_cameras_are_kept(
    data: RecipeInput, tmp_path: Path, camera: str, told: bool, refined: bool, forced: str
) -> None:
    (tmp_path / "images").mkdir()
    if told:
        (tmp_path / "scene.json").write_text("{}")
    moved = dataclasses.replace(data, scene=data.scene.replace(image_dir=tmp_path / "images"))
    settings = with_camera(UavMapSettings(camera=forced or camera), moved)
    assert settings.sfm.refine_focal is {"": refined, "keep": False, "refine": True}[forced]
    assert settings.sfm.use_positions
