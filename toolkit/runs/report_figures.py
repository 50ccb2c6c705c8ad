"""The figures of one or several runs, and their places on the report page, whose script draws them from JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from toolkit.errors import DataError, ToolkitError
from toolkit.geometry.surface import Mesh
from toolkit.geometry.triangles import moved
from toolkit.plots.curves import curve_figure
from toolkit.plots.times import time_figure
from toolkit.plots.trajectories import trajectory_figure
from toolkit.plots.views import view_figure
from toolkit.runs.clouds import MOST_POINTS, CloudKind, ShapeKind, read_cloud
from toolkit.runs.compare import ComparedRun
from toolkit.runs.curves import Curve, Curves
from toolkit.runs.markup import Html, element
from toolkit.runs.meshes import MOST_FACES, read_run_mesh
from toolkit.runs.report_views import ViewsByName
from toolkit.runs.trajectories import AlignedTrajectories, align_trajectories, read_trajectories

#: Measurements that come first on the page.
_FIRST = ("loss", "psnr", "ssim", "gaussians", "count")


class FigureBook:
    """Collects figures and gives the places where the page's script draws them."""

    def __init__(self) -> None:
        self._figures: dict[str, dict[str, Any]] = {}

    def place(self, variants: dict[str, go.Figure]) -> Html:
        """Return the place of a figure; of several variants the page shows the first until it is told otherwise."""
        key = f"figure-{len(self._figures)}"
        self._figures[key] = {name: json.loads(figure.to_json()) for name, figure in variants.items()}
        first = next(iter(variants))
        height = next(iter(variants.values())).layout.height
        return element(
            "div",
            data_figure=key,
            data_variant=first if len(variants) > 1 else None,
            style=f"height:{height}px",
        )

    def place_one(self, figure: go.Figure | None) -> Html | None:
        """Return the place of a figure without variants, None for none."""
        return self.place({"only": figure}) if figure is not None else None

    def script(self) -> Html:
        """Return all figures as one element of data."""
        # "<" would allow a name to end the element.
        text = json.dumps(self._figures, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
        return element("script", Html(text), type="application/json", id="figures")


@dataclass(frozen=True, slots=True)
class CurveFigure:
    """One measurement of all runs, drawn over ``step`` and over ``time``."""

    stage: str
    name: str
    by_axis: dict[str, go.Figure]


def curve_figures(runs: Sequence[ComparedRun]) -> tuple[list[CurveFigure], list[str]]:
    """Return all curves that have at least two points, losses first, and remarks on damaged files."""
    tables: list[Curves] = []
    remarks = []
    for item in runs:
        try:
            # A run that waits has not written anything yet, which is nothing to remark upon.
            curves = item.run.curves() if item.status.state != "queued" else Curves((), 0)
        except DataError as error:
            curves = Curves((), 0)
            remarks.append(f"{item.label}: {error}")
        if curves.damaged_lines:
            remarks.append(f"{item.label}: {curves.damaged_lines} damaged lines of metrics.csv were left out.")
        tables.append(curves)
    keys = dict.fromkeys((curve.stage, curve.name) for curves in tables for curve in curves.curves)
    drawn = []
    for stage, name in sorted(keys, key=lambda key: _rank(key[1])):
        of_runs = [curves.find(stage, name) for curves in tables]
        if any(curve is not None and len(curve.steps) > 1 for curve in of_runs):
            by_axis = {axis: _curves(runs, of_runs, stage, name, axis) for axis in ("step", "time")}
            drawn.append(CurveFigure(stage, name, by_axis))
    return drawn, remarks


def curve_places(runs: Sequence[ComparedRun], book: FigureBook) -> tuple[list[Html], list[str]]:
    """Return the places of :func:`curve_figures`, and their remarks."""
    drawn, remarks = curve_figures(runs)
    return [element("div", book.place(curve.by_axis), class_="card chart") for curve in drawn], remarks


def _rank(name: str) -> int:
    return next((i for i, word in enumerate(_FIRST) if word in name.lower()), len(_FIRST))


def _curves(
    runs: Sequence[ComparedRun], of_runs: Sequence[Curve | None], stage: str, name: str, axis: str
) -> go.Figure:
    drawn = {
        item.label: ((curve.steps if axis == "step" else curve.seconds, curve.values) if curve else ((), ()))
        for item, curve in zip(runs, of_runs, strict=True)
    }
    positive = all((curve.values > 0).all() for curve in of_runs if curve is not None)
    return curve_figure(
        drawn,
        title=f"{name} ({stage})",
        x_title="step" if axis == "step" else "working time in seconds",
        log="loss" in name.lower() and positive,
    )


def times_figure(runs: Sequence[ComparedRun]) -> go.Figure | None:
    """Return the bars of times, None where no run has times."""
    times = {item.label: item.result.times for item in runs if item.result and item.result.times}
    return time_figure(times) if times else None


def psnr_figure(runs: Sequence[ComparedRun], found: ViewsByName) -> go.Figure | None:
    """Return PSNR by picture, None with fewer than two pictures."""
    if len(found.names) < 2:
        return None
    psnr = {
        item.label: {name: view.psnr for name, view in views.items()}
        for item, views in zip(runs, found.views, strict=True)
    }
    return view_figure(psnr, found.names, measure="PSNR in dB")


def aligned_figure(
    runs: Sequence[ComparedRun], shapes: ShapeKind | None = None
) -> tuple[go.Figure | None, list[str]]:
    """Return the trajectories in one frame, with points or meshes where they are asked for, and remarks.

    There is no figure where no run has a trajectory.
    """
    read = {}
    remarks = []
    for item in runs:
        if item.run.trajectory_file.is_file():
            try:
                read[item.label] = read_trajectories(item.run.trajectory_file)
            except DataError as error:
                remarks.append(f"{item.label}: {error}")
    aligned = align_trajectories(read)
    remarks = [*aligned.remarks, *remarks]
    if not any(path.poses for path in aligned.paths.values()):
        return None, remarks
    # Runs without a trajectory keep their colours for the others to have the same everywhere.
    paths = {item.label: aligned.paths[item.label].poses if item.label in aligned.paths else {} for item in runs}
    reference = aligned.reference.poses if aligned.reference is not None else None
    if shapes is None:
        return trajectory_figure(paths, reference), remarks
    if shapes == "mesh":
        meshes, more = _meshes(runs, aligned)
        return trajectory_figure(paths, reference, meshes=meshes), [*remarks, *more]
    points, more = _clouds(runs, aligned, shapes)
    return trajectory_figure(paths, reference, clouds=points), [*remarks, *more]


def _clouds(
    runs: Sequence[ComparedRun], aligned: AlignedTrajectories, kind: CloudKind
) -> tuple[dict[str, tuple[NDArray[np.float64], NDArray[np.uint8]]], list[str]]:
    """Return points and colours by label in the common frame, and remarks."""
    drawn = [item for item in runs if item.label in aligned.transforms]
    found: dict[str, tuple[NDArray[np.float64], NDArray[np.uint8]]] = {}
    remarks = []
    for item in drawn:
        try:
            cloud = read_cloud(item.run, kind, most=MOST_POINTS // len(drawn))
        except ToolkitError as error:
            remarks.append(f"{item.label}: {error}")
            continue
        found[item.label] = aligned.transforms[item.label].apply(cloud.xyz), cloud.rgb
        remarks.append(f"{item.label}: {len(cloud.xyz):,} of {cloud.total:,} points; far ones are left out.")
    return found, remarks


def _meshes(runs: Sequence[ComparedRun], aligned: AlignedTrajectories) -> tuple[dict[str, Mesh], list[str]]:
    """Return meshes by label in the common frame, and remarks."""
    drawn = [item for item in runs if item.label in aligned.transforms]
    found: dict[str, Mesh] = {}
    remarks = []
    for item in drawn:
        try:
            mesh, total = read_run_mesh(item.run, most=MOST_FACES // len(drawn))
        except ToolkitError as error:
            remarks.append(f"{item.label}: {error}")
            continue
        found[item.label] = moved(mesh, aligned.transforms[item.label])
        remarks.append(f"{item.label}: a mesh of {total:,} faces, drawn with {len(mesh.faces):,}.")
    return found, remarks
