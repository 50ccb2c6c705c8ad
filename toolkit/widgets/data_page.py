"""The tab on which data are chosen, brought and looked at."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import panel as pn
import param

from toolkit.errors import DataError, ToolkitError
from toolkit.runs.markup import element
from toolkit.runs.report_html import warning_list
from toolkit.scene.capture_folders import CaptureFolder, capture_folder, find_captures, require_below
from toolkit.scene.unzip import ZipLimits
from toolkit.widgets.data_sets import DataSets
from toolkit.widgets.data_summary import CaptureView
from toolkit.widgets.sample_form import SampleForm
from toolkit.widgets.style import html_pane, show_html
from toolkit.widgets.task import Task
from toolkit.widgets.upload import LARGEST_UPLOAD
from toolkit.widgets.zip_form import ZipForm

#: As wide as there is room for, on telephones too.
_WIDE: dict[str, Any] = {"sizing_mode": "stretch_width", "max_width": 440, "margin": (4, 8)}
_NONE = ""
_LONGEST_SHOWN = 200


class DataPage(pn.viewable.Viewer):
    """Choose a capture, bring a new one, see what it is.

    Parameters
    ----------
    runs_dir:
        Folder of the runs: thumbnails are kept beside them, and matches are found there.
    data_dirs:
        Folders at and below which captures lie; nothing outside is ever opened. New data go into the first one.
    show:
        Opens another tab: called with ``"run"`` and the capture's path.
    dark:
        Whether the ground is dark.
    largest_upload:
        Bytes of the largest zip that is taken.
    zip_limits:
        What a zip may hold.

    Attributes
    ----------
    selected:
        Path of the capture that is shown, empty for none. One that is not below the data folders is refused.
    """

    selected = param.String(default="")

    def __init__(
        self,
        runs_dir: Path,
        data_dirs: Sequence[Path],
        *,
        show: Callable[[str, str], None] | None = None,
        dark: bool = False,
        largest_upload: int = LARGEST_UPLOAD,
        zip_limits: ZipLimits | None = None,
    ) -> None:
        super().__init__()
        self._data_dirs, self._show = tuple(data_dirs), show
        self._captures: dict[str, CaptureFolder] = {}
        # Those that were named by their path and are not in the list by themselves: hidden or deep ones.
        self._named: dict[str, CaptureFolder] = {}
        self._stamp: tuple[object, ...] | None = None
        self.view = CaptureView(runs_dir, data_dirs, dark=dark)
        self.sets = DataSets(data_dirs, self._take_new)
        self.sample = SampleForm(data_dirs, self._take_new)
        self.zip = ZipForm(data_dirs, self._take_new, most=largest_upload, limits=zip_limits)
        self._message, self._hint = html_pane(), html_pane()
        self._choice = pn.widgets.Select(label="Capture", options={}, size=8, **_WIDE)
        self._choice.param.watch(lambda event: self._choose(event.new), "value")
        self._path = pn.widgets.TextInput(
            label="Folder on the server", placeholder="below the data folders", **_WIDE
        )
        self._open = pn.widgets.Button(label="Open", width=100, margin=(4, 8))
        self._open.on_click(lambda event: self.open_path(self._path.value or ""))
        self._again = pn.widgets.Button(label="Look again", width=110, margin=(4, 8))
        self._again.on_click(lambda event: self.look_again())
        self._run = pn.widgets.Button(
            label="Run a method on it",
            color="primary",
            width=170,
            margin=(4, 8),
            disabled=True,
            visible=show is not None,
        )
        self._run.on_click(lambda event: self._show_run())
        self._layout = self._arranged()
        self.look_again()
        if pn.state.curdoc is not None:
            pn.state.on_session_destroyed(lambda context: self.leave())

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    @property
    def tasks(self) -> tuple[Task, ...]:
        """All that may work on this page."""
        return *self.view.tasks, self.sets.task, self.sample.task, self.zip.task

    @property
    def busy(self) -> bool:
        """Whether anything works."""
        return any(task.busy for task in self.tasks)

    def refresh(self) -> None:
        """Look at what works, and for captures where the data folders changed near their top."""
        for task in self.tasks:
            task.look()
        self.view.refresh()
        if _stamp(self._data_dirs) != self._stamp:
            self.look_again()

    def leave(self) -> None:
        """End what nobody sees any more; what is being made or fetched is finished all the same."""
        for task in self.view.tasks:
            task.cancel()
        if self.zip.upload is not None:
            self.zip.upload.drop()

    def look_again(self) -> None:
        """List the captures; what is chosen stays so while it is there."""
        self._stamp = _stamp(self._data_dirs)
        found = {str(capture.path): capture for capture in find_captures(self._data_dirs)}
        self._named = {
            path: capture for path, capture in self._named.items() if path not in found and _is_there(capture)
        }
        self._captures = {**found, **self._named}
        gone = self.selected if self.selected not in self._captures else ""
        if gone:
            self.selected = ""
        self._offer()
        self.sets.refresh()
        if gone:
            self._say(f"{gone} is not there any more.")

    def open_path(self, text: str) -> None:
        """Show the capture in a folder that a person names; anything outside the data folders is refused."""
        try:
            self._add(text)
        except ToolkitError as error:
            self._say(str(error))
            return
        self._say("")

    def _add(self, text: str) -> None:
        """Choose the capture at a path, and list it where it is not."""
        capture = self._allowed(text)
        if str(capture.path) not in self._captures:
            self._named[str(capture.path)] = self._captures[str(capture.path)] = capture
            self._offer()
        self.selected = str(capture.path)

    def _allowed(self, text: str) -> CaptureFolder:
        """Return the capture at a path, where it may be shown."""
        if not text.strip() or "\0" in text:
            raise DataError("No folder was named", expected="the path of a folder below the data folders")
        try:
            path = require_below(Path(text.strip()), self._data_dirs)
            is_folder = path.is_dir()
        except (OSError, RuntimeError) as error:  # a name that is too long, links in a circle
            raise DataError("This cannot be a folder", found=str(error)[:_LONGEST_SHOWN]) from error
        root = next(root for root in self._data_dirs if path.is_relative_to(root.resolve()))
        capture = capture_folder(path, root.resolve())
        if capture is None:
            raise DataError(
                f"{text[:_LONGEST_SHOWN]} is no capture",
                expected="a folder with photos, with images/, with scene.json or with transforms.json",
                found="nothing of the kind" if is_folder else "no folder",
            )
        return capture

    def _choose(self, value: str | None) -> None:
        if (value or "") != self.selected:
            self._say("")
            self.selected = value or ""

    @param.depends("selected", watch=True)
    def _take_selected(self) -> None:
        """Show what is selected, by whomever: the address says it, too."""
        if self.selected and self.selected not in self._captures:
            wanted = self.selected
            self.selected = ""
            self.open_path(wanted)
            return
        self._choice.value = self.selected
        self._run.disabled = not self.selected
        self.view.display(self._captures[self.selected].path if self.selected else None)

    def _take_new(self, folder: Path) -> None:
        """Show what was just made, fetched or uploaded."""
        self.look_again()
        try:
            resolved = require_below(folder, self._data_dirs)
        except DataError:
            self._say(f"{folder} is not among the data folders of this page: start it with that folder to show it.")
            return
        inside = [path for path in self._captures if Path(path).is_relative_to(resolved)]
        if not inside:
            self._say(f"There are no pictures for a run in {folder}.")
            return
        self._say("")
        self.selected = inside[0]

    def _show_run(self) -> None:
        if self._show is not None and self.selected:
            self._show("run", self.selected)

    def _offer(self) -> None:
        options = {"– none –": _NONE, **_labels(self._captures)}
        value = self.selected if self.selected in self._captures else _NONE
        self._choice.param.update(options=options, value=value, size=min(10, max(4, len(options))))
        folders = ", ".join(str(folder) for folder in self._data_dirs) or "no folder"
        count = len(self._captures)
        show_html(
            self._hint, element("p", f"{count} capture{'' if count == 1 else 's'} in {folders}.", class_="note")
        )

    def _say(self, text: str) -> None:
        show_html(self._message, warning_list([text]) if text else None)

    def _arranged(self) -> pn.Column:
        row = pn.FlexBox(self._again, self._run, sizing_mode="stretch_width", margin=0)
        own = pn.FlexBox(self._path, self._open, align_items="flex-end", sizing_mode="stretch_width", margin=0)
        sample = _card("Make a sample", self.sample)
        sample.param.watch(lambda event: self.sample.prepare(), "collapsed")
        more = [
            _card("Public data sets", self.sets),
            sample,
            _card("Folder on the server", own),
            _card("Upload a zip", self.zip),
        ]
        left = pn.Column(
            html_pane(element("h2", "Captures")), self._hint, self._choice, row, styles=_SHARED, margin=0
        )
        right = pn.Column(html_pane(element("h2", "More data")), *more, styles=_SHARED, margin=0)
        top = pn.FlexBox(left, right, gap="24px", sizing_mode="stretch_width", margin=0)
        return pn.Column(top, self._message, self.view, sizing_mode="stretch_width", margin=0)


_SHARED = {"flex": "1 1 min(340px, 100%)", "min-width": "0"}


def _card(title: str, content: pn.viewable.Viewable | pn.viewable.Viewer) -> pn.Card:
    inside = pn.Column(content, sizing_mode="stretch_width", margin=(6, 10))
    return pn.Card(inside, title=title, collapsed=True, sizing_mode="stretch_width", margin=(4, 0))


def _labels(captures: dict[str, CaptureFolder]) -> dict[str, str]:
    """Return the path of each capture by what it is called in the list."""
    labels: dict[str, str] = {}
    for path, capture in captures.items():
        photos = f"{capture.photos} photos" if capture.photos else "pictures elsewhere"
        label = f"{capture.label} · {capture.layout}, {photos}"
        # Two folders may have captures of one name.
        labels[label if label not in labels else f"{label} · {capture.root}"] = path
    return labels


def _is_there(capture: CaptureFolder) -> bool:
    return capture_folder(capture.path, capture.root) is not None


def _stamp(roots: Sequence[Path]) -> tuple[object, ...]:
    """Return what changes when a folder comes or goes in the data folders or in a folder of theirs."""
    stamps: list[object] = []
    for root in roots:
        try:
            with os.scandir(root) as entries:
                inner = [
                    (entry.name, entry.stat(follow_symlinks=False).st_mtime_ns)
                    for entry in entries
                    if not entry.name.startswith(".") and entry.is_dir(follow_symlinks=False)
                ]
        except OSError:
            continue
        stamps.append((str(root), *sorted(inner)))
    return tuple(stamps)
