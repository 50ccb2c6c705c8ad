"""The run folder: one process holds it, and what is damaged in it is told and never believed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from fake_recipe import MakeRun

from toolkit.errors import DataError, RunError
from toolkit.files import read_json
from toolkit.runs.folder import RunFolder, make_folder, open_run
from toolkit.runs.record import SCHEMA, RunRecord


def change(path: Path, **values: Any) -> None:
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, **values}))


def test_a_new_run_is_whole_and_queued(queued: MakeRun, runs_dir: Path) -> None:
    run = queued(name="first")
    assert {path.name for path in run.path.iterdir()} == {
        "run.json",
        "status.json",
        "log.txt",
        "checkpoint",
        "artifacts",
    }
    assert [path for path in runs_dir.iterdir() if path.name.startswith(".")] == []
    assert run.status().state == "queued"
    assert run.id == run.path.name


def test_run_json_says_what_the_run_is_made_from(queued: MakeRun, photos: Path) -> None:
    record = queued(name="first", seed=7, loop__steps=12).record()
    assert (record.recipe, record.name, record.seed, record.device) == ("fake", "first", 7, "cpu")
    assert record.settings == {
        "loop": {"steps": 12, "rate": 0.5},
        "pause": 0.0,
        "fail_at": 0,
        "test_every": 2,
    }
    assert record.data == str(photos)
    assert len(record.data_fingerprint) >= 16
    assert record.created.endswith("+00:00")
    assert set(record.machine["libraries"]) >= {"numpy", "torch", "pycolmap", "numba"}
    assert record.machine["cores"] >= 1
    assert record.threads["torch"] >= 1
    assert record.threads["numba"] >= 1
    assert len(record.code["sources"]) == 16


def test_two_runs_never_share_a_folder(queued: MakeRun, runs_dir: Path) -> None:
    run = queued()
    with pytest.raises(RunError, match="is there already; Start|is there already. Start the run again"):
        make_folder(runs_dir, run.id, run.record())
    assert list(runs_dir.glob(".*")) == []


@pytest.mark.parametrize("name", ["../out", "a/b", "run", ".hidden"])
def test_only_ids_become_folders(queued: MakeRun, runs_dir: Path, name: str) -> None:
    with pytest.raises(RunError, match="is no run id; expected <yyyymmdd-hhmmss>"):
        make_folder(runs_dir, name, queued().record())


def test_a_folder_without_run_json_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"is no run; expected a folder with run\.json"):
        open_run(tmp_path)


def test_a_second_process_is_told_who_holds_the_folder(queued: MakeRun) -> None:
    run = queued()
    code = (
        "import sys; from pathlib import Path; from toolkit.runs.folder import RunFolder\n"
        "from toolkit.runs.journal import journal\n"
        "run = RunFolder(Path(sys.argv[1]))\n"
        "with run.held(), journal(run): print('held', flush=True); input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(run.path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as child:
        assert child.stdout is not None
        assert child.stdout.readline().strip() == b"held"
        with (
            pytest.raises(RunError, match=f"Run {run.id} is in use; found process {child.pid} on ") as caught,
            run.held(),
        ):
            pass
        assert "Wait until it ends, or stop that process and resume the run." in str(caught.value)
        child.communicate(b"\n")
    with run.held():
        pass


def test_a_holder_that_has_not_said_who_it_is(queued: MakeRun) -> None:
    run = queued()
    with run.held():
        with pytest.raises(RunError, match="a process that has not written its status yet"), run.held():
            pass
        run.status_file.unlink()
        with pytest.raises(RunError, match="a process that did not leave its number"), run.held():
            pass


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"schema": SCHEMA + 1}, f"cannot read; expected schema {SCHEMA}; found {SCHEMA + 1}"),
        ({"schema": None}, f"cannot read; expected schema {SCHEMA}; found None"),
        ({"seed": "one"}, "expected 'seed' as int; found 'one'"),
        ({"settings": []}, "expected 'settings' as dict; found []"),
        ({"recipe": None}, "expected 'recipe' as str; found None"),
    ],
)
def test_a_damaged_record_names_the_field(queued: MakeRun, changes: dict[str, Any], told: str) -> None:
    run = queued()
    change(run.record_file, **changes)
    with pytest.raises(DataError) as caught:
        run.record()
    assert told in str(caught.value)
    assert "run.json" in str(caught.value)


@pytest.mark.parametrize("text", ["", "[1]", "{", "\x00\x00"])
def test_a_record_that_is_no_record(queued: MakeRun, text: str) -> None:
    run = queued()
    run.record_file.write_text(text)
    with pytest.raises(DataError, match=r"run\.json"):
        run.record()


def test_a_record_comes_back_as_it_was(queued: MakeRun) -> None:
    run = queued(name="größe")
    record = run.record()
    assert RunRecord.from_dict(record.to_dict(), run.record_file) == record


def test_no_result_before_the_end(queued: MakeRun) -> None:
    with pytest.raises(RunError, match="has no result; expected a finished run"):
        queued().result()


def test_a_result_comes_back(finished: MakeRun) -> None:
    run = finished()
    result = run.result()
    assert [time.name for time in result.times] == ["prepare", "train"]
    assert result.seconds == sum(time.seconds for time in result.times)
    assert result.metrics["test.lpips_vgg"] is None
    assert len(result.test_views) == 3
    assert result.reports["train"]["steps"] == 30


@pytest.mark.parametrize("text", ["{}", "[]", '{"metrics": {"a": "b"}}', '{"metrics": [], "times": 1}'])
def test_a_damaged_result_is_told(finished: MakeRun, text: str) -> None:
    run = finished()
    run.result_file.write_text(text)
    with pytest.raises(DataError, match=r"result\.json is damaged; expected metrics, times, reports"):
        run.result()


@pytest.mark.parametrize("picture", ["/etc/hostname", "../../run.json", "test/../../status.json"])
def test_pictures_outside_the_run_are_refused(finished: MakeRun, picture: str) -> None:
    run = finished()
    content = read_json(run.result_file)
    content["test_views"][0]["photo"] = picture
    run.result_file.write_text(json.dumps(content))
    with pytest.raises(DataError, match="names a picture outside the run; expected paths below artifacts"):
        run.result()


def test_a_link_that_leads_out_is_refused_too(finished: MakeRun, tmp_path: Path) -> None:
    run = finished()
    view = run.result().test_views[0]
    (tmp_path / "secret.png").write_bytes(b"secret")
    (run.artifacts / view.photo).unlink()
    (run.artifacts / view.photo).symlink_to(tmp_path / "secret.png")
    with pytest.raises(DataError, match="outside the run"):
        run.result()


def test_a_run_is_named_by_its_folder_wherever_that_lies(finished: MakeRun, tmp_path: Path) -> None:
    run = finished()
    moved = run.path.rename(tmp_path / "elsewhere")
    assert open_run(moved) == RunFolder(moved)
    assert open_run(moved).result().metrics
