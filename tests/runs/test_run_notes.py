"""Tags and notes lie in a run's folder, within limits, and are replaced whole or not at all."""

from __future__ import annotations

import errno
import json
import shutil
from pathlib import Path

import pytest
from fake_recipe import MakeRun
from hypothesis import given
from hypothesis import strategies as st

from toolkit.errors import DataError, RunError
from toolkit.runs.notes import LONGEST_TEXT, RunNotes, known_tags, read_notes, split_tags, write_notes


def test_what_is_written_is_read(queued: MakeRun) -> None:
    run = queued()
    assert read_notes(run) == RunNotes()
    notes = RunNotes(("baseline", "Größe 2"), "one line\nand <b>another</b>")
    write_notes(run, notes)
    assert read_notes(run) == notes
    assert json.loads((run.path / "notes.json").read_text(encoding="utf-8"))["tags"] == ["baseline", "Größe 2"]


@given(st.text(max_size=80))
def test_whatever_is_typed_becomes_tags_that_can_be_used_or_is_refused(text: str) -> None:
    tags = split_tags(text)
    assert len(set(tags)) == len(tags)
    usable = all(len(tag) <= 30 and tag.isprintable() for tag in tags) and len(tags) <= 20
    if usable:
        assert RunNotes(tags).tags == tags
    else:
        with pytest.raises(RunError, match="cannot be used"):
            RunNotes(tags)


def test_tags_are_split_at_commas() -> None:
    assert split_tags(" good ,, bad  one,good,") == ("good", "bad one")


@pytest.mark.parametrize(
    ("tags", "text", "message"),
    [
        (("",), "", "Tag '' cannot be used; expected 1 to 30 characters without commas; found an empty one"),
        (("x" * 31,), "", "found 31 characters"),
        (("a,b",), "", "found a comma or control characters"),
        (("a\nb",), "", "found a comma or control characters"),
        ((" a",), "", "spaces at an end"),
        (tuple(map(str, range(21))), "", "Tags cannot be used; expected at most 20 different ones; found 21"),
        (("a", "a"), "", "at most 20 different ones"),
        ((), "x" * (LONGEST_TEXT + 1), "The note is too long; expected at most 4000 characters; found 4001"),
    ],
)
def test_what_is_too_much_is_refused(tags: tuple[str, ...], text: str, message: str) -> None:
    with pytest.raises(RunError, match=message):
        RunNotes(tags, text)


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"tags": "a", "text": ""}', '{"tags": [1], "text": ""}', '{"tags": []}']
)
def test_damaged_notes_are_told(queued: MakeRun, text: str) -> None:
    run = queued()
    (run.path / "notes.json").write_text(text)
    with pytest.raises(DataError, match=r"notes\.json"):
        read_notes(run)


def test_notes_beyond_the_limits_are_told(queued: MakeRun) -> None:
    run = queued()
    (run.path / "notes.json").write_text(json.dumps({"tags": ["x" * 99], "text": ""}))
    with pytest.raises(DataError, match="holds notes that cannot be used"):
        read_notes(run)


def test_a_deleted_run_does_not_come_back(queued: MakeRun) -> None:
    run = queued()
    shutil.rmtree(run.path)
    with pytest.raises(RunError, match=f"Run {run.id} is not there any more"):
        write_notes(run, RunNotes(("a",)))
    assert not run.path.exists()


def test_a_full_disk_is_told_and_the_old_notes_stay(queued: MakeRun, monkeypatch: pytest.MonkeyPatch) -> None:
    run = queued()
    write_notes(run, RunNotes(("old",)))

    def full(self: Path, *args: object, **options: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_text", full)
        with pytest.raises(RunError, match="The disk is full while writing .*Free some space"):
            write_notes(run, RunNotes(("new",)))
    assert read_notes(run).tags == ("old",)
    assert [path.name for path in run.path.iterdir() if "tmp" in path.name] == []


def test_tags_in_use_are_listed_once() -> None:
    assert known_tags([("b", "A"), (), ("b",)]) == ["A", "b"]
