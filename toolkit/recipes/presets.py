"""Presets of a recipe: those of the stages that it is made of."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from toolkit.errors import SettingsError
from toolkit.recipes.base import Recipe
from toolkit.settings import Settings
from toolkit.splat.presets import PRESETS, Preset, find_preset
from toolkit.splat.train_settings import TrainSettings

AnySettings = TypeVar("AnySettings", bound=Settings)


def recipe_presets(recipe: Recipe) -> Mapping[str, Preset]:
    """Return the presets that a recipe takes, by name: those of splat training where it trains, else none."""
    return PRESETS if _training_groups(recipe.settings_type()) else {}


def with_preset(settings: AnySettings, name: str) -> AnySettings:
    """Return a copy of a recipe's settings in which the preset's changes are made.

    Raises
    ------
    SettingsError
        For an unknown preset, or settings of a recipe that trains nothing.
    """
    preset, groups = find_preset(name), _training_groups(settings)
    if not groups:
        raise SettingsError(
            f"Preset '{name}' changes nothing here",
            expected="a recipe that trains splats",
            todo="Leave --preset out, and change settings with --set",
        )
    return settings.replace({f"{group}.{key}": value for group in groups for key, value in preset.changes.items()})


def _training_groups(settings: Settings) -> list[str]:
    """Return the names of the groups that hold settings of splat training."""
    return [name for name in settings.to_dict() if isinstance(getattr(settings, name), TrainSettings)]
