"""The way from a start to a pose, and errors over how far off starts are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from splat_ground import CAMERA, down, ground_map, photo

from toolkit.errors import SettingsError
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.localizer import Localizer
from toolkit.localize.offsets import errors_by_offset
from toolkit.localize.one_shot import OneShot
from toolkit.localize.result import Localization, Round
from toolkit.localize.settings import LocalizeSettings, OneShotSettings
from toolkit.localize.trail import trail_errors, trail_poses
from toolkit.progress import ProgressEvent
from toolkit.scene import Frame, Scene

TRUE = down(0.0, 0.0)


def step(before: RigidTransform, after: RigidTransform | None) -> Round:
    return Round(before, after, np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0, dtype=bool))


def test_a_trail_begins_with_the_start_and_ends_with_the_answer() -> None:
    start, middle, end, polished = down(10.0), down(1.0), down(0.1), down(0.05)
    done = Localization("a", polished, "", trail=(step(start, middle), step(middle, end)))
    poses = trail_poses(done)
    assert poses == (start, middle, polished)
    np.testing.assert_allclose(trail_errors(done, TRUE), [10.0, 1.0, 0.05], atol=1e-9)


def test_a_trail_without_an_answer_ends_with_what_is_not_believed() -> None:
    start, wrong = down(10.0), down(30.0)
    assert trail_poses(Localization("a", None, "too few", trail=(step(start, wrong),))) == (start, wrong)
    assert trail_poses(Localization("a", None, "too few", trail=(step(start, None),))) == (start,)
    assert trail_poses(Localization("a", None, "never tried")) == ()
    assert trail_errors(Localization("a", None, "never tried"), TRUE).shape == (0,)


def test_errors_grow_with_the_offset_of_one_shot_and_not_of_ours(tmp_path: Path) -> None:
    ground, frames = ground_map(), []
    for number in range(3):
        pose = down(4.0 * number - 4.0, 1.0)
        frames.append(Frame(f"{number}.png", 1, pose, split="train" if number == 0 else "test"))
        Image.fromarray(photo(ground, pose).picture).save(tmp_path / f"{number}.png")
    scene = Scene(tmp_path, {1: CAMERA}, tuple(frames))
    once = OneShot(ground, OneShotSettings().replace({"match.method": "sift"}))
    ours = Localizer(ground, LocalizeSettings().replace({"polish.use": False, "fan.most": 0}))
    told: list[ProgressEvent] = []
    errors = errors_by_offset([once, ours], scene, (0, 12.0), seed=3, progress=told.append)
    assert list(errors) == ["one-shot-sift", "ours"]
    assert [list(row) for row in errors.values()] == [[0.0, 12.0]] * 2
    # From the true pose the photo is the very render: what is left is rounding of depth and colours.
    assert errors["one-shot-sift"][0.0].mte < 0.02
    assert errors["one-shot-sift"][12.0].mte > 2 * errors["ours"][12.0].mte
    assert errors["ours"][12.0].names == ("1.png", "2.png")
    assert told[-1].stage == "localize.ours"
    (turned,) = errors_by_offset([once], scene, (5.0,), "degrees", every=2)["one-shot-sift"].values()
    assert turned.names == ("1.png",)
    with pytest.raises(SettingsError, match="A start cannot be off by so much"):
        errors_by_offset([once], scene, (-1.0,))
