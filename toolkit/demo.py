"""The demonstration: a sample flight, two methods run on it, the two laid side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from toolkit.files import read_json
from toolkit.progress import Progress
from toolkit.recipes.registry import find_recipe
from toolkit.runs.compare import Comparison, compare_runs
from toolkit.runs.launch import create_run, execute
from toolkit.runs.report_html import write_report
from toolkit.samples.make import SampleSettings, make_sample

SEED = 0

# Sizes that end within about five minutes on two slow cores.
SAMPLE: dict[str, Any] = {
    "flight.frames": 32,
    "flight.image_width": 480,
    "flight.image_height": 360,
}
COMMON: dict[str, Any] = {
    "sift.max_features": 2048,
    "train.steps": 1500,
    "train.max_side": 480,
}
RECIPES = ("colmap-3dgs", "sensor-3dgs")
PAIRS = {"pairs.method": "spatial"}  # the same matches for both


def run_demo(folder: Path, progress: Progress) -> tuple[Comparison, Path]:
    """Make a sample flight, ``folder/data/town``, find poses by pictures and by sensors, train, and compare.

    A second call finds the flight and the stages that do not change, and trains again.

    Returns
    -------
    comparison, page:
        The two runs side by side, and the path of the same as one HTML page.
    """
    sample = SampleSettings().replace(SAMPLE)
    town = folder / "data" / "town"
    made_with = {"seed": SEED, "settings": sample.to_dict()}
    if not (town / "sample.json").is_file() or read_json(town / "sample.json") != made_with:
        make_sample(town, sample, seed=SEED, progress=progress)
    runs = []
    for name in RECIPES:
        recipe = find_recipe(name)
        settings = recipe.settings_type().replace({**COMMON, **PAIRS})
        runs.append(create_run(recipe, town, settings, folder / "runs", seed=SEED, name=name))
        execute(runs[-1], progress)
    comparison = compare_runs(runs)
    page = folder / "compare.html"
    write_report(comparison, page, progress=progress)
    return comparison, page
