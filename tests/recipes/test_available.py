"""What a recipe lacks is told without loading anything."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from toolkit.recipes import available
from toolkit.recipes.available import missing_here
from toolkit.recipes.registry import all_recipes, find_recipe


@pytest.fixture
def packages(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Let only the packages in this set be installed."""
    there: set[str] = set()

    def find(name: str) -> object | None:
        return object() if name in there else None

    monkeypatch.setattr(importlib.util, "find_spec", find)
    return there


def test_methods_without_networks_and_packages_lack_nothing() -> None:
    for name in ("colmap-3dgs", "sensor-3dgs", "sensor-fused", "sensor-ground", "orb-pnp-noposegs"):
        assert missing_here(find_recipe(name).settings_type()) == ""


def test_every_registered_recipe_can_be_asked() -> None:
    for recipe in all_recipes().values():
        assert isinstance(missing_here(recipe.settings_type()), str)


def test_a_missing_package_is_named(packages: set[str]) -> None:
    settings = find_recipe("orbslam-noposegs").settings_type()
    assert missing_here(settings) == "package missing: pyorbslam3"
    packages.add("pyorbslam3")
    assert missing_here(settings) == ""
    assert missing_here(find_recipe("sensor-dpt").settings_type()) == "package missing: transformers"


def test_weights_are_looked_for_where_they_may_lie(
    packages: set[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    packages.add("transformers")
    settings = find_recipe("sensor-dpt").settings_type()
    assert missing_here(settings).startswith("weights missing: no 'Intel/dpt-large' (hf download Intel/dpt-large")
    assert missing_here(settings.replace({"depth.download": True})) == ""
    assert "no '/nowhere/dpt'" in missing_here(settings.replace({"depth.weights": "/nowhere/dpt"}))
    assert missing_here(settings.replace({"depth.weights": str(tmp_path)})) == ""
    monkeypatch.setattr(available, "_in_hub_cache", lambda name: name == "Intel/dpt-large")
    assert missing_here(settings) == ""


def test_what_is_not_used_is_not_missed(packages: set[str], tmp_path: Path) -> None:
    settings = find_recipe("noposegs").settings_type()
    assert missing_here(settings)
    assert missing_here(settings.replace({"start": "plane"})) == ""
    arrays = settings.replace({"depth.provider": "arrays"})
    assert missing_here(arrays) == "depth maps missing: depth.arrays names no folder"
    assert missing_here(arrays.replace({"depth.arrays": str(tmp_path)})) == ""
