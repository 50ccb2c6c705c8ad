"""One recipe on one data set, made once."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_recipe import RECIPE, write_photos

from toolkit.errors import RunError, SettingsError
from toolkit.runs import recipe_run as module
from toolkit.runs.recipe_run import recipe_run


@pytest.fixture(autouse=True)
def one_recipe(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "find_recipe", {"fake": RECIPE}.__getitem__)


def test_a_run_that_is_there_is_taken_and_another_setting_makes_another(tmp_path: Path) -> None:
    photos = write_photos(tmp_path / "photos")
    first = recipe_run("fake", photos, {"loop.steps": 5}, tmp_path / "runs")
    assert first.result().metrics["test.ssim"] == 0.5
    assert recipe_run("fake", photos, {"loop.steps": 5}, tmp_path / "runs") == first
    assert recipe_run("fake", photos, {"loop.steps": 6}, tmp_path / "runs") != first


def test_a_run_that_fails_says_why(tmp_path: Path) -> None:
    photos = write_photos(tmp_path / "photos")
    with pytest.raises(RunError, match="Recipe 'fake' did not finish; .*found failed: "):
        recipe_run("fake", photos, {"loop.steps": 5, "fail_at": 2}, tmp_path / "runs")
    with pytest.raises(RunError, match="did not finish; .*no_such_setting"):
        recipe_run("fake", photos, {"no_such_setting": 1}, tmp_path / "runs")


def test_an_unknown_recipe_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    with pytest.raises(SettingsError, match="nothing"):
        recipe_run("nothing", tmp_path, {}, tmp_path / "runs")
