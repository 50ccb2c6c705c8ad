"""One recipe on one data set: the run that is there already, or a new one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from toolkit.errors import RunError
from toolkit.progress import Progress, silent
from toolkit.recipes.registry import find_recipe
from toolkit.runs.folder import RunFolder
from toolkit.runs.paper_rows import PaperRow
from toolkit.runs.paper_runs import TableOptions, make_attempts


def recipe_run(
    recipe: str,
    data: Path,
    changes: Mapping[str, Any],
    runs_dir: Path,
    *,
    seed: int = 0,
    device: str = "cpu",
    progress: Progress = silent,
) -> RunFolder:
    """Return a finished run of a recipe with these settings on these pictures; one that is there is taken.

    Parameters
    ----------
    recipe:
        Its name.
    data:
        Folder that :func:`toolkit.scene.dataset.open_capture` reads.
    changes:
        Settings that differ from the recipe's own, by dotted names.
    runs_dir:
        Where runs lie.

    Raises
    ------
    SettingsError
        For a recipe that is not there.
    RunError
        Where it fails, with the reason.
    Cancelled
        Where ``progress`` says so.
    """
    known = find_recipe(recipe)
    row = PaperRow(recipe, known.title, recipe, changes)
    options = TableOptions(runs_dir, {}, seed, device)
    (attempt,) = make_attempts([row], {data.name: data}, {recipe: known}, options, progress=progress)
    if attempt.outcome != "finished" or attempt.run is None:
        raise RunError(f"Recipe '{recipe}' did not finish", expected="a run with a result", found=attempt.text)
    return attempt.run
