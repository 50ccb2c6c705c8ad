"""The page of sweeps: define one, start it, follow it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import panel as pn
import param

from toolkit.errors import ToolkitError
from toolkit.runs.markup import element
from toolkit.runs.report_html import warning_list
from toolkit.runs.sweep import create_sweep, start_sweep
from toolkit.runs.sweep_record import SweepFolder, list_sweeps
from toolkit.scene.capture_paths import require_capture_below
from toolkit.widgets.run_choice import RunChoice
from toolkit.widgets.style import html_pane, show_html
from toolkit.widgets.sweep_form import SweepForm
from toolkit.widgets.sweep_view import SweepView

_NONE = "no sweep yet"
# The widgets are as wide as a phone.
_INSET = "@media (min-width: 560px) { :host { padding: 0 14px; } }"


class SweepPage(pn.viewable.Viewer):
    """Sweeps of a folder of runs.

    Parameters
    ----------
    runs_dir:
        Folder of the runs.
    data_dirs:
        Folders in which captures are found.
    clusters:
        Addresses of Dask schedulers that may be chosen.
    dark:
        Whether the ground is dark.
    show:
        Opens another part of the page, as ``("view", run_id)``.

    Attributes
    ----------
    selected:
        Id of the sweep that is shown, empty for none; an id that is not there shows a remark.
    """

    selected = param.String(default="")

    def __init__(
        self,
        runs_dir: Path,
        data_dirs: Sequence[Path] = (),
        *,
        clusters: Sequence[str] = (),
        dark: bool = False,
        show: Callable[[str, str], None] | None = None,
    ) -> None:
        super().__init__()
        self._runs_dir, self._data_dirs = runs_dir, tuple(data_dirs)
        self._sweeps: dict[str, SweepFolder] = {}
        self._labels: dict[str, tuple[float, str]] = {}
        self._filling = False
        self.choice, self.form = RunChoice(data_dirs), SweepForm(clusters)
        self.view = SweepView(dark=dark, show=show)
        self._message, self._problem = html_pane(), html_pane()
        self._pick = pn.widgets.Select(
            label="Sweep",
            options={_NONE: _NONE},
            value=_NONE,
            width=340,
            margin=(10, 0, 8, 0),
        )
        self._start = pn.widgets.Button(label="Start the sweep", color="primary", width=170, margin=(8, 0, 4, 0))
        parts = (self.choice, html_pane(element("h2", "What is tried")), self.form, self._problem, self._start)
        self._new = pn.Card(
            pn.Column(*parts, sizing_mode="stretch_width", margin=(8, 0), stylesheets=[_INSET]),
            title="New sweep",
            collapsed=True,
            sizing_mode="stretch_width",
            margin=(4, 0),
        )
        self._layout = pn.Column(
            self._message, self._new, self._pick, self.view, sizing_mode="stretch_width", margin=(4, 10)
        )
        self._start.on_click(lambda event: self._begin())
        self._pick.param.watch(self._picked, "value")
        self.choice.param.watch(lambda event: self._take_choice(), ["changes", "problem"])
        self.form.param.watch(lambda event: self._check(), "problem")
        self._take_choice()
        self.refresh()
        self._new.collapsed = bool(self._sweeps)

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    def refresh(self) -> None:
        """Read what changed on the disk."""
        try:
            found = {sweep.id: sweep for sweep in list_sweeps(self._runs_dir)}
        except ToolkitError as error:
            self._tell(str(error))
            return
        self._sweeps = found
        options = {self._label(sweep): sweep.id for sweep in reversed(found.values())} or {_NONE: _NONE}
        if options != self._pick.options:
            self._filling = True
            try:
                newest = next(iter(options.values()))
                self._pick.param.update(options=options, value=self.selected if self.selected in found else newest)
            finally:
                self._filling = False
        self._pick.visible = bool(found)
        if not self.selected and found:
            self.selected = next(reversed(found))
        self.view.refresh()

    @param.depends("selected", watch=True)
    def _show_selected(self) -> None:
        """Show the sweep of this id, looked up in the list: nothing else is ever read."""
        sweep = self._sweeps.get(self.selected)
        unknown = self.selected and sweep is None
        self._tell(f"There is no sweep {self.selected[:80]!r} in {self._runs_dir}." if unknown else "")
        if sweep is not None:
            self._pick.value = self.selected
        self.view.choose(sweep)

    def _picked(self, event: param.parameterized.Event) -> None:
        if event.new in self._sweeps and not self._filling:
            self.selected = event.new

    def _label(self, sweep: SweepFolder) -> str:
        """Return how a sweep is called in the list; its plan is read once."""
        try:
            written = sweep.plan_file.stat().st_mtime
            if self._labels.get(sweep.id, (0.0, ""))[0] != written:
                plan = sweep.plan()
                text = f"{plan.name or plan.recipe} · {plan.method}, {plan.trials} trials · {sweep.id}"
                self._labels[sweep.id] = (written, text)
        except (ToolkitError, OSError):
            return f"{sweep.id} · damaged"
        return self._labels[sweep.id][1]

    def _take_choice(self) -> None:
        """Let the form know the settings that the sweep changes."""
        try:
            self.form.take_base(self.choice.form.settings())
        except ToolkitError:  # the choice itself says what is wrong
            self._start.disabled = True
            return
        self._check()

    def _check(self) -> None:
        problem = self.choice.problem or self.form.problem
        self._start.disabled = bool(problem)
        show_html(self._problem, warning_list([problem]) if problem else None)

    def _begin(self) -> None:
        """Create the sweep and let a process of its own work on it."""
        self._tell("")
        try:
            asked = self.choice.asked()
            sweep = create_sweep(
                asked.recipe,
                require_capture_below(asked.data, self._data_dirs),
                asked.settings,
                self._runs_dir,
                method=self.form.method,
                space=self.form.space(asked.settings),
                trials=self.form.trials,
                goal=self.form.goal,
                places=self.form.places_on(asked.device),
                seed=asked.seed,
                name=asked.name,
            )
            start_sweep(sweep)
        except ToolkitError as error:
            self._tell(str(error))
            return
        self.refresh()
        self.selected = sweep.id
        self._new.collapsed = True

    def _tell(self, error: str) -> None:
        show_html(self._message, warning_list([error]) if error else None)
