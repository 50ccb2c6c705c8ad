"""Measures the recipes vggt-ba and dust3r-views on the computed city, with predictions simulated from its truth.

``python tests/benchmarks/satellite_networks.py [--work DIR]`` makes the city of 20 views (256 m, 0.5 m a pixel),
simulates what a network might say of the views that the recipes choose (errors of the size that VGGT shows, see
:mod:`toolkit.poses.feedforward.simulated_satellite`), and runs the recipes on these files. No network takes part:
how long one takes, and what its errors are on satellite pictures, this does not tell. The simulated errors of a
picture do not depend on how many there are.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.poses.feedforward.predictions_file import write_predictions
from toolkit.poses.feedforward.simulated import SimulatedNoiseSettings
from toolkit.poses.feedforward.simulated_satellite import simulate_satellite_prediction
from toolkit.progress import TqdmProgress, silent
from toolkit.recipes.base import RecipeContext, RecipeInput, RecipeResult
from toolkit.recipes.dust3r_views import TABLE
from toolkit.recipes.feedforward_steps import choose_views
from toolkit.recipes.registry import find_recipe
from toolkit.samples.city import CitySample, CitySettings, make_city
from toolkit.samples.city.seen import seen_points
from toolkit.scene import Frame, Scene
from toolkit.scene.dataset import open_capture
from toolkit.views.settings import ViewSelectionSettings
from toolkit.workspace import Workspace

#: Rows of vggt-ba: field of view that the network says, degrees; where its points come from; the adjustment.
ROWS = (
    (3.0, "depth", "tracks"),
    (1.0, "depth", "tracks"),
    (10.0, "depth", "tracks"),
    (30.0, "depth", "tracks"),
    (3.0, "head", "paper"),
    (3.0, "depth", "paper"),
)
BUDGETS = (2, 4, 8, 16)
HEAD = ("field of view", "points", "adjustment", "ties px", "ties m", "agreeing", "median m", "MAE m", "within 1 m")


def simulate(
    sample: CitySample,
    delivered: Scene,
    path: Path,
    count: int,
    spread: str,
    angle: float = 3.0,
    points: str = "depth",
) -> None:
    """Write what a network might say of the chosen views, unless it is there."""
    if path.exists():
        return
    names = choose_views(delivered, ViewSelectionSettings(count=count, spread=spread), 0).names
    half, (low, high) = 0.5 * sample.settings.plan.size, sample.city.heights
    true = sample.true_scene
    scene = true.replace(frames=tuple(frame for frame in true.frames if frame.name in names))
    box = np.array([[-half, -half, low], [half, half, high]])
    said = simulate_satellite_prediction(
        scene, _places(sample), box, SimulatedNoiseSettings(points=points), field_of_view=angle
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_predictions(path, said)


@cache
def _places(sample: CitySample) -> Callable[[Frame], NDArray[np.float64]]:
    numbers = {frame.name: i for i, frame in enumerate(sample.true_scene.frames)}

    @cache
    def of_number(number: int) -> NDArray[np.float64]:
        return seen_points(sample, number)

    return lambda frame: of_number(numbers[frame.name])


def run(work: Path, data: RecipeInput, name: str, changes: Mapping[str, Any]) -> RecipeResult:
    """Run a recipe; what several runs have in common is done once."""
    for folder in ("artifacts", "checkpoint"):
        (work / folder).mkdir(parents=True, exist_ok=True)
    recipe = find_recipe(name)
    context = RecipeContext(Workspace(work / "work"), work / "artifacts", work / "checkpoint", 0, "cpu", silent)
    return recipe.run(data, recipe.settings_type().replace({"network.provider": "file", **changes}), context)


def line(cells: Sequence[str]) -> None:
    """Print a row."""
    print(f"| {' | '.join(cells)} |", flush=True)


def measures(metrics: Mapping[str, float | None], when: str) -> list[str]:
    """Return how far ties are apart in pixels and metres, what agrees, and the errors of heights."""
    names = (f"align{when}.rms_m", f"align{when}.inliers", f"dsm{when}.median_absolute", f"dsm{when}.mae")
    found = [metrics.get(name) for name in (f"adjust.error{when}_px", *names, f"dsm{when}.within_1m")]
    return ["-" if value is None else f"{value:.2f}" for value in found]


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--work", type=Path, default=Path("runs/bench-satellite"), help="folder")
    options = parser.parse_args()
    bar = TqdmProgress()
    sample = make_city(options.work / "city", CitySettings(), progress=bar)
    bar.close()
    capture = open_capture(sample.folder)
    data, work = RecipeInput(capture.scene, capture.reference, "city"), options.work / "networks"
    for count in BUDGETS:
        for spread in ("most", "least"):
            simulate(sample, data.scene, work / "budgets" / f"{spread}-{count}.npz", count, spread)
    run(work, data, "dust3r-views", {"network.file": str(work / "budgets")})
    print((work / "artifacts" / TABLE).read_text())
    line(HEAD)
    line(["---"] * len(HEAD))
    for angle, points, method in ROWS:
        path = work / f"{points}-{angle:g}.npz"
        simulate(sample, data.scene, path, 4, "most", angle, points)
        try:
            metrics = run(work, data, "vggt-ba", {"network.file": str(path), "adjust.method": method}).metrics
        except StageError as error:
            line([f"{angle:g}", points, method, str(error)])
            continue
        line([f"{angle:g}", points, "none", *measures(metrics, "_before")])
        line([f"{angle:g}", points, method, *measures(metrics, "")])


if __name__ == "__main__":
    main()
