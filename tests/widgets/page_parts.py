"""Looking at parts of a page as a person does: texts, widgets by their label, and waiting."""

from __future__ import annotations

import time

import panel as pn

from toolkit.progress import Progress, ProgressEvent
from toolkit.widgets.data_page import DataPage
from toolkit.widgets.task import Task


def done(page: DataPage, seconds: float = 60) -> DataPage:
    """Wait until nothing works any more."""
    end = time.monotonic() + seconds
    while page.busy:
        assert time.monotonic() < end, "it still works"
        for task in page.tasks:
            task.look()
        time.sleep(0.01)
    return page


def said(viewer: pn.viewable.Viewer) -> str:
    """Return all HTML that can be seen."""
    layout = viewer.__panel__()
    return "\n".join(pane.object for pane in layout.select(pn.pane.HTML) if pane.visible and pane.object)


def widget(viewer: pn.viewable.Viewer, label: str) -> pn.widgets.Widget:
    (found,) = [each for each in viewer.__panel__().select(pn.widgets.Widget) if each.label == label]
    return found


def press(viewer: pn.viewable.Viewer, label: str) -> None:
    button = widget(viewer, label)
    button.clicks += 1


def working(task: Task) -> None:
    """Wait until a task has ended."""
    end = time.monotonic() + 20
    while task.busy:
        assert time.monotonic() < end
        task.look()
        time.sleep(0.005)


def endless(progress: Progress) -> str:
    """Work for twenty seconds, telling of it."""
    for number in range(4000):
        progress(ProgressEvent("stage", number, 4000, "<i>"))
        time.sleep(0.005)
    return "the end"
