"""status.json: written whole, read with suspicion."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from toolkit.errors import DataError
from toolkit.runs.process import ProcessMark
from toolkit.runs.status import SILENCE, RunStatus, read_status, utc_now, write_status


def running(**changes: object) -> RunStatus:
    now = utc_now()
    status = RunStatus("running", "train", 3, 10, "hm", now, now, process=ProcessMark.current())
    return replace(status, **changes)


def ago(seconds: float) -> str:
    return (datetime.now(UTC) - timedelta(seconds=seconds)).isoformat()


def test_what_is_written_is_read(tmp_path: Path) -> None:
    for status in (RunStatus("queued"), running(), running(state="failed", error="why", total=None)):
        write_status(tmp_path / "status.json", status)
        assert read_status(tmp_path / "status.json") == status


def test_a_running_run_whose_process_lives_is_running_however_old_its_heartbeat() -> None:
    assert running(heartbeat=ago(10 * SILENCE)).judged().state == "running"


def test_a_running_run_whose_process_died_is_interrupted() -> None:
    gone = replace(ProcessMark.current(), boot="before the restart")
    judged = running(process=gone).judged()
    assert judged.state == "interrupted"
    assert judged.error == f"The run was interrupted: process {gone.pid} is gone."


def test_a_process_elsewhere_counts_as_dead_after_a_long_silence() -> None:
    elsewhere = replace(ProcessMark.current(), host="elsewhere")
    assert running(process=elsewhere).judged().state == "running"
    judged = running(process=elsewhere, heartbeat=ago(SILENCE + 5)).judged()
    assert judged.state == "interrupted"
    assert f"no sign of process {elsewhere.pid} for 125 s" in judged.error


def test_a_running_run_without_process_or_heartbeat_is_interrupted() -> None:
    assert running(process=None, heartbeat="").judged().state == "interrupted"


@pytest.mark.parametrize("state", ["queued", "finished", "failed", "cancelled"])
def test_other_states_stay_what_they_are(state: str) -> None:
    assert running(state=state, process=None).judged().state == state


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"state": "dancing"}, "found dancing"),
        ({"state": ["a", "list"]}, "found ['a', 'list']"),
        ({"done": "many"}, "ValueError"),
        ({"process": {"pid": 1}}, "KeyError('host')"),
        ({"heartbeat": "yesterday"}, "ValueError"),
        ({"heartbeat": "2026-01-01T00:00:00"}, "TypeError"),
    ],
)
def test_a_damaged_status_says_what_is_wrong(tmp_path: Path, change: dict[str, object], found: str) -> None:
    path = tmp_path / "status.json"
    path.write_text(json.dumps({**running().to_dict(), **change}))
    with pytest.raises(DataError, match="is no status of a run") as caught:
        read_status(path)
    assert found in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"state": "queued"}', "\x00" * 100])
def test_broken_files_are_told_as_such(tmp_path: Path, text: str) -> None:
    path = tmp_path / "status.json"
    path.write_text(text)
    with pytest.raises(DataError, match=r"status\.json"):
        read_status(path)
