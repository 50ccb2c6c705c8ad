"""cf-3dgs and noposegs from a capture without poses to their measures; and the depth that they start from."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from toolkit.depth.monocular import DepthPrediction
from toolkit.depth.settings import DepthSettings
from toolkit.errors import StageError, WeightsMissingError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.progress import silent
from toolkit.recipes.base import RecipeContext, RecipeInput
from toolkit.recipes.cf_3dgs import Cf3dgsRecipeSettings
from toolkit.recipes.flat_capture import flat_capture
from toolkit.recipes.frame_depth import FrameDepth, frame_depth, unscaled_depth
from toolkit.recipes.noposegs import NoposegsSettings
from toolkit.recipes.registry import find_recipe
from toolkit.recipes.steps import SCENE
from toolkit.runs.paper_rows import ROWS
from toolkit.samples import SampleSettings, make_sample
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene
from toolkit.workspace import Workspace

QUICK = {
    "chain.local.steps": 25,
    "chain.pose.steps": 40,
    "chain.points_per_frame": 200,
    "train.steps": 20,
    "train.sh_degree": 1,
    "train.refine_test_steps": 2,
}


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Scene]:
    folder = tmp_path_factory.mktemp("pose_free") / "flight"
    small = {
        "flight.frames": 5,
        "flight.arc": 15.0,
        "flight.image_width": 80,
        "flight.image_height": 60,
        "flight.samples": 1,
        "points": 100,
    }
    return folder, make_sample(folder, SampleSettings().replace(small), seed=1)


def given(flight: tuple[Path, Scene]) -> RecipeInput:
    return RecipeInput(flight[1].without_poses(), flight[1], "town")


def context(folder: Path) -> RecipeContext:
    for name in ("artifacts", "checkpoint"):
        (folder / name).mkdir()
    return RecipeContext(
        Workspace(folder / "workspace"), folder / "artifacts", folder / "checkpoint", 0, "cpu", silent
    )


def with_arrays(flight: tuple[Path, Scene]) -> dict[str, str]:
    return {"depth.provider": "arrays", "depth.arrays": str(flight[0] / "depth")}


def test_cf_3dgs_runs_to_its_measures(flight: tuple[Path, Scene], tmp_path: Path) -> None:
    settings = Cf3dgsRecipeSettings().replace({**QUICK, **with_arrays(flight)})
    result = find_recipe("cf-3dgs").run(given(flight), settings, context(tmp_path))
    assert [time.name for time in result.times] == ["flatten", "compile", "cf-3dgs", "measure"]
    assert result.reports["cf-3dgs"]["reason"] == ""
    assert result.metrics["cf3dgs.registered"] == result.metrics["cf3dgs.frames"] == 4
    assert result.metrics["poses.sim3.ate"] is not None
    assert result.metrics["poses.sim3.ate"] < 1.0  # of 12 m
    assert result.metrics["test.views"] == result.metrics["test_refined.views"] == 1
    assert result.reports["depth"]["provider"] == "arrays"
    assert result.reports["depth"]["substitute"] is True
    assert result.gaussians is not None
    # The test frame was drawn from a pose beside the first one for training, which nobody found.
    assert len(result.scene.registered) == 4
    assert result.metrics["test.views"] == 1
    assert (tmp_path / "artifacts" / result.test_views[0].render).is_file()
    json.dumps(result.to_dict(), allow_nan=False)


def test_cf_3dgs_without_a_network_says_that_the_ground_stood_in(
    flight: tuple[Path, Scene], tmp_path: Path
) -> None:
    row = next(row for row in ROWS if row.key == "cf-3dgs-ground")
    recipe = find_recipe(row.recipe)
    settings = recipe.settings_type().replace({**QUICK, **row.changes})
    result = recipe.run(given(flight), settings, context(tmp_path))
    assert result.reports["depth"] == {
        "provider": "ground",
        "source": "ground plane at z = 0 m",
        "substitute": True,
    }
    assert result.metrics["cf3dgs.registered"] == result.metrics["cf3dgs.frames"] == 4


def test_noposegs_chains_and_then_refines(flight: tuple[Path, Scene], tmp_path: Path) -> None:
    settings = NoposegsSettings().replace({**QUICK, **with_arrays(flight)})
    result = find_recipe("noposegs").run(given(flight), settings, context(tmp_path))
    assert [time.name for time in result.times][:2] == ["flatten", "chain"]
    assert result.metrics["chain.registered"] == result.metrics["chain.frames"] == 4
    assert result.metrics["start.sim3.ate"] is not None
    assert result.metrics["start.sim3.ate"] < 1.0  # of 12 m
    assert result.metrics["poses.sim3.ate"] is not None
    assert result.metrics["poses.sim3.ate"] != result.metrics["start.sim3.ate"]  # they were refined
    assert result.reports["chain"]["depth"]["provider"] == "arrays"
    assert len(result.reports["train"]["poses"]) == 4
    assert len(result.scene.registered) == 4  # without the test frame, whose pose nobody found
    assert result.metrics["test_refined.views"] == 1
    json.dumps(result.to_dict(), allow_nan=False)


def test_noposegs_without_a_network_says_that_a_plane_stood_in(flight: tuple[Path, Scene], tmp_path: Path) -> None:
    loose = {"chain.pose.steps": 4, "chain.local.steps": 0, "chain.pose.max_loss": 2.0, "train.steps": 3}
    settings = NoposegsSettings(start="plane").replace({**QUICK, **loose})
    result = find_recipe("noposegs").run(given(flight), settings, context(tmp_path))
    assert result.reports["chain"]["depth"] == {
        "provider": "plane",
        "source": "a plane across the view",
        "substitute": True,
    }


def test_noposegs_without_any_motion_is_an_error(flight: tuple[Path, Scene], tmp_path: Path) -> None:
    strict = {"chain.pose.steps": 2, "chain.local.steps": 0, "chain.pose.max_loss": 1e-4}
    settings = NoposegsSettings(start="plane").replace({**QUICK, **strict})
    with pytest.raises(StageError, match=r"No motion between frames.*found frame 'frame_0002.jpg': not converged"):
        find_recipe("noposegs").run(given(flight), settings, context(tmp_path))


@pytest.mark.parametrize("name", ["cf-3dgs", "noposegs"])
def test_missing_weights_are_told_before_anything_is_done(
    flight: tuple[Path, Scene], tmp_path: Path, name: str
) -> None:
    recipe = find_recipe(name)
    settings = recipe.settings_type().replace({"depth.weights": str(tmp_path / "no weights")})
    with pytest.raises(WeightsMissingError, match=r"[Ww]eights"):
        recipe.run(given(flight), settings, context(tmp_path))
    assert not (tmp_path / "workspace").exists()


def test_the_ground_below_the_sensors_may_stand_in_for_a_network(flight: tuple[Path, Scene]) -> None:
    folder, scene = flight
    source = frame_depth(scene.without_poses(), DepthSettings(provider="ground"))
    frame = scene.frames[2]
    assert source.to_dict()["substitute"] is True
    depth = source(frame)
    assert depth.shape == (60, 80)
    with np.load(folder / "depth" / f"{frame.name}.npz") as stored:
        true = stored["depth"]
    # Most of the view is ground; houses stand above it, GPS is off by a metre or two and the gimbal by a degree.
    assert np.nanmedian(np.abs(depth / np.where(true > 0, true, np.nan) - 1)) < 0.15


def test_unscaled_depth_keeps_metres_and_turns_disparities_round() -> None:
    values = np.array([[1.0, 2.0, 4.0], [0.0, -1.0, np.nan]], dtype=np.float32)
    metric = unscaled_depth(DepthPrediction(values, "metric"))
    np.testing.assert_allclose(metric[0], [1, 2, 4])
    depth = unscaled_depth(DepthPrediction(values, "affine-depth"))
    np.testing.assert_allclose(depth[0], [0.5, 1, 2])
    disparity = unscaled_depth(DepthPrediction(values, "affine-disparity"))
    np.testing.assert_allclose(disparity[0], [2, 1, 0.5])
    assert np.isnan([metric[1], depth[1], disparity[1]]).all()
    assert np.isnan(unscaled_depth(DepthPrediction(values[1:], "affine-depth"))).all()


class Doubtful:
    """A provider that is sure of one pixel, or of none."""

    name = "doubtful"

    def __init__(self, sure: float) -> None:
        self._sure = sure

    def predict(self, scene, frame) -> DepthPrediction:
        confidence = np.zeros((2, 2), np.float32)
        confidence[0, 1] = self._sure
        return DepthPrediction(np.full((2, 2), 3.0, np.float32), "metric", confidence)


def test_what_the_provider_doubts_has_no_depth(flight: tuple[Path, Scene]) -> None:
    scene, settings = flight[1], DepthSettings(min_confidence=0.5)
    depth = FrameDepth(Doubtful(0.9), settings, scene)(scene.frames[0])
    np.testing.assert_array_equal(depth, [[np.nan, 3], [np.nan, np.nan]])
    with pytest.raises(StageError, match=r"Frame 'frame_0000.jpg' has no depth \(doubtful\)"):
        FrameDepth(Doubtful(0.1), settings, scene)(scene.frames[0])


def test_a_distorted_capture_is_flattened_before_there_are_poses(
    flight: tuple[Path, Scene], tmp_path: Path
) -> None:
    _, scene = flight
    bent = ColmapCamera("SIMPLE_RADIAL", 80, 60, (63.0, 40.0, 30.0, -0.1))
    data = replace(given(flight), scene=scene.without_poses().replace(cameras={1: bent}))
    flat = read_scene(flat_capture(data, context(tmp_path)).folder / SCENE)
    camera = flat.cameras[1]
    assert isinstance(camera, ColmapCamera)
    assert camera.is_pinhole
    assert flat.registered == ()
    assert [frame.split for frame in flat.frames] == [frame.split for frame in scene.frames]
    with Image.open(flat.image_path(flat.frames[0])) as picture:
        assert picture.size == (camera.width, camera.height)
