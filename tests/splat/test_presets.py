"""Presets: names that give settings, on every recipe that trains splats."""

from __future__ import annotations

from pathlib import Path

import pytest

from toolkit.cli import main
from toolkit.errors import SettingsError
from toolkit.nerf.settings import NerfSettings
from toolkit.recipes.base import Recipe
from toolkit.recipes.presets import recipe_presets, with_preset
from toolkit.recipes.registry import all_recipes, find_recipe
from toolkit.runs import launch
from toolkit.runs.text import recipe_text
from toolkit.settings import Settings
from toolkit.splat.pose_presets import POSE_PRESETS
from toolkit.splat.presets import PRESETS, find_preset, preset_settings
from toolkit.splat.train_settings import Schedule, TrainSettings


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_gives_valid_settings_and_says_what_it_is_for(name: str) -> None:
    changes = find_preset(name).changes
    made = preset_settings(name)
    assert {key: value for key, (value, _) in made.differences(TrainSettings()).items()} == {
        key: value for key, value in changes.items() if value != getattr(TrainSettings(), key)
    }
    assert find_preset(name).doc


def test_presets_take_longer_in_their_order() -> None:
    assert list(PRESETS) == ["draft", "standard", "paper"]
    made = [preset_settings(name) for name in PRESETS]
    for names in ("steps", "max_side", "max_gaussians"):
        values = [getattr(settings, names) for settings in made]
        assert values[0] < values[1] < values[2]
    assert made[1].to_dict() == TrainSettings().to_dict()


def test_the_paper_has_the_schedule_of_kerbl_et_al() -> None:
    schedule = Schedule.of(preset_settings("paper"))
    rounds = [step for step in range(1, 30001) if schedule.densifies_after(step)]
    assert rounds == list(range(600, 15001, 100))
    assert [step for step in range(1, 30001) if schedule.resets_after(step)] == [3000, 6000, 9000, 12000]
    assert [schedule.sh_degree_at(step) for step in (1000, 1001, 2001, 3001, 30000)] == [0, 1, 2, 3, 3]
    assert schedule.grad_threshold == 2e-4


def test_a_draft_densifies_on_pictures_of_half_and_of_full_size() -> None:
    schedule = Schedule.of(preset_settings("draft"))
    rounds = [step for step in range(1, schedule.steps + 1) if schedule.densifies_after(step)]
    assert {schedule.shrink_at(step) for step in rounds} == {2, 1}


def training(kind: type[Settings]) -> list[Recipe]:
    return [
        each for each in all_recipes().values() if isinstance(getattr(each.settings_type(), "train", None), kind)
    ]


TRAINING = training(TrainSettings)


def test_only_recipes_that_train_take_presets() -> None:
    taking = {recipe.name for recipe in all_recipes().values() if recipe_presets(recipe)}
    fields = {recipe.name for recipe in training(NerfSettings)}
    assert taking == {recipe.name for recipe in TRAINING} | fields
    assert {"colmap-3dgs", "cf-3dgs", "sensor-fused", "splat-mesh"} < taking
    assert fields == {"nerf", "ds-nerf"}


@pytest.mark.parametrize("recipe", TRAINING, ids=lambda recipe: recipe.name)
def test_recipes_take_presets_and_show_them(recipe) -> None:
    default = recipe.settings_type()
    presets = recipe_presets(recipe)
    # Those of trainings that refine poses, only where poses are refined.
    assert list(presets) == [*PRESETS, *(POSE_PRESETS if default.train.refine_poses else [])]
    draft = with_preset(default, "draft")
    assert draft.train.steps == PRESETS["draft"].changes["steps"]
    assert all(name.startswith("train.") for name in draft.differences(default))
    text = recipe_text(recipe)
    words = " ".join(text.split())
    assert all(f"\n{name}\n" in text and " ".join(preset.doc.split()) in words for name, preset in presets.items())


def test_an_unknown_preset_is_told_with_those_there_are() -> None:
    with pytest.raises(SettingsError, match="Unknown preset 'fast'; expected one of draft, standard, paper"):
        with_preset(find_recipe("colmap-3dgs").settings_type(), "fast")


def test_a_recipe_that_trains_nothing_takes_no_preset() -> None:
    class Nothing(Settings):
        """Of no stage."""

    with pytest.raises(SettingsError, match="Preset 'draft' changes nothing here; expected a recipe that trains"):
        with_preset(Nothing(), "draft")


def test_a_run_takes_a_preset_and_set_comes_after(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    given: list[Settings] = []

    def create(recipe: object, data: Path, settings: Settings, *rest: object, **options: object) -> None:
        given.append(settings)
        raise SettingsError("far enough")

    monkeypatch.setattr(launch, "create_run", create)
    start = ["run", "colmap-3dgs", "--data", str(tmp_path), "--preset"]
    assert main([*start, "draft", "--set", "train.steps=7", "--set", "sift.max_features=99"]) == 2
    expected = {f"train.{key}": value for key, value in PRESETS["draft"].changes.items()}
    changed = given[0].differences(find_recipe("colmap-3dgs").settings_type())
    assert {key: value for key, (value, _) in changed.items()} == {
        **expected,
        "train.steps": 7,
        "sift.max_features": 99,
    }
    capsys.readouterr()
    assert main([*start, "fast"]) == 2
    assert "error: Unknown preset 'fast'; expected one of draft, standard, paper" in capsys.readouterr().err
    assert len(given) == 1
    with pytest.raises(SystemExit):
        main([*start, "draft", "--settings", "some.json"])
    assert "not allowed with argument --preset" in capsys.readouterr().err
