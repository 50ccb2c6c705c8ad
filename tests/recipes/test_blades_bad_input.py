"""Footage of blades that cannot become what was asked for: each says what to try next."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from toolkit.errors import ToolkitError
from toolkit.progress import ProgressEvent
from toolkit.recipes.base import RecipeContext, RecipeInput, RecipeResult
from toolkit.recipes.blades import BladesCircularSettings, BladesSequentialSettings, run, run_circular
from toolkit.samples.engine import EngineSettings, make_engine
from toolkit.scene import Scene
from toolkit.workspace import Workspace

FOOTAGE = {
    "rotor.blades": 24,
    "film.frames": 24,
    "film.step": 3.0,
    "film.samples": 1,
    "borescope.image_width": 240,
    "borescope.image_height": 180,
    "points": 300,
}
NEAR = {"lens.way": "known", "masks.find": False, "pairs.overlap": 2, "features.sift.max_features": 700}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("blades") / "engine"
    return make_engine(folder, EngineSettings().replace(FOOTAGE)).scene.without_poses()


def context(folder: Path, told: list[str] | None = None) -> RecipeContext:
    def listen(event: ProgressEvent) -> None:
        if told is not None and event.message:
            told.append(event.message)

    return RecipeContext(Workspace(folder / "stages"), folder, folder, 0, "cpu", listen)


def sequential(scene: Scene, folder: Path, told: list[str] | None = None, **changes: object) -> RecipeResult:
    settings = BladesSequentialSettings().replace({**NEAR, **changes})
    return run(RecipeInput(scene, None, "bad"), settings, context(folder, told))


def shown_as(scene: Scene, folder: Path, picture: np.ndarray) -> Scene:
    """Return the scene with the same picture in the place of every frame."""
    folder.mkdir()
    for frame in scene.frames:
        Image.fromarray(picture).save(folder / frame.name)
    return scene.replace(image_dir=folder, mask_dir=None)


def test_a_window_wider_than_the_footage_takes_every_pair(scene: Scene, tmp_path: Path) -> None:
    few = scene.replace(frames=scene.frames[:5])

    found = sequential(few, tmp_path, **{"pairs.overlap": 60})

    assert found.metrics["sfm.registered"] == 5
    assert found.reports["matches"]["pairs_tried"] == 10


def test_pictures_without_anything_to_see(scene: Scene, tmp_path: Path) -> None:
    dark = shown_as(scene, tmp_path / "dark", np.zeros((180, 240, 3), np.uint8))

    with pytest.raises(ToolkitError, match="features"):
        sequential(dark, tmp_path / "run")


def test_a_mask_that_leaves_nothing(scene: Scene, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    for frame in scene.frames:
        Image.fromarray(np.zeros((180, 240), np.uint8)).save(masks / f"{frame.name}.png")

    with pytest.raises(ToolkitError, match="mask"):
        sequential(scene.replace(mask_dir=masks), tmp_path / "run")


def test_pairs_that_do_not_match(scene: Scene, tmp_path: Path) -> None:
    noise = tmp_path / "noise"
    noise.mkdir()
    rng = np.random.default_rng(0)
    for frame in scene.frames:
        Image.fromarray(rng.integers(0, 255, (180, 240, 3), np.uint8)).save(noise / frame.name)

    with pytest.raises(ToolkitError, match="matches|pairs"):
        sequential(scene.replace(image_dir=noise, mask_dir=None), tmp_path / "run")


def test_a_camera_that_does_not_move(scene: Scene, tmp_path: Path) -> None:
    with Image.open(scene.image_path(scene.frames[0])) as image:
        still = shown_as(scene, tmp_path / "still", np.asarray(image.convert("RGB")))

    with pytest.raises(ToolkitError, match="sound start"):
        sequential(still, tmp_path / "run")


def test_two_pieces_are_told_with_what_may_join_them(scene: Scene, tmp_path: Path) -> None:
    torn = tmp_path / "torn"
    shutil.copytree(scene.image_dir, torn)
    for frame in scene.frames[13:16]:  # wider than the window
        Image.new("RGB", (240, 180)).save(torn / frame.name)
    messages: list[str] = []

    found = sequential(scene.replace(image_dir=torn), tmp_path, messages)

    assert found.metrics["sfm.registered"] == 13
    (warning,) = found.reports["sfm"]["warnings"]
    assert warning.startswith("The pictures fall into 2 pieces (13, 8 pictures)")
    assert "more pairs" in warning
    assert warning in messages


def test_a_circle_needs_cameras_that_make_one(scene: Scene, tmp_path: Path) -> None:
    pair = scene.replace(frames=scene.frames[:2])
    settings = BladesCircularSettings().replace({**NEAR, "pairs.closed": False})

    with pytest.raises(ToolkitError) as told:
        run_circular(RecipeInput(pair, None, "two"), settings, context(tmp_path))

    assert "2" in str(told.value)


def test_frames_of_different_sizes(scene: Scene, tmp_path: Path) -> None:
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    for number, frame in enumerate(scene.frames):
        side = (240, 180) if number else (120, 90)
        Image.fromarray(np.full((side[1], side[0], 3), 90, np.uint8)).save(mixed / frame.name)
    frames = tuple(dataclasses.replace(frame) for frame in scene.frames)

    with pytest.raises(ToolkitError, match="120x90"):
        sequential(scene.replace(frames=frames, image_dir=mixed, mask_dir=None), tmp_path / "run")
