"""When a training is looked at, and what is left for those who watch it."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from fake_recipe import posed, write_photos
from PIL import Image

from toolkit.errors import RunError
from toolkit.recipes.live_view import LiveView
from toolkit.scene import Scene
from toolkit.scene.dataset import open_capture


@dataclass
class Clock:
    """Time that passes when it is told to."""

    now: float = 100.0

    def __call__(self) -> float:
        return self.now


@dataclass
class Training:
    """What a look needs of a training; drawing takes a time."""

    clock: Clock
    takes: float = 1 / 64
    steps: int = 1000
    test_photo: Any = None
    refined: dict[str, Any] = field(default_factory=dict)
    drawn: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.state = SimpleNamespace(step=0)
        self.settings = SimpleNamespace(steps=self.steps)

    def draw_test(self, photo: Any) -> tuple[torch.Tensor, float]:
        self.clock.now += self.takes
        self.drawn.append(self.state.step)
        return torch.full((8, 12, 3), 0.25), 12.5

    def poses(self) -> dict[str, Any]:
        return self.refined


PHOTO = SimpleNamespace(name="a.png", colours=lambda: torch.full((8, 12, 3), 0.5))


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return posed(open_capture(write_photos(tmp_path / "photos")).scene)


def steps(view: LiveView, training: Training, count: int, each: float) -> list[dict[str, float]]:
    told = []
    for _ in range(count):
        training.clock.now += each
        training.state.step += 1
        told.append(view(training))
    return told


def test_it_looks_every_two_seconds_and_at_the_end(tmp_path: Path, scene: Scene) -> None:
    clock = Clock()
    training = Training(clock, steps=100, test_photo=PHOTO)
    told = steps(LiveView(tmp_path / "live", scene, clock=clock), training, 100, 1 / 8)
    # All times are sums of powers of two, so exact: 16 steps after a look two seconds are over.
    assert training.drawn == [1, 17, 33, 49, 65, 81, 97, 100]
    assert told[0] == told[-1] == {"psnr_live": 12.5}
    assert told[1] == {}


def test_a_slow_look_takes_a_twentieth_of_the_time(tmp_path: Path, scene: Scene) -> None:
    clock = Clock()
    training = Training(clock, takes=2.0, steps=10_000, test_photo=PHOTO)
    begun = clock.now
    steps(LiveView(tmp_path / "live", scene, clock=clock), training, 4000, 0.1)
    share = 2.0 * len(training.drawn) / (clock.now - begun)
    assert 0.045 < share <= 0.055  # the first look is at once, so a little more than 5 % in so short a time


def test_what_it_leaves(tmp_path: Path, scene: Scene) -> None:
    clock = Clock()
    train = {f.name: f.cam_from_world for f in scene.of_split("train")}
    training = Training(clock, test_photo=PHOTO, refined=dict(train))
    folder = tmp_path / "live"
    view = LiveView(folder, scene, clock=clock)
    steps(view, training, 1, 0.1)
    assert json.loads((folder / "view.json").read_text()) == {
        "name": "a.png",
        "step": 1,
        "steps": 1000,
        "psnr": 12.5,
    }
    for name, level in (("photo.jpg", 128), ("render.jpg", 64)):
        pixels = np.asarray(Image.open(folder / name))
        assert pixels.shape == (8, 12, 3)
        assert np.abs(pixels.astype(int) - level).max() <= 1  # JPEG rounds
    poses = json.loads((folder / "poses.json").read_text())
    assert poses["found"] == poses["reference"]
    assert [row["name"] for row in poses["found"]] == list(train)
    photo = (folder / "photo.jpg").stat().st_mtime_ns
    steps(view, training, 30, 0.1)
    assert len(training.drawn) == 2
    assert (folder / "photo.jpg").stat().st_mtime_ns == photo
    assert sorted(path.name for path in folder.iterdir()) == ["photo.jpg", "poses.json", "render.jpg", "view.json"]


def test_without_test_photo_and_refined_poses_there_is_nothing_to_leave(tmp_path: Path, scene: Scene) -> None:
    clock = Clock()
    told = steps(LiveView(tmp_path / "live", scene, clock=clock), Training(clock), 30, 0.1)
    assert told == [{}] * 30
    assert not (tmp_path / "live").exists()


def test_a_folder_that_cannot_be_is_told(tmp_path: Path, scene: Scene) -> None:
    (tmp_path / "live").write_text("in the way")
    clock = Clock()
    with pytest.raises(RunError, match="Something is in the way while writing"):
        steps(LiveView(tmp_path / "live", scene, clock=clock), Training(clock, test_photo=PHOTO), 1, 0.1)
