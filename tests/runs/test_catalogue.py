"""The index saves reading what did not change, and may be lost, damaged or locked at any time."""

from __future__ import annotations

import dataclasses
import os
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from fake_recipe import RECIPE, MakeRun
from filelock import FileLock

from toolkit.errors import RunError
from toolkit.runs import catalogue as module
from toolkit.runs.catalogue import Catalogue, shared_catalogue
from toolkit.runs.folder import RunFolder
from toolkit.runs.index import RunSummary, summarise
from toolkit.runs.launch import execute
from toolkit.runs.notes import RunNotes, write_notes
from toolkit.runs.process import ProcessMark
from toolkit.runs.status import RunStatus, utc_now, write_status


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the ids of runs whose folders were read since the test began."""
    asked: list[str] = []

    def remember(run: RunFolder) -> RunSummary:
        asked.append(run.id)
        return summarise(run)

    monkeypatch.setattr(module, "summarise", remember)
    return asked


@pytest.fixture
def three(finished: MakeRun) -> list[RunFolder]:
    runs = [finished(name=name) for name in ("a", "b", "c")]
    return sorted(runs, key=lambda run: run.id)  # within a second the ids' order is chance


def refreshed(runs_dir: Path) -> Catalogue:
    made = Catalogue(runs_dir)
    made.refresh()
    return made


def index_file(runs_dir: Path) -> Path:
    return runs_dir / ".index" / "runs.sqlite"


def test_a_folder_that_is_not_there_has_no_runs_and_stays_away(tmp_path: Path) -> None:
    assert refreshed(tmp_path / "runs").rows == {}
    assert not (tmp_path / "runs").exists()


def test_a_second_server_reads_the_index_and_no_folder(
    three: list[RunFolder], runs_dir: Path, read: list[str]
) -> None:
    write_notes(three[0], RunNotes(("good",), "the first"))
    first = refreshed(runs_dir)
    assert sorted(read) == [run.id for run in three]
    read.clear()
    second = refreshed(runs_dir)
    assert read == []
    assert second.rows == first.rows == {run.id: summarise(run) for run in three}
    assert second.rows[three[0].id].tags == ("good",)
    assert second.rows[three[0].id].settings["loop.rate"] == 0.5
    assert second.remark == ""


@pytest.mark.parametrize("change", ["notes", "status", "record", "result"])
def test_only_what_changed_is_read_again(
    three: list[RunFolder], runs_dir: Path, read: list[str], change: str
) -> None:
    made = refreshed(runs_dir)
    before = made.rows
    read.clear()
    assert not made.refresh()
    assert made.rows is before
    if change == "notes":
        write_notes(three[1], RunNotes(("new",)))
    else:
        getattr(three[1], f"{change}_file").write_text("{")
    for again in (made, Catalogue(runs_dir)):  # the other one has it from the index by then
        assert again.refresh()
        assert read == [three[1].id]
        row = again.rows[three[1].id]
        assert row.tags == ("new",) if change == "notes" else row.state == "damaged"


def test_new_and_removed_runs_are_followed_and_leave_the_index(
    three: list[RunFolder], runs_dir: Path, finished: MakeRun
) -> None:
    made = refreshed(runs_dir)
    shutil.rmtree(three[0].path)
    new = finished(name="new")
    assert made.refresh()
    assert set(made.rows) == {three[1].id, three[2].id, new.id}
    with sqlite3.connect(index_file(runs_dir)) as index:
        assert {row[0] for row in index.execute("SELECT id FROM runs")} == set(made.rows)
    index.close()


def test_a_run_at_work_is_asked_each_time_and_not_kept(queued: MakeRun, runs_dir: Path, read: list[str]) -> None:
    run = queued(name="at work")
    mark, now = ProcessMark.current(), utc_now()
    write_status(run.status_file, RunStatus("running", "train", 1, 30, "", now, now, "", mark))
    made = refreshed(runs_dir)
    assert made.rows[run.id].state == "running"
    # A killed worker writes nothing: same time, same size, and yet the state is another.
    gone = dataclasses.replace(mark, pid=mark.pid, started="1" * len(mark.started))
    before = run.status_file.stat()
    write_status(run.status_file, dataclasses.replace(run.status(), process=gone))
    os.utime(run.status_file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert made.refresh()
    assert made.rows[run.id].state == "interrupted"
    assert "is gone" in made.rows[run.id].error


def test_damaged_folders_are_rows_with_their_errors(three: list[RunFolder], runs_dir: Path) -> None:
    three[0].record_file.write_text("{")
    shutil.rmtree(three[1].path)
    three[1].path.mkdir()
    for _ in range(2):
        rows = refreshed(runs_dir).rows
        assert [rows[run.id].state for run in three] == ["damaged", "damaged", "finished"]
        assert all(rows[run.id].error for run in three[:2])


def test_damaged_notes_do_not_damage_a_run(three: list[RunFolder], runs_dir: Path) -> None:
    (three[0].path / "notes.json").write_text('{"tags": 1}')
    row = refreshed(runs_dir).rows[three[0].id]
    assert row.state == "finished"
    assert "holds no notes" in row.error


@pytest.mark.parametrize("damage", ["no database", "cut", "other layout", "no table", "other rows", "no json"])
def test_an_index_that_cannot_be_used_is_made_anew(three: list[RunFolder], runs_dir: Path, damage: str) -> None:
    wanted = refreshed(runs_dir).rows
    file = index_file(runs_dir)
    if damage == "no database":
        file.write_bytes(b"nothing of this kind" * 100)
    elif damage == "cut":
        file.write_bytes(file.read_bytes()[:5000])
    else:
        change = {
            "other layout": "PRAGMA user_version = 99",
            "no table": "DROP TABLE runs",
            "other rows": """UPDATE runs SET content = '{"state": 1}'""",
            "no json": "UPDATE runs SET stamp = '['",
        }[damage]
        with sqlite3.connect(file) as index:
            index.execute(change)
        index.close()
    made = refreshed(runs_dir)
    assert made.rows == wanted
    assert made.remark == ""
    again = Catalogue(runs_dir)
    again.refresh()
    assert again.rows == wanted
    with sqlite3.connect(file) as index:
        assert index.execute("SELECT count(*) FROM runs").fetchone() == (3,)
    index.close()


def test_where_nothing_can_be_written_rows_are_kept_in_memory(
    three: list[RunFolder], runs_dir: Path, read: list[str]
) -> None:
    (runs_dir / ".index").write_text("in the way")
    made = refreshed(runs_dir)
    assert list(made.rows) == [run.id for run in three]
    assert made.remark.startswith("The list of runs is kept in memory only: Something is in the way")
    read.clear()
    assert not made.refresh()
    assert read == []


def test_a_full_disk_is_told_and_the_rows_are_there(
    three: list[RunFolder], runs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Full(sqlite3.Connection):
        def commit(self) -> None:
            error = sqlite3.OperationalError("database or disk is full")
            error.sqlite_errorcode = sqlite3.SQLITE_FULL
            raise error

    connect = sqlite3.connect
    monkeypatch.setattr(module.sqlite3, "connect", lambda path, timeout: connect(path, timeout, factory=Full))
    made = refreshed(runs_dir)
    assert len(made.rows) == 3
    assert made.remark == "The list of runs is kept in memory only: database or disk is full."


def test_a_lock_that_another_server_keeps_is_not_waited_for_long(
    three: list[RunFolder], runs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_PATIENCE", 0.05)
    (runs_dir / ".index").mkdir()
    with FileLock(runs_dir / ".index" / "lock"):
        made = refreshed(runs_dir)
    assert len(made.rows) == 3
    assert "is in use" in made.remark
    write_notes(three[0], RunNotes(("x",)))
    assert made.refresh()
    assert made.remark == ""


def test_two_servers_at_once_keep_one_sound_index(three: list[RunFolder], runs_dir: Path) -> None:
    program = (
        "import sys; from pathlib import Path; from toolkit.runs.catalogue import Catalogue\n"
        "from toolkit.runs.notes import RunNotes, write_notes; from toolkit.runs.index import run_folders\n"
        "runs = Path(sys.argv[1]); made = Catalogue(runs)\n"
        "for i in range(10):\n"
        "    write_notes(run_folders(runs)[int(sys.argv[2])], RunNotes((f'{sys.argv[2]}-{i}',))); made.refresh()\n"
        "assert made.remark == '', made.remark\n"
    )
    servers = [subprocess.Popen([sys.executable, "-c", program, str(runs_dir), str(i)]) for i in range(2)]
    assert [server.wait(60) for server in servers] == [0, 0]
    rows = refreshed(runs_dir).rows
    assert [rows[run.id].tags for run in three] == [("0-9",), ("1-9",), ()]


def test_reading_stops_in_time_and_goes_on(three: list[RunFolder], runs_dir: Path) -> None:
    made = Catalogue(runs_dir)
    assert made.refresh(within=0.0, first=[three[0].id]) is True
    assert list(made.rows) == [three[0].id]
    assert made.unread == 2
    assert made.refresh()
    assert list(made.rows) == [run.id for run in three]
    assert made.unread == 0
    # What is older than its files is better than nothing.
    write_notes(three[2], RunNotes(("new",)))
    assert not made.refresh(within=0.0)
    assert made.rows[three[2].id].tags == ()
    assert made.unread == 1
    assert made.refresh()
    assert made.rows[three[2].id].tags == ("new",)


def test_the_pages_of_a_process_share_one(runs_dir: Path) -> None:
    assert shared_catalogue(runs_dir) is shared_catalogue(runs_dir)
    assert shared_catalogue(runs_dir) is not shared_catalogue(runs_dir / "other")


def test_a_folder_that_refuses_is_told(runs_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs_dir.mkdir()

    def refuse(path: Path) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("toolkit.runs.index.os.scandir", refuse)
    with pytest.raises(RunError, match="Not allowed while listing"):
        refreshed(runs_dir)


def test_a_queued_run_that_worked_is_read_again(queued: MakeRun, runs_dir: Path) -> None:
    run = queued()
    made = refreshed(runs_dir)
    assert made.rows[run.id].state == "queued"
    execute(run, recipe=RECIPE)
    assert made.refresh()
    assert made.rows[run.id].state == "finished"


def test_names_of_numbers_follow_the_rows(queued: MakeRun, finished: MakeRun, runs_dir: Path) -> None:
    queued()
    made = refreshed(runs_dir)
    assert "loop.rate" in made.numbers()
    assert "test.psnr" not in made.numbers()
    assert made.numbers() is made.numbers()
    finished()
    made.refresh()
    assert "test.psnr" in made.numbers()
