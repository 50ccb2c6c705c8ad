"""Runs that benchmarks make once and take again."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from toolkit.progress import TqdmProgress
from toolkit.recipes.registry import find_recipe
from toolkit.runs.folder import RunFolder
from toolkit.runs.index import run_folders, summarise
from toolkit.runs.launch import create_run, execute


def finished_run(
    recipe_name: str, name: str, data: Path, runs_dir: Path, changes: Mapping[str, Any] = {}
) -> RunFolder:
    """Return the newest finished run of this recipe and name, or make it with these settings."""
    for folder in reversed(run_folders(runs_dir)):
        summary = summarise(folder)
        if summary.state == "finished" and (summary.recipe, summary.name) == (recipe_name, name):
            return folder
    recipe = find_recipe(recipe_name)
    run = create_run(recipe, data, recipe.settings_type().replace(changes), runs_dir, name=name)
    bar = TqdmProgress()
    try:
        execute(run, bar)
    finally:
        bar.close()
    return run
