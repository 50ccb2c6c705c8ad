"""A person tags a run, writes a note, deletes it and brings it back; what is refused is said."""

from __future__ import annotations

import errno
from pathlib import Path

import panel as pn
import pytest
from fake_recipe import MakeRun

from toolkit.runs.folder import RunFolder
from toolkit.runs.index import summarise
from toolkit.runs.notes import RunNotes, read_notes, write_notes
from toolkit.runs.process import ProcessMark
from toolkit.runs.status import RunStatus, utc_now, write_status
from toolkit.runs.trash import deleted_runs
from toolkit.widgets.run_editor import RunEditor


class Opened:
    """An editor, and how often it told that something changed."""

    def __init__(self, runs_dir: Path, *runs: RunFolder) -> None:
        self.changes = 0
        self.asked: list[tuple[str, str]] = []
        self.editor = RunEditor(runs_dir, self._count, lambda tab, run_id: self.asked.append((tab, run_id)))
        self.editor.offer([summarise(run) for run in runs])

    def _count(self) -> None:
        self.changes += 1

    def said(self) -> str:
        panes = self.editor.__panel__().select(pn.pane.HTML)
        return "\n".join(pane.object for pane in panes if pane.visible)


def press(button: pn.widgets.Button) -> None:
    button.clicks += 1


def test_tags_and_note_are_stored(pair: list[RunFolder], runs_dir: Path) -> None:
    opened = Opened(runs_dir, *pair)
    editor = opened.editor
    assert editor.selected == pair[1].id  # the one that was chosen last
    editor.tags.value_input = " good,  good, first one "
    editor.note.value_input = "It <b>works</b>.\n"
    press(editor.save)
    assert read_notes(pair[1]) == RunNotes(("good", "first one"), "It <b>works</b>.")
    assert opened.changes == 1
    assert "Saved what you say about fast." in opened.said()
    editor.offer([summarise(run) for run in pair])
    assert editor.tags.value == "good, first one"


def test_what_is_being_typed_is_left_alone(pair: list[RunFolder], runs_dir: Path) -> None:
    editor = Opened(runs_dir, *pair).editor
    editor.note.value_input = "half a sen"
    write_notes(pair[1], RunNotes(("by", "another"), "page"))
    editor.offer([summarise(run) for run in pair])
    assert editor.note.value_input == "half a sen"
    editor.run.value = pair[0].id
    assert editor.note.value_input == ""
    editor.run.value = pair[1].id
    assert (editor.tags.value_input, editor.note.value_input) == ("by, another", "page")


def test_what_cannot_be_stored_is_refused_and_stays_in_its_field(pair: list[RunFolder], runs_dir: Path) -> None:
    editor = Opened(runs_dir, *pair).editor
    editor.tags.value_input = "x" * 31
    press(editor.save)
    assert "expected 1 to 30 characters without commas; found 31 characters" in editor.problem
    assert editor.tags.value_input == "x" * 31
    assert read_notes(pair[1]) == RunNotes()
    editor.tags.value_input = "short"
    press(editor.save)
    assert editor.problem == ""


def test_a_full_disk_is_told(pair: list[RunFolder], runs_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    editor = Opened(runs_dir, *pair).editor

    def full(self: Path, *args: object, **options: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    editor.tags.value_input = "good"
    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_text", full)
        press(editor.save)
    assert "The disk is full while writing" in editor.problem
    press(editor.save)
    assert editor.problem == ""
    assert read_notes(pair[1]).tags == ("good",)


def test_deleting_can_be_undone(pair: list[RunFolder], runs_dir: Path) -> None:
    opened = Opened(runs_dir, *pair)
    editor = opened.editor
    assert not editor.undo.visible
    press(editor.delete)
    assert deleted_runs(runs_dir) == [pair[1].id]
    assert f"Deleted fast ({pair[1].id}). It is in the bin." in opened.said()
    assert editor.undo.visible
    press(editor.undo)
    assert deleted_runs(runs_dir) == []
    assert pair[1].path.is_dir()
    assert not editor.undo.visible


def test_a_run_that_works_is_not_deleted(queued: MakeRun, runs_dir: Path) -> None:
    run = queued(name="at work")
    mark, now = ProcessMark.current(), utc_now()
    write_status(run.status_file, RunStatus("running", "train", 1, 30, "", now, now, "", mark))
    editor = Opened(runs_dir, run).editor
    press(editor.delete)
    assert "cannot be deleted; expected a run that does not work; found one that is running" in editor.problem
    assert run.path.is_dir()


def test_another_run_can_be_brought_back_from_the_bin(pair: list[RunFolder], runs_dir: Path) -> None:
    opened = Opened(runs_dir, *pair)
    editor = opened.editor
    press(editor.delete)
    editor.run.value = pair[0].id
    press(editor.delete)
    assert editor.bin.options == sorted(run.id for run in pair)
    editor.bin.value = pair[1].id
    press(editor.restore)
    assert deleted_runs(runs_dir) == [pair[0].id]
    assert f"Brought back {pair[1].id}." in opened.said()


def test_the_bin_is_emptied_only_when_asked_twice(pair: list[RunFolder], runs_dir: Path) -> None:
    opened = Opened(runs_dir, *pair)
    editor = opened.editor
    press(editor.delete)
    press(editor.empty)
    assert "Remove 1 run for good? Nothing brings them back." in opened.said()
    assert editor.really.visible
    assert not editor.empty.visible
    press(editor.keep)
    assert deleted_runs(runs_dir) == [pair[1].id]
    assert not editor.really.visible
    press(editor.empty)
    press(editor.really)
    assert deleted_runs(runs_dir) == []
    assert "Removed 1 run for good." in opened.said()
    assert not editor.undo.visible


def test_a_run_that_another_page_deleted_is_told(pair: list[RunFolder], runs_dir: Path) -> None:
    opened = Opened(runs_dir, *pair)
    press(Opened(runs_dir, *pair).editor.delete)
    press(opened.editor.save)
    assert f"Run {pair[1].id} is not there any more" in opened.editor.problem
    press(opened.editor.delete)
    assert "is not there any more" in opened.editor.problem
    assert not pair[1].path.exists()


def test_other_parts_of_the_page_are_opened_for_the_run(pair: list[RunFolder], runs_dir: Path) -> None:
    opened = Opened(runs_dir, *pair)
    buttons = {button.label: button for button in opened.editor.__panel__().select(pn.widgets.Button)}
    press(buttons["Watch"])
    press(buttons["View"])
    assert opened.asked == [("watch", pair[1].id), ("view", pair[1].id)]
    alone = RunEditor(runs_dir, lambda: None)
    assert {"Watch", "View"}.isdisjoint(button.label for button in alone.__panel__().select(pn.widgets.Button))


def test_names_are_escaped(pair: list[RunFolder], runs_dir: Path, odd_name: str) -> None:
    opened = Opened(runs_dir, pair[0])
    press(opened.editor.delete)
    assert odd_name not in opened.said()
    assert "&lt;script&gt;" in opened.said()
