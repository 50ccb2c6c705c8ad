"""What a run measured of its map and of poses in it, beside the paper's figures, for people who read a text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import RunError
from toolkit.recipes.map_geometry import GEOMETRY
from toolkit.runs.folder import RunFolder
from toolkit.runs.localization_rows import (
    MODES,
    PAPER_DENSE,
    PAPER_MAPS,
    PAPER_POSES,
    PAPER_RESIDUAL,
    PAPER_SPARSE,
    SCENARIOS,
)
from toolkit.runs.measures import format_number
from toolkit.runs.text import table

if TYPE_CHECKING:  # PyTorch comes with the first map that is opened.
    from toolkit.localize.batch import Batch

Array = NDArray[np.float64]

#: Name in a table, metric.
_MAP = (
    ("GNSS residual, median [m]", "sfm.position_residual"),
    ("sparse points", "sfm.points"),
    ("dense points", "fused.points"),
    ("Gaussians at the start", "splat.initial"),
    ("Gaussians", "splat.gaussians"),
    ("PSNR of map photos [dB]", "training.psnr"),
    ("PSNR of queries [dB]", "test.psnr"),
    ("training [s]", "train.seconds"),
    ("centres to dense cloud, median [m]", "map.c2c_median"),
    ("rendered depth to it, median [m]", "map.depth_c2c_median"),
    ("centres moved sideways, median [m]", "map.moved_horizontal"),
    ("centres moved up or down, median [m]", "map.moved_vertical"),
    ("depth error: bias [m]", "map.depth_bias"),
    ("depth error: spread [m]", "map.depth_spread"),
)
_POSES = ("mte_m", "rmse_t_m", "mre_deg", "rmse_r_deg")
_HEAD = ("start", "method", "found", "MTE [m]", "RMSE-T [m]", "MRE [°]", "RMSE-R [°]", "start off [m]")


def map_measures(run: RunFolder) -> dict[str, float | None]:
    """Return what a run measured of its map, only what it has (Tables 1 and 2)."""
    metrics = run.result().metrics
    return {name: metrics[metric] for name, metric in _MAP if metric in metrics}


def published_map_measures(recipe: str) -> dict[str, float | None]:
    """Return the paper's figures of the map that a recipe repeats, under the names of :func:`map_measures`.

    Of which pictures its PSNR is the paper does not say: it stands for both. Nothing for a recipe that is not in
    the paper.
    """
    known = PAPER_MAPS.get(recipe)
    if known is None:
        return {}
    psnr = known.psnr if known.psnr is not None else known.psnr_7000
    return {
        "GNSS residual, median [m]": PAPER_RESIDUAL,
        "sparse points": float(PAPER_SPARSE),
        "dense points": float(PAPER_DENSE),
        "Gaussians at the start": float(known.start),
        "Gaussians": float(known.final),
        "PSNR of map photos [dB]": psnr,
        "PSNR of queries [dB]": psnr,
        "training [s]": known.seconds,
        "centres to dense cloud, median [m]": known.c2c,
    }


def poses_text(run: RunFolder) -> str:
    """Return Table 3 for a run: each way to a pose from each kind of start, and the paper's figures below.

    A start of which the run has nothing is told with the reason, where the run says it.
    """
    result = run.result()
    metrics, paper = result.metrics, PAPER_POSES.get(run.record().recipe, {})
    rows: list[tuple[str, ...]] = [_HEAD]
    for scenario in SCENARIOS:
        start = format_number(metrics.get(f"localize.start.{scenario}.mte_m"))
        keys = {mode: f"localize.{mode}.{scenario}" for mode in MODES}
        for mode, key in keys.items():
            if f"{key}.mte_m" not in metrics:
                continue
            share = metrics.get(f"{key}.found")
            cells = [format_number(metrics.get(f"{key}.{name}")) for name in _POSES]
            rows.append((scenario, mode, "–" if share is None else f"{share:.0%}", *cells, start))
        reason = result.reports.get(f"localize.{scenario}", {}).get("reason")
        if reason:
            rows.append((scenario, f"not run: {reason}", *[""] * 6))
        known = paper.get(scenario)
        if known is not None:
            figures = (known.mte, known.rmse_t, known.mre, known.rmse_r)
            published = ("–", *(f"{value:.2f}" for value in figures), format_number(known.start_mte))
            rows.append((scenario, "(the paper, its data)", *published))
    return table(rows)


def answers_text(batches: Mapping[str, Batch]) -> str:
    """Return what came of photos, a line each, by what the photos are: how surely they were found, or why not."""
    rows = [("photos", "photo", "answer")]
    for label, batch in batches.items():
        for done in batch.found:
            sigma = done.position_sigma
            sure = "" if sigma is None else f", to ±{sigma.max():.2f} m"
            answer = f"FOUND{sure}, {done.inliers} matches agree" if done else f"not found: {done.reason}"
            rows.append((label, done.name, answer))
    believed = sum(bool(done) for batch in batches.values() for done in batch.found)
    return f"{table(rows)}\n\n{believed} of {len(rows) - 1} believed"


def centre_distances(run: RunFolder) -> tuple[Array, Array]:
    """Return the centres (N, 3) of a run's Gaussians, and how far (N,) each is from the dense cloud.

    Raises
    ------
    RunError
        Where the run did not measure that.
    """
    from safetensors.numpy import load_file

    path = run.artifacts / GEOMETRY
    if not path.is_file():
        raise RunError(f"Run {run.id} did not measure its map", expected="a finished run of a method 2dgs-*")
    tensors = load_file(path)
    return tensors["centres"].astype(np.float64), tensors["distance"].astype(np.float64)
