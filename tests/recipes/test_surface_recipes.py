"""Recipes mvs-poisson and depth-fusion on a small computed engine with its true poses."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toolkit.depth.dense_folder import open_depth_views
from toolkit.errors import SettingsError, StageError
from toolkit.geometry.ray_casting import MeshCaster
from toolkit.progress import silent
from toolkit.recipes import depth_fusion, mvs_poisson
from toolkit.recipes.available import missing_here
from toolkit.recipes.base import RecipeContext, RecipeInput, RecipeResult
from toolkit.recipes.depth_fusion import DepthFusionSettings
from toolkit.recipes.mvs_poisson import MvsPoissonSettings
from toolkit.recipes.registry import find_recipe
from toolkit.samples.engine import EngineSettings, make_engine
from toolkit.samples.surfaces import true_surface
from toolkit.scene.dataset import capture_fingerprint, open_capture
from toolkit.scene.mesh_files import read_cloud, read_mesh
from toolkit.workspace import Workspace

FOOTAGE = {
    "rotor.blades": 24,
    "film.frames": 6,
    "film.step": 2.0,
    "film.samples": 1,
    "borescope.image_width": 200,
    "borescope.image_height": 150,
    "borescope.casing": 0.0,
    "borescope.icon": False,
    "points": 2000,
}
QUICK = {
    "scene.way": "given",
    "stereo.search.levels": 2,
    "stereo.search.iterations": 2,
    "stereo.search.radius": 4,
    "stereo.choice.views": 3,
    "stereo.choice.best_angle": 5.0,
    "poisson.depth": 6,
}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> RecipeInput:
    engine = make_engine(tmp_path_factory.mktemp("surface") / "engine", EngineSettings().replace(FOOTAGE))
    capture = open_capture(engine.folder)
    return RecipeInput(capture.scene, capture.reference, capture_fingerprint(capture.scene))


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return Workspace(tmp_path_factory.mktemp("stages"))


def context_in(folder: Path, workspace: Workspace) -> RecipeContext:
    (folder / "artifacts").mkdir(parents=True)
    return RecipeContext(workspace, folder / "artifacts", folder / "checkpoint", 0, "cpu", silent)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("run")


@pytest.fixture(scope="module")
def stereo(data: RecipeInput, workspace: Workspace, place: Path) -> RecipeResult:
    return mvs_poisson.run(data, MvsPoissonSettings().replace(QUICK), context_in(place, workspace))


def test_pictures_become_a_mesh(stereo: RecipeResult, place: Path) -> None:
    metrics = stereo.metrics
    assert metrics["stereo.images"] == 6
    assert (metrics["stereo.coverage"] or 0) > 0.15
    assert (metrics["stereo.seconds_per_megapixel"] or 0) > 0
    assert (metrics["fused.points"] or 0) > 1000
    # Against the true depth of the rotor, in pictures of 200 pixels.
    assert (metrics["depth.median_error"] or 1) < 0.02
    assert (metrics["depth.within_1pct"] or 0) > 0.4
    assert math.isfinite(metrics["mesh.accuracy"] or math.nan)
    names = [time.name for time in stereo.times]
    assert names == ["given", "undistort", "stereo", "fusion", "poisson", "measure"]
    artifacts = place / "artifacts"
    assert len(read_mesh(artifacts / "mesh.ply").faces) == stereo.reports["mesh"]["faces_in_file"]
    assert len(read_cloud(artifacts / "fused.ply")) == metrics["fused.points"]
    assert len(open_depth_views(artifacts / "dense")) == 6
    assert not (place / "checkpoint" / "dense").exists()
    assert stereo.gaussians is None


def test_only_what_a_setting_touches_is_done_again(
    stereo: RecipeResult, data: RecipeInput, workspace: Workspace, tmp_path: Path
) -> None:
    settings = MvsPoissonSettings().replace({**QUICK, "fusion.min_pixels": 2})
    again = mvs_poisson.run(data, settings, context_in(tmp_path, workspace))
    assert {time.name for time in again.times if time.reused} == {"given", "undistort", "stereo"}
    assert (again.metrics["fused.points"] or 0) > (stereo.metrics["fused.points"] or 0)


@pytest.fixture(scope="module")
def arrays(stereo: RecipeResult, data: RecipeInput, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return true depth of the undistorted pictures, each with its own scale and shift."""
    assert data.reference is not None
    caster = MeshCaster(true_surface(data.reference.image_dir.parent))
    folder = tmp_path_factory.mktemp("arrays")
    for number, frame in enumerate(stereo.scene.registered):
        assert frame.cam_from_world is not None
        depth: Any = caster.depth(stereo.scene.camera_of(frame), frame.cam_from_world)
        np.save(folder / f"{frame.name}.npy", np.where(depth > 0, depth * (3 + number) + 0.05, 0))
    return folder


@pytest.mark.parametrize("use", ["replace", "fill"])
def test_external_depth_is_fused(
    use: str, stereo: RecipeResult, data: RecipeInput, workspace: Workspace, arrays: Path, tmp_path: Path
) -> None:
    settings = DepthFusionSettings().replace(
        {
            **QUICK,
            "external.use": use,
            "external.depth.arrays": str(arrays),
            "external.depth.kind": "affine-depth",
        }
    )
    assert missing_here(settings) == ""
    result = depth_fusion.run(data, settings, context_in(tmp_path, workspace))
    assert result.metrics["external.images"] == 6
    assert result.metrics["external.left_out"] == 0
    assert (result.metrics["fused.points"] or 0) > (stereo.metrics["fused.points"] or 0)
    assert ("stereo" in result.reports) == (use == "fill")
    if use == "replace":
        # The truth but for what the fit to the points leaves.
        assert (result.metrics["depth.median_error"] or 1) < 0.005


def test_what_is_missing_is_told_before_anything_is_done(
    data: RecipeInput, workspace: Workspace, tmp_path: Path
) -> None:
    settings = find_recipe("depth-fusion").settings_type()
    assert missing_here(settings) == "depth maps missing: external.depth.arrays names no folder"
    with pytest.raises(SettingsError, match="needs a folder"):
        depth_fusion.run(data, settings, context_in(tmp_path / "a", workspace))
    bare = dataclasses.replace(data, reference=None)
    given = MvsPoissonSettings().replace({"scene.way": "given"})
    with pytest.raises(StageError, match="no poses of its own"):
        mvs_poisson.run(bare, given, context_in(tmp_path / "b", workspace))
    assert find_recipe("mvs-poisson").settings_type is MvsPoissonSettings
