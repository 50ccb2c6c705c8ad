"""Chosen runs side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import panel as pn
import param

from toolkit.errors import ToolkitError
from toolkit.plots.style import shown
from toolkit.runs.clouds import ShapeKind
from toolkit.runs.compare import Comparison, compare_runs
from toolkit.runs.folder import RunFolder
from toolkit.runs.markup import element
from toolkit.runs.measures import format_number
from toolkit.runs.report_figures import CurveFigure, aligned_figure, curve_figures, psnr_figure, times_figure
from toolkit.runs.report_html import (
    details_section,
    psnr_is_comparable,
    run_cards,
    run_dots,
    run_heads,
    warning_list,
)
from toolkit.runs.report_tables import measures_section, paper_section, settings_section, time_table
from toolkit.runs.report_views import PictureBook, ViewsByName, view_card, views_by_name
from toolkit.widgets.pictures import PictureCard
from toolkit.widgets.style import html_pane, notes, plot_pane, show_figure, show_html

# Wide enough to be zoomed: only one test picture is shown at a time.
_PICTURE_WIDTH = 1440
_MODES = {"slide": "Slide", "photo": "Photo", "render": "Render", "error": "Error map"}
_SHAPES = {"none": "", "initial points": "points", "centres of Gaussians": "gaussians", "mesh": "mesh"}
#: Rows of the list of test pictures.
_MOST_ROWS = 8

Stamp = tuple[int | None, ...]


class CompareView(pn.viewable.Viewer):
    """One run, or several side by side. :meth:`compare` chooses them, :meth:`refresh` reads them again.

    Attributes
    ----------
    view:
        Name of the test picture that is shown, empty where the runs have none.
    comparison:
        What is shown, None where there is nothing.
    curves:
        The figures of all measurements over time.
    """

    view = param.String(default="")

    def __init__(self, *, dark: bool = False) -> None:
        super().__init__()
        self.comparison: Comparison | None = None
        self.curves: list[CurveFigure] = []
        self._dark = dark
        self._runs: tuple[RunFolder, ...] = ()
        self._seen: tuple[tuple[Stamp, str], ...] | None = None
        self._states: tuple[str, ...] | None = None
        self._found = ViewsByName((), ())
        self._make_parts()
        self._layout = self._arranged()
        self._view_choice.param.watch(lambda event: setattr(self, "view", event.new or ""), "value")
        self._view_chart.param.watch(self._clicked, "click_data")
        self._shapes.param.watch(lambda event: self._draw_paths(), "value")
        self._axis.param.watch(lambda event: self._draw_curves(), "value")
        self._mode.param.watch(lambda event: setattr(self._card, "mode", event.new), "value")

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    def compare(self, runs: Sequence[RunFolder]) -> None:
        """Show ``runs``, and the test picture that was shown before where they have it, the worst one where not."""
        self._runs, self._seen, self._states = tuple(runs), None, None
        self.refresh()

    def pick(self, view: str) -> None:
        """Show another test picture; a name that the runs do not have changes nothing."""
        if view in self._found.names:
            self.view = view

    def refresh(self) -> bool:
        """Show what changed on the disk; return whether anything did."""
        seen = tuple((stamp(run), _state(run)) for run in self._runs)
        if seen == self._seen:
            return False
        self._seen = seen
        self.comparison, problems = _compared(self._runs)
        show_html(self._problems, warning_list(problems))
        self._show_text()
        runs = self.comparison.runs if self.comparison else ()
        states = tuple(f"{item.run.id} {item.status.state}" for item in runs)
        self.curves, remarks = curve_figures(runs)
        show_html(self._curve_remarks, notes(remarks))
        self._draw_curves()
        if states != self._states:
            self._states = states
            self._show_results()
        return True

    def _make_parts(self) -> None:
        self._problems, self._cards, self._warnings = html_pane(), html_pane(), html_pane()
        self._measures, self._settings, self._details = html_pane(), html_pane(), html_pane()
        self._paper = html_pane()
        self._view_choice = pn.widgets.Select(
            label="Test pictures, worst first", size=_MOST_ROWS, sizing_mode="stretch_width", margin=(0, 0, 8, 0)
        )
        self._mode = _buttons("What the pictures show", _MODES)
        self._card = PictureCard(sizing_mode="stretch_width", margin=0)
        self._view_chart = plot_pane()
        self._axis = _buttons("Horizontal axis", {"step": "by step", "time": "by time"})
        self._curve_remarks = html_pane()
        self._curve_panes: list[pn.pane.Plotly] = []
        self._curve_box = pn.FlexBox(sizing_mode="stretch_width", gap="14px", margin=0)
        self._paths, self._path_remarks = plot_pane(), html_pane()
        self._shapes = pn.widgets.Select(
            label="Points or mesh", options=_SHAPES, value="", width=220, margin=(0, 12, 8, 0)
        )
        self._times, self._time_table = plot_pane(), html_pane()

    def _arranged(self) -> pn.Column:
        """Put the parts in their places; those without content are hidden by what fills them."""
        self._pictures = _section(
            "Test pictures",
            pn.FlexBox(
                pn.Column(self._view_choice, self._view_chart, **_share("1 1 330px")),
                pn.Column(self._mode, self._card, **_share("2 1 480px")),
                gap="20px",
                sizing_mode="stretch_width",
            ),
        )
        self._curve_section = _section("Curves", self._curve_remarks, self._axis, self._curve_box)
        self._path_section = _section("Camera paths", self._shapes, self._path_remarks, self._paths)
        self._time_section = _section("Time by stage", self._times, pn.Spacer(height=14), self._time_table)
        tables = pn.FlexBox(_half(self._measures), _half(self._settings), gap="20px", sizing_mode="stretch_width")
        lower = pn.FlexBox(
            _half(self._path_section), _half(self._time_section), gap="20px", sizing_mode="stretch_width"
        )
        top = (self._problems, self._cards, self._warnings)
        return pn.Column(
            *top,
            tables,
            self._paper,
            self._pictures,
            self._curve_section,
            lower,
            self._details,
            sizing_mode="stretch_width",
        )

    def _show_text(self) -> None:
        comparison = self.comparison
        if comparison is None:
            for pane in (self._cards, self._warnings, self._measures, self._settings, self._paper):
                show_html(pane)
            return
        heads = run_heads(comparison.runs)
        show_html(self._cards, run_cards(comparison.runs))
        show_html(self._warnings, warning_list(comparison.warnings))
        show_html(self._measures, measures_section(comparison, heads))
        show_html(self._settings, settings_section(comparison, heads))
        show_html(self._paper, paper_section(comparison))

    def _show_results(self) -> None:
        """Show what comes with a result: pictures, paths and times, drawn anew when a run changes its state."""
        comparison = self.comparison
        runs = comparison.runs if comparison else ()
        self._found = views_by_name(runs)
        show_figure(self._view_chart, psnr_figure(runs, self._found), dark=self._dark)
        options = {_view_label(self._found, name): name for name in self._found.names}
        kept = self.view if self.view in self._found.names else next(iter(self._found.names), "")
        rows = min(_MOST_ROWS, max(2, len(options)))
        self._view_choice.param.update(options=options, value=kept or None, size=rows)
        self._pictures.visible = bool(self._found.names)
        if kept == self.view:
            self._show_view()
        self.view = kept
        self._draw_paths()
        times = times_figure(runs)
        show_figure(self._times, times, dark=self._dark)
        self._time_section.visible = times is not None
        show_html(self._time_table, time_table(comparison, run_heads(runs)) if comparison and times else None)
        show_html(self._details, details_section(comparison, run_heads(runs)) if comparison else None)

    @param.depends("view", watch=True)
    def _show_view(self) -> None:
        if self.comparison is None or self.view not in self._found.names:
            self._card.content = ""
            return
        self._view_choice.value = self.view
        runs = self.comparison.runs
        book, best = PictureBook(_PICTURE_WIDTH), psnr_is_comparable(self.comparison)
        card = view_card(runs, self._found, self.view, run_dots(len(runs)), book, mark_best=best, errors=True)
        self._card.content = str(card)

    def _clicked(self, event: param.parameterized.Event) -> None:
        """Show the test picture whose mark in the chart was clicked."""
        points = (event.new or {}).get("points") or [{}]
        names = {shown(name): name for name in self._found.names}
        self.pick(names.get(str(points[0].get("x")), ""))

    def _draw_paths(self) -> None:
        runs = self.comparison.runs if self.comparison else ()
        kind = next((kind for kind in get_args(ShapeKind) if kind == self._shapes.value), None)
        paths, remarks = aligned_figure(runs, kind)
        show_figure(self._paths, paths, dark=self._dark)
        show_html(self._path_remarks, notes(remarks))
        self._path_section.visible = paths is not None or bool(remarks)

    def _draw_curves(self) -> None:
        axis = self._axis.value
        if len(self._curve_panes) != len(self.curves):
            self._curve_panes = [plot_pane() for _ in self.curves]
            self._curve_box[:] = [_half(pane) for pane in self._curve_panes]
        for pane, curve in zip(self._curve_panes, self.curves, strict=True):
            show_figure(pane, curve.by_axis[axis], dark=self._dark)
        self._axis.visible = bool(self.curves)
        self._curve_section.visible = bool(self.curves) or self._curve_remarks.visible


def _compared(runs: Sequence[RunFolder]) -> tuple[Comparison | None, list[str]]:
    """Return the comparison of those runs that can be read, and why the others cannot."""
    if not runs:
        return None, []
    try:
        return compare_runs(runs), []
    except ToolkitError:
        sound, problems = [], []
        for run in runs:
            try:
                compare_runs([run])
            except ToolkitError as error:
                problems.append(f"{run.id} cannot be shown: {error}")
            else:
                sound.append(run)
        return compare_runs(sound) if sound else None, problems


def _state(run: RunFolder) -> str:
    """Return a run's state, which may change without a file: a process that dies writes nothing."""
    try:
        return run.status().state
    except ToolkitError as error:
        return str(error)


def _view_label(found: ViewsByName, name: str) -> str:
    psnr = [format_number(views[name].psnr) for views in found.views if name in views]
    return f"{name}   ({' / '.join(psnr)} dB)"


def _buttons(label: str, options: dict[str, str]) -> pn.widgets.RadioButtonGroup:
    return pn.widgets.RadioButtonGroup(
        options={text: value for value, text in options.items()},
        color="primary",
        variant="outline",
        stylesheets=[".bk-btn.bk-active { color: #ffffff !important; }"],
        label=label,
        width=90 * len(options),
        margin=(0, 0, 8, 0),
    )


def _section(title: str, *content: pn.viewable.Viewable) -> pn.Column:
    return pn.Column(html_pane(element("h2", title)), *content, sizing_mode="stretch_width", margin=0)


def _half(content: pn.viewable.Viewable) -> pn.Column:
    """Return a column that shares its row where there is room for two."""
    return pn.Column(content, **_share("1 1 480px"))


def _share(flex: str) -> dict[str, Any]:
    """Return what lets a column share its row with others, and take a row of its own on a narrow page."""
    return {"sizing_mode": "stretch_width", "margin": 0, "styles": {"flex": flex, "min-width": "0"}}


def stamp(run: RunFolder) -> Stamp:
    """Return the times at which a run's files were written, None for those that are not there."""

    def written(path: Path) -> int | None:
        try:
            return path.stat().st_mtime_ns
        except OSError:
            return None

    return tuple(map(written, (run.record_file, run.status_file, run.metrics_file, run.result_file)))
