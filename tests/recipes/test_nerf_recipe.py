"""The recipes nerf and ds-nerf, from a small computed engine to test views and a mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toolkit.errors import SettingsError, StageError
from toolkit.nerf.settings import DsNerfSettings, NerfSettings
from toolkit.nerf.space import Space
from toolkit.progress import ProgressEvent
from toolkit.recipes.base import RecipeContext, RecipeInput
from toolkit.recipes.nerf import DS_NERF, NERF, DsNerfRecipeSettings, NerfRecipeSettings, _mesh
from toolkit.recipes.presets import recipe_presets, with_preset
from toolkit.recipes.registry import find_recipe
from toolkit.samples.engine import EngineSettings, make_engine
from toolkit.scene import Points
from toolkit.scene.dataset import capture_fingerprint, open_capture
from toolkit.workspace import Workspace

FOOTAGE = {
    "rotor.blades": 24,
    "film.frames": 6,
    "film.step": 1.0,
    "film.samples": 1,
    "borescope.image_width": 96,
    "borescope.image_height": 72,
    "points": 300,
}
QUICK = {
    "train.max_side": 48,
    "train.steps": 30,
    "train.budget": 4000,
    "train.samples": 48,
    "train.asked": 16,
    "train.occupancy": 16,
    "train.hash_grid.log2_size": 12,
    "train.hash_grid.levels": 4,
    "train.hash_grid.width": 16,
    "mesh.opaque": 0.5,
    "mesh.marching.resolution": 24,
}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> RecipeInput:
    engine = make_engine(tmp_path_factory.mktemp("nerf") / "engine", EngineSettings().replace(FOOTAGE))
    capture = open_capture(engine.folder)
    return RecipeInput(capture.scene, capture.reference, capture_fingerprint(capture.scene))


def context_in(folder: Path, told: list[ProgressEvent]) -> RecipeContext:
    return RecipeContext(
        Workspace(folder / "stages"), folder / "artifacts", folder / "checkpoint", 0, "cpu", told.append
    )


def test_given_poses_become_a_field_with_test_views_and_a_mesh(data: RecipeInput, tmp_path: Path) -> None:
    told: list[ProgressEvent] = []
    result = NERF.run(data, NerfRecipeSettings().replace(QUICK).frozen(), context_in(tmp_path, told))

    assert result.gaussians is None
    assert result.metrics["test.views"] == 1
    psnr = result.metrics["test.psnr"]
    assert psnr is not None
    assert psnr > 8
    assert result.metrics["nerf.steps"] == 30
    assert result.metrics["nerf.keypoints"] == 0
    depth = result.metrics["depth.median"]
    assert depth is not None
    assert 0 < depth < 0.1  # metres; the camera is 15 centimetres from these blades
    assert [time.name for time in result.times] == ["given", "train", "measure", "mesh"]
    artifacts = tmp_path / "artifacts"
    assert (artifacts / result.test_views[0].render).is_file()
    assert (artifacts / "field.safetensors").is_file()
    assert (artifacts / "live" / "view.json").is_file()
    assert any("psnr_test" in event.values for event in told if event.stage == "nerf.train")
    # A field of 30 steps may be thin everywhere: then there is no mesh, and the report says so.
    assert (artifacts / "mesh.ply").is_file() or "reason" in result.reports["mesh"]
    result.to_dict()


class BallField:
    """A ball of fog of radius one, as the mesh step asks a field."""

    space = Space((-2.0,) * 3, (2.0,) * 3, 0.1, False)
    bounds = np.array([space.low, space.high])

    def density(self, points: np.ndarray) -> np.ndarray:
        return np.where(np.linalg.norm(points, axis=1) < 1, 100.0, 0.0).astype(np.float32)

    def colour(self, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
        return np.full((len(points), 3), 0.5, np.float32)


def test_the_mesh_is_clipped_to_the_sparse_points(data: RecipeInput, tmp_path: Path) -> None:
    upper = np.random.default_rng(0).standard_normal((400, 3))
    upper = np.abs(upper) / np.linalg.norm(upper, axis=1, keepdims=True)  # an eighth of the ball
    scene = data.scene.replace(points=Points(upper, np.zeros((400, 3), np.uint8)))
    field: Any = BallField()
    bare = RecipeInput(scene, None, "")
    tried = {"mesh.opaque": 0.02, "mesh.marching.resolution": 24}
    found = {}
    for spacings in (0, 2):
        settings = NerfRecipeSettings().replace({**tried, "mesh.clip.spacings": spacings})
        context = context_in(tmp_path / str(spacings), [])
        context.artifacts.mkdir(parents=True)
        found[spacings] = _mesh(field, scene, bare, settings, context)
    whole, clipped = (found[spacings][0]["mesh.faces"] for spacings in (0, 2))
    # An eighth and its rim.
    assert 0.1 * whole < clipped < 0.3 * whole
    assert found[2][1]["mesh"]["clipped_faces"] == whole - clipped
    few = scene.replace(points=Points(upper[:5], np.zeros((5, 3), np.uint8)))
    metrics, report = _mesh(field, few, bare, NerfRecipeSettings().replace(tried), context)
    assert metrics == {"mesh.faces": None}
    assert "Too few points for a spacing" in report["mesh"]["reason"]


def test_depth_needs_points_that_frames_saw(data: RecipeInput, tmp_path: Path) -> None:
    # So few pixels have no features to triangulate from.
    few = {**QUICK, "scene.points.sift.max_features": 16}
    with pytest.raises(StageError, match="No point could be triangulated|no depth to learn from|lies"):
        DS_NERF.run(data, DsNerfRecipeSettings().replace(few).frozen(), context_in(tmp_path, []))


def test_presets_are_those_of_each_recipe() -> None:
    assert find_recipe("nerf") is NERF
    assert find_recipe("ds-nerf") is DS_NERF
    assert list(recipe_presets(NERF)) == ["draft", "paper"]
    paper = with_preset(DsNerfRecipeSettings(), "paper").train
    assert isinstance(paper, DsNerfSettings)
    assert (paper.steps, paper.steps_count, paper.fine_samples) == (50_000, "per-40-frames", 0)
    nerf = with_preset(NerfRecipeSettings(), "paper").train
    assert (nerf.steps, nerf.steps_count, nerf.fine_samples, nerf.lr) == (30, "epochs", 128, 5e-4)
    assert with_preset(NerfRecipeSettings(), "draft").train.to_dict() == NerfSettings().to_dict()
    with pytest.raises(SettingsError, match="Unknown preset 'standard'; expected one of draft, paper"):
        with_preset(NerfRecipeSettings(), "standard")
