"""The tab on which runs are started, and what waits and works is seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import panel as pn
import param

from toolkit.errors import ToolkitError
from toolkit.progress import Progress
from toolkit.runs.estimate import Estimator
from toolkit.runs.extend import extend_run
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import create_run
from toolkit.runs.machine import threads_elsewhere
from toolkit.runs.markup import element
from toolkit.runs.measures import format_seconds
from toolkit.runs.report_html import warning_list
from toolkit.runs.stop import let_wait
from toolkit.scene.capture_paths import require_capture_below
from toolkit.widgets.earlier_runs import EarlierRuns
from toolkit.widgets.queue_list import QueueList
from toolkit.widgets.recent_runs import RecentRuns
from toolkit.widgets.run_choice import Choice, RunChoice
from toolkit.widgets.style import html_pane, show_html
from toolkit.widgets.task import Task

#: What is said while a run is made.
_STAGES = {"photos": "Checking pictures", "fingerprint": "Hashing pictures"}


class RunPage(pn.viewable.Viewer):
    """Choose, start, and see what waits.

    Parameters
    ----------
    runs_dir:
        Folder of the runs. An id from outside is looked up in it.
    data_dirs:
        Folders at and below which captures lie; no others can be chosen.
    show:
        Opens another tab for a run: called with ``"watch"`` and the id of a run that was started.
    dark:
        Whether the ground is dark; colours come from the page.

    Attributes
    ----------
    selected:
        Id of the earlier run that is chosen, empty for none.
    """

    selected = param.String(default="")

    def __init__(
        self,
        runs_dir: Path,
        data_dirs: Sequence[Path],
        *,
        show: Callable[[str, str], None] | None = None,
        dark: bool = False,
    ) -> None:
        super().__init__()
        self._runs_dir, self._data_dirs, self._show = runs_dir, tuple(data_dirs), show
        self._making = Task()
        self._error = ""
        self._estimator = Estimator(runs_dir)
        self._recent = RecentRuns(runs_dir)
        self.choice = RunChoice(self._data_dirs)
        self.queue = QueueList(runs_dir, self._recent, self.say, show)
        self.earlier = EarlierRuns(
            self._recent, self.say, duplicate=self._duplicate, extend=self._extend, chosen=self._chosen
        )
        self._start = pn.widgets.Button(label="Start", color="primary", width=130, margin=(4, 12, 4, 0))
        self._start.on_click(lambda event: self.start())
        self._estimate, self._message = html_pane(), html_pane()
        self._message.param.update(styles={"flex": "1 1 100%"})
        self._layout = self._arranged()
        self.choice.param.watch(lambda event: self._show_estimate(), "changes")
        self._making.param.watch(lambda event: self._show_start(), "busy")
        self.refresh()

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    def refresh(self) -> None:
        """Read the disk again and show what changed."""
        try:
            self._recent.refresh()
            self.queue.refresh()
            problem = ""
        except ToolkitError as error:
            problem = str(error)
        if problem != self._error:
            self._error = problem
            self.say(problem, True)
        self.earlier.refresh()
        self.choice.refresh()
        self._show_estimate()
        self._making.look()

    def choose_data(self, capture: Path) -> None:
        """Put a capture into the form; one that is not among the data is told."""
        self.choice.look_for_data()
        if not self.choice.choose_data(capture):
            self.say(f"{capture} is not among the data that can be chosen here.", True)

    def say(self, text: str, is_error: bool = False) -> None:
        """Show a message that stays until the next one."""
        content = warning_list([text]) if is_error else element("p", text, class_="said", role="status")
        show_html(self._message, content if text else None)

    def start(self) -> None:
        """Make the run that is asked for and let it wait for its turn; a thread hashes the pictures."""
        try:
            asked = self.choice.asked()
        except ToolkitError as error:
            self.say(str(error), True)
            return
        self._begin(lambda progress: self._created(asked, progress))

    @property
    def busy(self) -> bool:
        """Whether a run is being made."""
        return bool(self._making.busy)

    def _created(self, asked: Choice, progress: Progress) -> RunFolder:
        return create_run(
            asked.recipe,
            require_capture_below(asked.data, self._data_dirs),
            asked.settings,
            self._runs_dir,
            seed=asked.seed,
            device=asked.device,
            name=asked.name,
            threads=threads_elsewhere(),
            progress=progress,
        )

    def _extend(self, run: RunFolder, steps: int) -> None:
        self._begin(lambda progress: extend_run(run, steps, progress=progress))

    def _begin(self, work: Callable[[Progress], RunFolder]) -> None:
        if self.busy:
            self.say("Another run is being made: wait until it is there.", True)
            return
        self.say("")
        # It is let to wait in the thread, too: a run that was asked for waits even where the browser is closed.
        self._making.begin(
            "The run is being made", lambda progress: _waiting(work(progress)), self._take_made, stages=_STAGES
        )

    def _take_made(self, made: tuple[RunFolder, str]) -> None:
        run, said = made
        self.say(said)
        self.refresh()
        if self._show is not None:
            self._show("watch", run.id)

    def _duplicate(self, run: RunFolder) -> None:
        told = self.choice.fill(run.record())
        label = run.record().name or run.id
        self.say(" ".join([f"The form shows what {label} was made from.", *told]), bool(told))

    def _chosen(self, run_id: str) -> None:
        self.selected = run_id

    @param.depends("selected", watch=True)
    def _take_selected(self) -> None:
        if not self.earlier.choose(self.selected):
            self.say(f"There is no run {self.selected[:80]!r} here.", True)

    def _show_start(self) -> None:
        self._start.disabled = self.busy or bool(self.choice.problem)

    def _show_estimate(self) -> None:
        self._show_start()
        capture, problem = self.choice.capture, self.choice.problem
        if problem or capture is None:
            show_html(self._estimate, element("p", problem, class_="note"))
            return
        asked = self.choice.asked()
        try:
            found = self._estimator.estimate(
                asked.recipe.name, asked.settings, photos=asked.photos, data=str(asked.data), device=asked.device
            )
        except ToolkitError as error:
            show_html(self._estimate, warning_list([str(error)]))
            return
        time = ["About ", element("b", format_seconds(found.seconds)), ". "] if found.seconds is not None else None
        show_html(self._estimate, element("p", time, element("span", found.basis, class_="what"), class_="note"))

    def _arranged(self) -> pn.Column:
        bar = pn.FlexBox(
            self._start,
            pn.Column(self._estimate, self._making, styles={"flex": "1 1 300px", "min-width": "0"}, margin=0),
            align_items="center",
            sizing_mode="stretch_width",
            margin=(8, 0),
        )
        return pn.Column(
            _title("New run"),
            self.choice,
            bar,
            self._message,
            _title("Waiting and working"),
            self.queue,
            _title("Go on from an earlier run"),
            self.earlier,
            sizing_mode="stretch_width",
            margin=0,
        )


def _waiting(run: RunFolder) -> tuple[RunFolder, str]:
    return run, let_wait(run)


def _title(text: str) -> pn.pane.HTML:
    return html_pane(element("h2", text))
