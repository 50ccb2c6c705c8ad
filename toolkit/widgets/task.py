"""Work in a thread with its progress bar and a button that ends it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar
from weakref import WeakSet

import panel as pn
import param

from toolkit.errors import Cancelled, ToolkitError
from toolkit.progress import CancelToken, Progress, fan_out
from toolkit.runs.markup import Content, element
from toolkit.runs.report_html import warning_list
from toolkit.widgets.job import Job
from toolkit.widgets.style import html_pane, show_html

T = TypeVar("T")

#: What may work now, on any page.
_tokens: WeakSet[CancelToken] = WeakSet()
#: Milliseconds between two looks at what works.
_LOOK = 200


class Task(pn.viewable.Viewer):
    """Does one thing at a time; what is begun anew ends what works.

    Attributes
    ----------
    busy:
        Whether something works.
    """

    busy = param.Boolean(default=False)

    def __init__(self) -> None:
        super().__init__()
        self._job: Job[Any] | None = None
        self._token = CancelToken()
        self._take: Callable[[Any], None] | None = None
        self._what = ""
        self._stages: Mapping[str, str] = {}
        self._looks: Any = None
        self._line, self._message = html_pane(), html_pane()
        self._line.param.update(styles={"flex": "1 1 240px", "min-width": "0"})
        self._cancel = pn.widgets.Button(label="Cancel", width=90, margin=(2, 8), visible=False)
        self._cancel.on_click(lambda event: self.cancel())
        bar = pn.FlexBox(self._line, self._cancel, align_items="center", sizing_mode="stretch_width", margin=0)
        self._layout = pn.Column(bar, self._message, sizing_mode="stretch_width", margin=0)

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    def begin(
        self,
        what: str,
        work: Callable[[Progress], T],
        take: Callable[[T], None],
        *,
        stages: Mapping[str, str] | None = None,
    ) -> None:
        """Start ``work`` in a thread; what it makes is given to ``take`` in the page's own thread.

        Parameters
        ----------
        what:
            That is said beside the bar.
        work:
            Told where to report progress; ends where that raises.
        take:
            Not called where the work was cancelled, or failed: then the reason is shown.
        stages:
            What is said in place of ``what`` while a stage of this name works.
        """
        self._token.cancel()
        token = CancelToken()
        _tokens.add(token)
        self._token, self._what, self._take = token, what, take
        self._stages = stages or {}
        self._job = Job(lambda hear: work(fan_out([token, hear])))
        self.say("")
        self.busy = True
        if self._looks is None and pn.state.curdoc is not None:
            self._looks = pn.state.add_periodic_callback(self.look, period=_LOOK)
        self.look()

    def cancel(self) -> None:
        """Ask what works to end; it does so at its next step."""
        self._token.cancel()
        self._cancel.disabled = True

    def drop(self) -> None:
        """End what works and forget it: nothing of it is shown any more."""
        self._token.cancel()
        self._job = None
        self.say("")
        self.look()

    def look(self) -> None:
        """Show how far it is, and take what it made."""
        job = self._job
        if job is not None and job.done:
            self._job = None
            self._finish(job)
        self._show()

    def say(self, text: str, is_error: bool = False) -> None:
        """Show a message that stays until the next one."""
        content: Content = warning_list([text]) if is_error else element("p", text, class_="note", role="status")
        show_html(self._message, content if text else None)

    def _finish(self, job: Job[Any]) -> None:
        take = self._take
        try:
            made = job.result()
        except Cancelled:
            self.say(f"{self._what}: cancelled.")
        except ToolkitError as error:
            self.say(str(error), True)
        except OSError as error:
            self.say(f"{self._what} failed: {error}", True)
        else:
            if take is not None:
                take(made)

    def _show(self) -> None:
        job = self._job
        self.busy = job is not None
        self._cancel.visible = job is not None
        if job is None:
            self._cancel.disabled = False
            show_html(self._line)
            if self._looks is not None:
                self._looks.stop()
                self._looks = None
            return
        share, event = job.share, job.event
        what = self._stages.get(event.stage, self._what) if event is not None else self._what
        text = what + (f" {100 * share:.0f} %" if share is not None else "")
        more = event.message if event is not None else ""
        bar = element("progress", value=share, max=1, aria_label=what, style="width:100%;height:10px")
        show_html(self._line, element("p", text, element("span", f" {more}", class_="what"), class_="note"), bar)


def cancel_all() -> None:
    """Ask everything that works for any page to end: a server that was told to stop waits for its threads."""
    for token in list(_tokens):
        token.cancel()
