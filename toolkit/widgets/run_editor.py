"""What a person does with a run of the list: tag it, write a note, delete it, bring it back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import panel as pn
import param

from toolkit.errors import RunError, ToolkitError
from toolkit.runs.index import RunSummary
from toolkit.runs.markup import element
from toolkit.runs.notes import LONGEST_TEXT, RunNotes, split_tags, write_notes
from toolkit.runs.trash import delete_run, deleted_runs, empty_bin, restore_run
from toolkit.widgets.style import SELECT, html_pane, show_html

_MARGIN = (0, 12, 8, 0)
_BUTTON = (22, 12, 8, 0)


class RunEditor(pn.viewable.Viewer):
    """Tags, note and deletion of one of the chosen runs, and the bin.

    Parameters
    ----------
    runs_dir:
        Folder of the runs.
    changed:
        Called after something was written, moved or removed.
    show:
        Opens another part of the page (``"watch"``, ``"view"``) for a run; None where there are none.

    Attributes
    ----------
    selected:
        Id of the run that the fields are of; always one of those that were offered, or empty.
    problem:
        Why the last deed was refused, empty where it was not.
    """

    selected = param.String(default="")
    problem = param.String(default="")

    def __init__(
        self, runs_dir: Path, changed: Callable[[], None], show: Callable[[str, str], None] | None = None
    ) -> None:
        super().__init__()
        self._runs_dir = runs_dir
        self._changed = changed
        self._show = show
        self._rows: dict[str, RunSummary] = {}
        self._shown: tuple[str, str, str] = ("", "", "")
        self._undo_ids: list[str] = []
        self._said = ""
        self.run = pn.widgets.Select(
            label="Of the chosen runs", options=[], width=230, margin=_MARGIN, stylesheets=[SELECT]
        )
        self.tags = pn.widgets.TextInput(
            label="Tags", placeholder="with commas between them", width=200, margin=_MARGIN
        )
        self.note = pn.widgets.TextAreaInput(
            label="Note", max_length=LONGEST_TEXT, rows=1, auto_grow=True, max_rows=8, width=320, margin=_MARGIN
        )
        self.save = _button("Save", self._save, color="primary")
        self.delete = _button("Delete run", self._delete)
        self.undo = _button("Undo", self._undo)
        self.bin = pn.widgets.Select(
            label="Deleted runs", options=[], width=230, margin=_MARGIN, stylesheets=[SELECT]
        )
        self.restore = _button("Bring back", lambda: self._restore(self.bin.value))
        self.empty = _button("Empty the bin", self._ask)
        self.really = _button("Remove for good", self._empty, color="danger")
        self.keep = _button("Keep them", self._keep)
        self._asked: list[str] = []
        self._message = html_pane()
        tabs = (("Watch", "watch"), ("View", "view")) if show is not None else ()
        self._open = [_button(label, partial(self._open_tab, tab)) for label, tab in tabs]
        self._fields = _row(self.run, self.tags, self.note, self.save, self.delete, *self._open)
        self._bin_row = _row(self.bin, self.restore, self.empty, self.really, self.keep)
        self.run.param.watch(lambda event: setattr(self, "selected", event.new or ""), "value")
        self.param.watch(lambda event: self._show_notes(), "selected")
        self.offer([])
        self.refresh()

    def __panel__(self) -> pn.viewable.Viewable:
        said = pn.Row(self._message, self.undo, sizing_mode="stretch_width", margin=0)
        return pn.Column(self._fields, said, self._bin_row, sizing_mode="stretch_width", margin=0)

    def offer(self, rows: Sequence[RunSummary]) -> None:
        """Let one of ``rows`` be edited; what a person is typing stays."""
        self._rows = {row.run.id: row for row in rows}
        options = {f"{row.label} ({run_id[-4:]})": run_id for run_id, row in self._rows.items()}
        kept = self.selected if self.selected in self._rows else next(reversed(self._rows), "")
        if options != self.run.options:
            self.run.param.update(options=options, value=kept or None)
        self.selected = kept
        self._fields.visible = bool(self._rows)
        self._show_notes()

    @property
    def has_deleted(self) -> bool:
        """Whether there is anything in the bin."""
        return bool(self.bin.options)

    def select(self, run_id: str) -> None:
        """Edit another one of the runs that were offered."""
        if run_id in self._rows:
            self.run.value = run_id

    def refresh(self) -> None:
        """Show what is in the bin."""
        try:
            there = deleted_runs(self._runs_dir)
        except RunError as error:
            self.problem = str(error)
            return
        if there != self.bin.options:
            kept = self.bin.value if self.bin.value in there else next(reversed(there), None)
            self.bin.param.update(options=there, value=kept)
        self._asked = [run_id for run_id in self._asked if run_id in there]
        self._undo_ids = [run_id for run_id in self._undo_ids if run_id in there]
        self._bin_row.visible = bool(there)
        self._show_bin()

    def _show_notes(self) -> None:
        """Fill the fields, unless a person has changed them since they were filled."""
        row = self._rows.get(self.selected)
        stored = (self.selected, ", ".join(row.tags) if row else "", row.note if row else "")
        typed = (self._shown[0], self.tags.value_input or "", self.note.value_input or "")
        if stored == self._shown or (stored[0] == self._shown[0] and typed != self._shown):
            return
        self._shown = stored
        self.tags.param.update(value=stored[1], value_input=stored[1])
        self.note.param.update(value=stored[2], value_input=stored[2])

    def _show_bin(self) -> None:
        asking = bool(self._asked)
        self.empty.visible, self.really.visible, self.keep.visible = not asking, asking, asking
        self.undo.visible = bool(self._undo_ids)
        show_html(self._message, element("p", self._said, class_="note", role="status") if self._said else None)

    def _do(self, deed: Callable[[], str]) -> None:
        """Do something, say how it went, and let the page look at the disk again."""
        try:
            self._said = deed()
            self.problem = ""
        except ToolkitError as error:
            self._said = ""
            self.problem = str(error)
        self.refresh()
        self._changed()

    def _save(self) -> None:
        row = self._rows.get(self.selected)
        if row is None:
            return

        def deed() -> str:
            notes = RunNotes(split_tags(self.tags.value_input or ""), (self.note.value_input or "").strip())
            write_notes(row.run, notes)
            # What was typed is stored now: the next look at the disk may fill the fields.
            self._shown = (self.selected, self.tags.value_input or "", self.note.value_input or "")
            return f"Saved what you say about {row.label}."

        self._do(deed)

    def _delete(self) -> None:
        row = self._rows.get(self.selected)
        if row is None:
            return

        def deed() -> str:
            delete_run(row.run)
            self._undo_ids.append(row.run.id)
            return f"Deleted {row.label} ({row.run.id}). It is in the bin."

        self._do(deed)

    def _open_tab(self, tab: str) -> None:
        if self._show is not None and self.selected:
            self._show(tab, self.selected)

    def _undo(self) -> None:
        if self._undo_ids:
            self._restore(self._undo_ids[-1])

    def _restore(self, run_id: str | None) -> None:
        if run_id:
            self._do(lambda: f"Brought back {restore_run(run_id, self._runs_dir).id}.")

    def _ask(self) -> None:
        self._asked = list(self.bin.options)
        count = len(self._asked)
        self._said = f"Remove {count} run{'' if count == 1 else 's'} for good? Nothing brings them back."
        self._show_bin()

    def _keep(self) -> None:
        self._asked, self._said = [], ""
        self._show_bin()

    def _empty(self) -> None:
        asked, self._asked = self._asked, []

        def deed() -> str:
            empty_bin(asked, self._runs_dir)
            return f"Removed {len(asked)} run{'' if len(asked) == 1 else 's'} for good."

        self._do(deed)


def _button(label: str, pressed: Callable[[], None], color: str = "default") -> pn.widgets.Button:
    made = pn.widgets.Button(label=label, color=color, margin=_BUTTON)
    made.on_click(lambda event: pressed())
    return made


def _row(*parts: pn.viewable.Viewable) -> pn.FlexBox:
    return pn.FlexBox(*parts, align_items="flex-start", sizing_mode="stretch_width", margin=0)
