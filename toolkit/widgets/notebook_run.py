"""Start a run from a notebook cell and follow it: settings, a button, a bar, curves, the latest render."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import plotly.graph_objects as go

from toolkit.errors import ToolkitError
from toolkit.optional import require
from toolkit.plots.style import colour, figure
from toolkit.recipes.registry import find_recipe
from toolkit.runs.curve_tail import CurveTail
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import create_run
from toolkit.runs.live import live_picture
from toolkit.runs.markup import element
from toolkit.runs.measures import format_number
from toolkit.runs.stop import RESUMABLE, let_wait, stop_run
from toolkit.settings import Settings
from toolkit.widgets.notebook_settings import SettingsBox

#: Seconds between looks at the run's folder.
EVERY = 1.0
_MEASURES = ("test.psnr", "test.ssim", "poses.sim3.pos", "poses.sim3.rot_deg")
_ENDED = RESUMABLE | {"finished"}


class RunBox:
    """Settings of a method, Start, Cancel, and how the run goes.

    The run is a process of its own: a kernel that is restarted does not end it, and :meth:`follow` finds it again.

    Parameters
    ----------
    recipe:
        Name of the method (``toolkit recipes`` lists them).
    data:
        Folder of the capture.
    runs_dir:
        Where runs lie.
    settings:
        To begin with; by default the method's own.
    seed, device:
        Of the runs.
    start:
        How a new run is started; by default it waits for its turn.

    Attributes
    ----------
    run:
        The run that is followed, None before the first.
    settings:
        The form.

    Raises
    ------
    SettingsError
        For an unknown method.
    MissingDependencyError
        Where ipywidgets or anywidget is not installed.
    """

    def __init__(
        self,
        recipe: str,
        data: Path,
        runs_dir: Path,
        *,
        settings: Settings | None = None,
        seed: int = 0,
        device: str = "cpu",
        start: Callable[[RunFolder], object] = let_wait,
    ) -> None:
        widgets = require("ipywidgets")
        require("anywidget")  # Plotly's own message for it does not say how to get it
        self._recipe, self._data, self._runs_dir = find_recipe(recipe), data, runs_dir
        self._seed, self._device, self._start_run = seed, device, start
        self.run: RunFolder | None = None
        self.settings = SettingsBox(settings or self._recipe.settings_type)
        self._start = widgets.Button(description="Start", button_style="primary")
        self._cancel = widgets.Button(description="Cancel", disabled=True)
        self._bar = widgets.IntProgress(layout={"width": "320px"})
        self._text, self._result = widgets.Label(), widgets.HTML()
        self._curve = go.FigureWidget(figure("", 260, margin={"l": 60, "r": 10, "t": 10, "b": 40}))
        self._curve.add_scatter(name="loss", mode="lines", line={"color": colour(0)})
        self._curve.update_layout(xaxis_title_text="step", yaxis_title_text="loss", yaxis_type="log")
        self._picture = widgets.Image(format="jpeg", layout={"max_width": "420px"})
        self._start.on_click(lambda button: self.start())
        self._cancel.on_click(lambda button: self.cancel())
        self._tail: CurveTail | None = None
        self._shown: int | None = None
        self._follower: threading.Thread | None = None
        row = widgets.HBox([self._start, self._cancel, self._bar, self._text])
        self.box = widgets.VBox([self.settings.box, row, widgets.HBox([self._curve, self._picture]), self._result])

    def start(self) -> None:
        """Start a run with the settings as they are; what is wrong with them is shown."""
        try:
            run = create_run(
                self._recipe,
                self._data,
                self.settings.settings(),
                self._runs_dir,
                seed=self._seed,
                device=self._device,
            )
            self._start_run(run)
        except ToolkitError as error:
            self._tell(str(error))
            return
        self.follow(run)

    def follow(self, run: RunFolder) -> None:
        """Show how a run goes until it ends."""
        self.run, self._tail, self._shown = run, CurveTail(run.metrics_file), None
        self._start.disabled, self._cancel.disabled, self._result.value = True, False, ""
        self._follower = threading.Thread(target=self._look, args=(run,), name=f"follow {run.id}", daemon=True)
        self._follower.start()

    def cancel(self) -> None:
        """Ask the run to stop at its next step; it can be resumed."""
        if self.run is not None:
            try:
                self._text.value = stop_run(self.run)
            except ToolkitError as error:
                self._tell(str(error))

    def wait(self, seconds: float | None = None) -> bool:
        """Wait for the end of the run that is followed; return whether it came. For cells that need its result."""
        if self._follower is not None:
            self._follower.join(seconds)
        return self._follower is None or not self._follower.is_alive()

    def _look(self, run: RunFolder) -> None:
        pause = threading.Event()
        while self.run is run and self._take(run):
            pause.wait(EVERY)

    def _take(self, run: RunFolder) -> bool:
        """Show what the run's folder says now; return whether more is to come."""
        assert self._tail is not None
        try:
            status = run.status()
            self._tail.read()
            picture = live_picture(run)
        except ToolkitError as error:
            self._tell(str(error))
            return run.path.is_dir()
        if status.total:
            self._bar.max, self._bar.value = status.total, status.done
        self._text.value = " ".join(filter(None, (status.state, status.stage, status.message)))
        loss = self._tail.find("loss")
        if loss is not None:
            with self._curve.batch_update():
                self._curve.data[0].update(x=list(loss.steps), y=list(loss.values))
        if picture is not None and picture.step != self._shown:
            self._shown, self._picture.value = picture.step, picture.render.read_bytes()
        ended = status.state in _ENDED
        if ended:
            self._start.disabled, self._cancel.disabled = False, True
            self._tell(status.error) if status.error else self._show_result(run)
        return not ended

    def _show_result(self, run: RunFolder) -> None:
        metrics = run.result().metrics
        parts = [f"{name} {format_number(metrics[name])}" for name in _MEASURES if metrics.get(name) is not None]
        self._result.value = str(element("p", f"{run.id}: " + ", ".join(parts)))

    def _tell(self, text: str) -> None:
        self._result.value = str(element("p", text, style="color: #b3261e"))

    def _repr_mimebundle_(self, **options: Any) -> dict[str, Any]:
        shown: dict[str, Any] = self.box._repr_mimebundle_(**options) or {}
        return shown
