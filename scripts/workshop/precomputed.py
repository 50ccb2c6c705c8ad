"""Runs made beforehand, for participants to compare theirs with: each sample, some methods, in draft size."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from scripts.workshop.laptop.kit.installing import RUNS
from toolkit.errors import StageError
from toolkit.files import write_json
from toolkit.progress import Progress, silent
from toolkit.recipes.presets import recipe_presets, with_preset
from toolkit.recipes.registry import find_recipe
from toolkit.runs.folder import RunFolder
from toolkit.runs.recipe_run import recipe_run

PRESET: Final = "draft"
#: The engine's frames have true poses, and a border that does not turn with it.
_ENGINE: Final = {"scene.way": "given", "scene.masks.find": True}


@dataclass(frozen=True, slots=True)
class Planned:
    """A method on the first sample of a notebook.

    Attributes
    ----------
    notebook:
        Its stem.
    recipe:
        Name of the method.
    changes:
        Settings beside those of the preset.
    """

    notebook: str
    recipe: str
    changes: Mapping[str, Any] = field(default_factory=dict)


PLAN: Final = (
    Planned("00_tour", "colmap-3dgs"),
    Planned("00_tour", "sensor-3dgs"),
    Planned("01_drone_poses", "colmap-3dgs"),
    Planned("01_drone_poses", "sensor-fused"),
    Planned("02_blades", "blades-sequential"),
    Planned("03_surfaces", "splat-mesh", _ENGINE),
    Planned("04_satellite", "sat-heights"),
    Planned("04_satellite", "sat-splat"),
    Planned("05_localization", "2dgs-sparse"),
)


def make_run(planned: Planned, data: Path, runs_dir: Path, *, progress: Progress = silent) -> RunFolder:
    """Return the finished run, made where it is not there yet.

    Raises as :func:`toolkit.runs.recipe_run.recipe_run`.
    """
    recipe = find_recipe(planned.recipe)
    plain = recipe.settings_type()
    drafted = with_preset(plain, PRESET) if PRESET in recipe_presets(recipe) else plain
    before = dict(plain.items())
    changes = {name: value for name, value in drafted.items() if value != before[name]}
    return recipe_run(planned.recipe, data, {**changes, **planned.changes}, runs_dir, progress=progress)


def put_into_bundle(run: RunFolder, planned: Planned, bundle: Path) -> Path:
    """Copy a finished run to where the bundle's dashboard looks, its data named relative to the bundle.

    Raises
    ------
    StageError
        Where its data are not the bundle's own.
    """
    target = bundle / RUNS / run.id
    shutil.copytree(run.path, target, dirs_exist_ok=True, ignore=shutil.ignore_patterns("checkpoint", ".*"))
    record = json.loads((target / "run.json").read_text(encoding="utf-8"))
    try:
        record["data"] = Path(record["data"]).relative_to(bundle.resolve()).as_posix()
    except ValueError as error:
        raise StageError(
            f"Run {run.id} cannot go into the bundle", expected=f"data below {bundle}", found=record["data"]
        ) from error
    record["name"] = f"made beforehand, {planned.notebook.partition('_')[2]}, {planned.recipe}"
    write_json(target / "run.json", record)
    return target
