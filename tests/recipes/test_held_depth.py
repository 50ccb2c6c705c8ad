"""Predicted depth that a splat's is held to: which predictions are kept, and for which photos."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

import toolkit.scene
from toolkit.depth.monocular import DepthKind, DepthPrediction
from toolkit.depth.settings import DepthSettings
from toolkit.errors import WeightsMissingError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.progress import silent
from toolkit.recipes.base import RecipeContext
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.held_depth import HeldDepth, held_depth
from toolkit.recipes.steps import SCENE
from toolkit.scene import Frame, Scene
from toolkit.scene.folder import write_scene
from toolkit.splat.depth_settings import DepthLossSettings
from toolkit.workspace import Workspace

WIDTH, HEIGHT = 1200, 30
ROOM: tuple[ModuleType, ...] = (toolkit.scene,)


class Ramp:
    """Predicts a ramp along rows, with doubts on the right half, and counts how often it is asked."""

    name = "a ramp"

    def __init__(self, kind: DepthKind = "affine-disparity") -> None:
        self.kind, self.asked = kind, list[str]()

    def predict(self, scene: Scene, frame: Frame) -> DepthPrediction:
        self.asked.append(frame.name)
        camera = scene.camera_of(frame)
        values = np.broadcast_to(np.arange(camera.width, dtype=np.float32) + 0.5, (camera.height, camera.width))
        return DepthPrediction(values, self.kind, (values < camera.width / 2).astype(np.float32))


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    folder = tmp_path / "pictures"
    folder.mkdir()
    frames = tuple(
        Frame(f"{i}.png", 1, RigidTransform.identity(), split="test" if i == 1 else "train") for i in range(3)
    )
    for frame in frames:
        Image.new("RGB", (WIDTH, HEIGHT)).save(folder / frame.name)
    return Scene(folder, {1: ColmapCamera.pinhole(WIDTH, HEIGHT, 500.0)}, frames)


@pytest.fixture
def run(tmp_path: Path) -> RecipeContext:
    return RecipeContext(
        Workspace(tmp_path / "work"), tmp_path / "artifacts", tmp_path / "checkpoint", 0, "cpu", silent
    )


def flat_stage(scene: Scene, run: RecipeContext) -> CachedStage:
    def build(folder: Path) -> dict[str, int]:
        write_scene(scene, folder / SCENE)
        return {}

    return cached_stage(run, "undistort", inputs={}, settings=None, code=ROOM, build=build)


def held(provider: Ramp, **source: object) -> HeldDepth:
    settings = DepthSettings(provider="ground").replace(source)
    return HeldDepth(provider, settings, DepthLossSettings(weight=0.03))


def test_training_photos_are_predicted_once_and_kept_small(scene: Scene, run: RecipeContext) -> None:
    ramp, flat = Ramp(), flat_stage(scene, run)
    maps = held(ramp).stage(flat, SCENE, run)
    again = held(ramp).stage(flat, SCENE, run)
    assert again.time.reused
    assert ramp.asked == ["0.png", "2.png"]
    assert maps.report == {"images": 2, "source": "a ramp", "kinds": ["affine-disparity"]}
    predicted = held(ramp).predicted(again, scene)
    assert predicted.predicts == "disparity"
    assert predicted.settings.weight == 0.03
    assert set(predicted.values) == {"0.png", "2.png"}
    kept = predicted.values["2.png"]
    assert kept.shape == (20, 800)
    assert kept.dtype == np.float32
    # By area: of the ramp, which has steps, up to a twelfth of a step off.
    np.testing.assert_allclose(kept[7, :100], 1.5 * (np.arange(100) + 0.5), atol=0.084)


def test_what_is_doubtful_is_left_out(scene: Scene, run: RecipeContext) -> None:
    chosen = held(Ramp("metric"), min_confidence=0.5)
    predicted = chosen.predicted(chosen.stage(flat_stage(scene, run), SCENE, run), scene)
    assert predicted.predicts == "depth"
    known = np.isfinite(predicted.values["0.png"])
    assert known[:, :400].all()
    assert not known[:, 400:].any()


def test_without_weight_there_is_no_source_and_with_it_what_is_missing_is_told(tmp_path: Path) -> None:
    source = DepthSettings(weights=str(tmp_path / "gone"))
    assert held_depth(source, DepthLossSettings()) is None
    with pytest.raises(WeightsMissingError):
        held_depth(source, DepthLossSettings(weight=0.1))
