"""Runs side by side in a notebook cell: measures, curves, camera paths, and a slider from photo to render."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from PIL import Image

from toolkit.errors import ToolkitError
from toolkit.optional import require
from toolkit.recipes.base import TestView
from toolkit.runs.clouds import ShapeKind
from toolkit.runs.compare import ComparedRun, Comparison, compare_runs
from toolkit.runs.folder import RunFolder
from toolkit.runs.index import list_runs
from toolkit.runs.markup import element
from toolkit.runs.report_figures import aligned_figure, curve_figures
from toolkit.runs.report_html import run_heads, warning_list
from toolkit.runs.report_tables import measures_section, settings_section
from toolkit.runs.report_views import views_by_name

_NEWEST = 2
_HEIGHT = 8
_SHAPES: list[tuple[str, ShapeKind | None]] = [
    ("camera paths", None),
    ("initial points", "points"),
    ("centres of Gaussians", "gaussians"),
    ("mesh", "mesh"),
]


class CompareBox:
    """A list of runs, and those that are chosen side by side.

    Parameters
    ----------
    runs_dir:
        Folder of the runs.
    chosen:
        Which ones at first; by default the newest two that are finished.

    Attributes
    ----------
    comparison:
        What is shown; None where nothing can be compared.

    Raises
    ------
    RunError
        Where the folder may not be read.
    MissingDependencyError
        Where ipywidgets or anywidget is not installed.
    """

    def __init__(self, runs_dir: Path, chosen: Sequence[RunFolder] = ()) -> None:
        self._ipywidgets = widgets = require("ipywidgets")
        require("anywidget")  # Plotly's own message for it does not say how to get it
        rows = list_runs(runs_dir)
        self._runs = {row.run.id: row.run for row in rows}
        finished = [row.run for row in rows if row.state == "finished"]
        self.comparison: Comparison | None = None
        self._pictures: dict[str, list[tuple[ComparedRun, TestView]]] = {}
        ids = [run.id for run in (chosen or finished[-_NEWEST:])]
        self.pick = widgets.SelectMultiple(
            options=[(f"{row.label} · {row.recipe} · {row.state}", row.run.id) for row in reversed(rows)],
            value=[run_id for run_id in ids if run_id in self._runs],
            rows=min(_HEIGHT, max(2, len(rows))),
            description="Runs",
            layout={"width": "640px"},
        )
        self.view = widgets.Dropdown(description="Test photo")
        self.split = widgets.IntSlider(
            50, min=0, max=100, description="Photo %", tooltip="How much of the photo is laid over the render."
        )
        self.pictures = widgets.HBox()
        self.shape = widgets.Dropdown(
            options=_SHAPES, description="3D shows", tooltip="What is drawn with the paths."
        )
        self._tables, self._figures = widgets.HTML(), widgets.VBox()
        self._paths, self._path_remarks = widgets.VBox(), widgets.HTML()
        self.pick.observe(lambda change: self._compare(), "value")
        self.view.observe(lambda change: self._show_pictures(), "value")
        self.split.observe(lambda change: self._show_pictures(), "value")
        self.shape.observe(lambda change: self._show_paths(), "value")
        self.box = widgets.VBox(
            [
                *(self.pick, self._tables, self._figures, self.shape, self._path_remarks, self._paths),
                *(widgets.HBox([self.view, self.split]), self.pictures),
            ]
        )
        self._compare()

    def _compare(self) -> None:
        self.comparison, self._pictures = None, {}
        try:
            if self.pick.value:
                self.comparison = compare_runs([self._runs[run_id] for run_id in self.pick.value])
        except ToolkitError as error:
            self._tables.value = str(warning_list([str(error)]) or "")
        if self.comparison is None:
            self._figures.children = ()
            if not self.pick.value:
                self._tables.value = str(element("p", "Choose runs to compare (Ctrl or Shift for several)."))
        else:
            self._show_tables(self.comparison)
            self._show_figures(self.comparison)
            found = views_by_name(self.comparison.runs)
            of_runs = list(zip(self.comparison.runs, found.views, strict=True))
            self._pictures = {
                name: [(run, views[name]) for run, views in of_runs if name in views] for name in found.names
            }
        self._show_paths()
        self.view.options = list(self._pictures)
        self.view.value = next(iter(self._pictures), None)  # the worst one
        self._show_pictures()

    def _show_tables(self, comparison: Comparison) -> None:
        heads = run_heads(comparison.runs)
        self._tables.value = str(
            element(
                "div",
                warning_list(comparison.warnings),
                measures_section(comparison, heads),
                settings_section(comparison, heads),
            )
        )

    def _show_figures(self, comparison: Comparison) -> None:
        figures = [curve.by_axis["step"] for curve in curve_figures(comparison.runs)[0]]
        self._figures.children = [go.FigureWidget(drawn) for drawn in figures]

    def _show_paths(self) -> None:
        """Show the cameras' paths, with points or the mesh where one is chosen."""
        paths, remarks = aligned_figure(self.comparison.runs if self.comparison else (), self.shape.value)
        self._paths.children = () if paths is None else (go.FigureWidget(paths),)
        self._path_remarks.value = str(warning_list(remarks if self.shape.value else ()) or "")

    def _show_pictures(self) -> None:
        children = []
        for run, view in self._pictures.get(self.view.value or "", ()):
            mixed = _mixed(run.run.artifacts / view.photo, run.run.artifacts / view.render, self.split.value / 100)
            label = self._ipywidgets.Label(f"{run.label}: {view.psnr:.2f} dB")
            shown = self._ipywidgets.Image(value=mixed, format="png", layout={"max_width": "480px"})
            children.append(self._ipywidgets.VBox([label, shown]))
        self.pictures.children = children

    def _repr_mimebundle_(self, **options: Any) -> dict[str, Any]:
        shown: dict[str, Any] = self.box._repr_mimebundle_(**options) or {}
        return shown


def _mixed(photo: Path, render: Path, share: float) -> bytes:
    """Return a PNG: the left ``share`` of the photo beside the rest of the render."""
    with Image.open(photo) as left, Image.open(render) as right:
        below = np.array(right.convert("RGB"))
        over = np.array(left.convert("RGB").resize((below.shape[1], below.shape[0])))
    edge = round(share * below.shape[1])
    below[:, :edge] = over[:, :edge]
    if 0 < edge < below.shape[1]:
        below[:, edge - 1 : edge + 1] = 255
    written = io.BytesIO()
    Image.fromarray(below).save(written, "PNG")
    return written.getvalue()
