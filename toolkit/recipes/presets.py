"""Presets of a recipe: those of the stages that it is made of."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from toolkit.errors import SettingsError
from toolkit.nerf.settings import NerfSettings, presets_of
from toolkit.recipes.base import Recipe
from toolkit.settings import Settings
from toolkit.splat.pose_presets import POSE_PRESETS
from toolkit.splat.presets import PRESETS, Preset
from toolkit.splat.train_settings import TrainSettings

AnySettings = TypeVar("AnySettings", bound=Settings)


def recipe_presets(recipe: Recipe) -> Mapping[str, Preset]:
    """Return the presets that a recipe takes, by name: none where it trains nothing.

    Those of splat training, and where it refines poses those of such trainings, too; or those of radiance fields.
    """
    return _presets(recipe.settings_type())


def with_preset(settings: AnySettings, name: str) -> AnySettings:
    """Return a copy of a recipe's settings in which the preset's changes are made.

    Raises
    ------
    SettingsError
        For an unknown preset, or settings of a recipe that trains nothing.
    """
    known, groups = _presets(settings), _training_groups(settings)
    if not groups:
        raise SettingsError(
            f"Preset '{name}' changes nothing here",
            expected="a recipe that trains splats or a radiance field",
            todo="Leave --preset out, and change settings with --set",
        )
    if name not in known:
        raise SettingsError(f"Unknown preset '{name}'", expected="one of " + ", ".join(known))
    return settings.replace(
        {f"{group}.{key}": value for group in groups for key, value in known[name].changes.items()}
    )


def _presets(settings: Settings) -> Mapping[str, Preset]:
    groups = [getattr(settings, name) for name in _training_groups(settings)]
    fields = [group for group in groups if isinstance(group, NerfSettings)]
    if fields:
        return {name: Preset(doc, changes) for name, (doc, changes) in presets_of(fields[0]).items()}
    if any(group.refine_poses for group in groups):
        return {**PRESETS, **POSE_PRESETS}
    return PRESETS if groups else {}


def _training_groups(settings: Settings) -> list[str]:
    """Return the names of the groups that hold settings of a training."""
    kinds = (TrainSettings, NerfSettings)
    return [name for name in settings.to_dict() if isinstance(getattr(settings, name), kinds)]
