"""What other packages add by entry points: found by name, and refused with a reason."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from toolkit.errors import CapabilityError, MissingDependencyError, SettingsError
from toolkit.optional import added_by_packages
from toolkit.recipes.base import Recipe
from toolkit.recipes.registry import all_recipes, built_in_recipes, find_recipe
from toolkit.runs.machine import describe_code

RECIPE = """
from toolkit.recipes.base import Recipe
from toolkit.settings import Settings
OWN = Recipe("own-way", "Own way", "", "A test.", Settings, print)
TAKEN = Recipe("colmap-3dgs", "Taken", "", "A test.", Settings, print)
NUMBER = 3
"""
Install = Callable[..., None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Return a function that installs a package whose entry points are given as text."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def add(package: str, points: str, code: str = RECIPE) -> None:
        module = package.replace("-", "_")
        (tmp_path / f"{module}.py").write_text(code)
        about = tmp_path / f"{module}-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text(points)
        importlib.invalidate_caches()
        monkeypatch.delitem(sys.modules, module, raising=False)

    return add


def test_a_recipe_of_another_package_is_listed_last_and_found(install: Install) -> None:
    install("own-package", "[toolkit.recipes]\nown-way = own_package:OWN\n")
    assert list(all_recipes()) == [*built_in_recipes(), "own-way"]
    assert find_recipe("own-way").title == "Own way"
    with pytest.raises(SettingsError, match="Did you mean 'own-way'"):
        find_recipe("own-wax")


def test_without_such_packages_there_are_the_toolkits_own() -> None:
    assert all_recipes().keys() == built_in_recipes().keys()


def test_a_name_that_the_toolkit_has_is_refused(install: Install) -> None:
    install("own-package", "[toolkit.recipes]\ncolmap-3dgs = own_package:TAKEN\n")
    with pytest.raises(
        CapabilityError, match="adds the recipe 'colmap-3dgs', which the toolkit has already.*Rename"
    ):
        all_recipes()


@pytest.mark.parametrize("value", ["own_package:GONE", "not_there:OWN"])
def test_what_cannot_be_imported_is_told_with_its_package(install: Install, value: str) -> None:
    install("own-package", f"[toolkit.recipes]\nown-way = {value}\n")
    with pytest.raises(
        MissingDependencyError,
        match="'own-way', which the package 'own-package' adds to toolkit.recipes, cannot be imported.*uninstall",
    ):
        added_by_packages("toolkit.recipes", Recipe)


@pytest.mark.parametrize(
    ("point", "found"),
    [("own-way = own_package:NUMBER", "found a int"), ("other = own_package:OWN", "a Recipe named 'own-way'")],
)
def test_what_is_of_another_kind_or_name_is_refused(install: Install, point: str, found: str) -> None:
    install("own-package", f"[toolkit.recipes]\n{point}\n")
    with pytest.raises(CapabilityError, match=f"is not what it says; expected a Recipe named.*{found}"):
        added_by_packages("toolkit.recipes", Recipe)


def test_one_name_by_two_packages_is_refused(install: Install) -> None:
    install("own-package", "[toolkit.recipes]\nown-way = own_package:OWN\n")
    install("second-package", "[toolkit.recipes]\nown-way = second_package:OWN\n")
    with pytest.raises(
        CapabilityError, match="Two packages add 'own-way' to toolkit.recipes.*Uninstall one of them"
    ):
        added_by_packages("toolkit.recipes", Recipe)


def test_a_run_records_what_was_added_by_which_version(install: Install, tmp_path: Path) -> None:
    assert "added" not in describe_code.__wrapped__()
    install("own-package", "[toolkit.recipes]\nown-way = own_package:OWN\n")
    install("second-package", "[toolkit.matchers]\nother = gone_package:OTHER\n")
    before = describe_code.__wrapped__()["added"]
    assert before["own-package"].startswith("1.0, sources ")
    assert before["second-package"] == "1.0, sources unknown"
    (tmp_path / "own_package.py").write_text(RECIPE + "# mended\n")
    after = describe_code.__wrapped__()["added"]
    assert after["own-package"] != before["own-package"]
