"""Workspace: an output is whole or absent, built once, and never taken for that of other settings."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import toolkit.files
import toolkit.scene
import toolkit.workspace
from toolkit.errors import DataError, RunError
from toolkit.workspace import Workspace, code_version, file_fingerprint, fingerprint

SPAWN = multiprocessing.get_context("spawn")


def _stage(workspace: Workspace, build: Callable[[Path], None], **changes: Any) -> toolkit.workspace.StageOutput:
    given_values: dict[str, Any] = {"inputs": ["a1"], "settings": {"ratio": 0.8}, "code": "v1", **changes}
    return workspace.stage(given_values.pop("name", "match"), build=build, **given_values)


def _write(folder: Path) -> None:
    (folder / "out.txt").write_text("whole")


def _must_not_build(folder: Path) -> None:
    pytest.fail("built again")


def _build_slowly_and_count(root: str, started: str) -> None:
    """Build an output that takes a moment; every build leaves a file of its own in ``started``."""

    def build(folder: Path) -> None:
        Path(started, f"{os.getpid()}-{threading.get_ident()}").touch()
        time.sleep(0.5)
        _write(folder)

    output = _stage(Workspace(Path(root)), build)
    assert (output.folder / "out.txt").read_text() == "whole"


def _build_for_ever(root: str, started: str) -> None:
    def build(folder: Path) -> None:
        (folder / "half.txt").write_text("ha")
        Path(started).touch()
        time.sleep(600)

    _stage(Workspace(Path(root)), build)


def test_output_is_built_once_and_found_after(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "work")
    first = _stage(workspace, _write)
    again = _stage(workspace, _must_not_build)
    assert (first.folder / "out.txt").read_text() == "whole"
    assert (first.reused, again.reused) == (False, True)
    assert (again.folder, again.key, again.seconds) == (first.folder, first.key, first.seconds)
    assert first.folder.name == f"match-{first.key}"
    assert 0 <= first.seconds < 60
    assert _stage(Workspace(tmp_path / "work"), _must_not_build).reused


@pytest.mark.parametrize(
    "change",
    [{"inputs": ["a2"]}, {"settings": {"ratio": 0.7}}, {"code": "v2"}, {"name": "verify"}],
    ids=lambda change: next(iter(change)),
)
def test_changed_input_settings_code_or_stage_builds_anew(tmp_path: Path, change: dict[str, Any]) -> None:
    workspace = Workspace(tmp_path)
    first = _stage(workspace, _write)
    other = _stage(workspace, _write, **change)
    assert not other.reused
    assert other.folder != first.folder
    assert _stage(workspace, _must_not_build).reused


@pytest.mark.parametrize("error", [RuntimeError("no"), KeyboardInterrupt()])
def test_failed_build_leaves_nothing_and_the_next_one_starts_clean(tmp_path: Path, error: BaseException) -> None:
    workspace = Workspace(tmp_path)

    def fail(folder: Path) -> None:
        (folder / "half.txt").write_text("ha")
        raise error

    with pytest.raises(type(error)):
        _stage(workspace, fail)
    assert [path for path in tmp_path.iterdir() if path.is_dir()] == []
    output = _stage(workspace, _write)
    assert not output.reused
    assert sorted(path.name for path in output.folder.iterdir()) == ["out.txt", "stage.json"]


def test_full_disk_is_told_and_leaves_nothing(tmp_path: Path) -> None:
    def full(folder: Path) -> None:
        raise OSError(28, os.strerror(28))

    with pytest.raises(RunError, match="The disk is full while writing stage output below .*Free some space"):
        _stage(Workspace(tmp_path), full)
    assert [path for path in tmp_path.iterdir() if path.is_dir()] == []


def test_file_in_the_place_of_the_workspace_is_told(tmp_path: Path) -> None:
    (tmp_path / "work").write_text("a file")
    with pytest.raises(RunError, match="Something is in the way while preparing .*work"):
        _stage(Workspace(tmp_path / "work"), _write)


def test_lock_that_cannot_be_made_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("filelock.FileLock.acquire", refuse)
    with pytest.raises(RunError, match="Not allowed while preparing .* Choose a folder you may write to"):
        _stage(Workspace(tmp_path), _write)


@pytest.mark.parametrize("record", [None, "[]", "{}", '{"seconds": "long"}'])
def test_foreign_folder_in_the_place_of_an_output_is_told_and_kept(tmp_path: Path, record: str | None) -> None:
    workspace = Workspace(tmp_path)
    folder = _stage(workspace, _write).folder
    (folder / "stage.json").unlink()
    if record is not None:
        (folder / "stage.json").write_text(record)
    with pytest.raises(
        RunError, match=r"is no stage output of ours; expected a stage\.json .* Move the folder away"
    ):
        _stage(workspace, _must_not_build)
    assert (folder / "out.txt").is_file()


def test_damaged_record_is_told(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    (_stage(workspace, _write).folder / "stage.json").write_text("{")
    with pytest.raises(DataError, match=r"Cannot read .*stage\.json"):
        _stage(workspace, _must_not_build)


def test_two_processes_that_want_the_same_output_build_it_once(tmp_path: Path) -> None:
    started = tmp_path / "started"
    started.mkdir()
    arguments = (str(tmp_path / "work"), str(started))
    processes = [SPAWN.Process(target=_build_slowly_and_count, args=arguments) for _ in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(60)
    assert [process.exitcode for process in processes] == [0, 0]
    assert len(list(started.iterdir())) == 1


def test_two_threads_that_want_the_same_output_build_it_once(tmp_path: Path) -> None:
    started = tmp_path / "started"
    started.mkdir()
    with ThreadPoolExecutor(2) as pool:
        jobs = [pool.submit(_build_slowly_and_count, str(tmp_path / "work"), str(started)) for _ in range(2)]
        for job in jobs:
            job.result(60)
    assert len(list(started.iterdir())) == 1


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL on this system")
def test_killed_process_leaves_only_leftovers_which_can_be_removed(tmp_path: Path) -> None:
    started = tmp_path / "started"
    workspace = Workspace(tmp_path / "work")
    process = SPAWN.Process(target=_build_for_ever, args=(str(workspace.root), str(started)))
    process.start()
    deadline = time.monotonic() + 60
    while not started.exists():
        assert time.monotonic() < deadline, "the process did not start building"
        time.sleep(0.02)
    process.kill()
    process.join(60)
    assert [path.suffix for path in workspace.root.iterdir() if path.is_dir()] == [".tmp"]
    # The lock died with the process, so the next one neither waits nor reads what was left.
    output = _stage(workspace, _write)
    assert not output.reused
    assert not (output.folder / "half.txt").exists()
    assert workspace.remove_leftovers() == 1
    assert [path for path in workspace.root.iterdir() if path.is_dir()] == [output.folder]
    assert workspace.remove_leftovers() == 0


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=8,
)


@given(st.dictionaries(st.text(), json_values, min_size=2, max_size=6))
def test_fingerprint_does_not_depend_on_the_order_of_keys(value: dict[str, Any]) -> None:
    assert fingerprint(value) == fingerprint(dict(reversed(value.items())))
    assert fingerprint({**value, "one more": 1}) != fingerprint(value)


def test_fingerprint_is_the_sha_256_of_compact_json(tmp_path: Path) -> None:
    path = tmp_path / "value"
    path.write_bytes(b'{"a":[1,2.5],"b":null}')
    assert fingerprint({"b": None, "a": (1, 2.5)}) == file_fingerprint(path)
    # From `printf abc | sha256sum`.
    path.write_bytes(b"abc")
    assert file_fingerprint(path) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_fingerprint_refuses_what_json_cannot_hold() -> None:
    with pytest.raises(ValueError, match="Out of range float values"):
        fingerprint([float("nan")])
    with pytest.raises(TypeError, match="not JSON serializable"):
        fingerprint({"path": Path("a")})


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    folder = tmp_path / "sample_package_for_code_version"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "part.py").write_text("x = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    module = importlib.import_module(folder.name)
    yield module
    del sys.modules[folder.name]


def test_code_version_changes_with_the_source_of_a_package(package: ModuleType) -> None:
    assert package.__file__ is not None
    folder = Path(package.__file__).parent
    versions = [code_version(package)]
    (folder / "part.py").write_text("x = 2\n")
    versions.append(code_version(package))
    (folder / "new.py").write_text("")
    versions.append(code_version(package))
    (folder / "notes.txt").write_text("no source")
    assert code_version(package) == versions[-1]
    assert len(set(versions)) == 3
    (folder / "new.py").unlink()
    (folder / "part.py").write_text("x = 1\n")
    assert code_version(package) == versions[0]


def test_code_version_of_a_module_counts_its_own_file_only(package: ModuleType) -> None:
    part = importlib.import_module(f"{package.__name__}.part")
    assert part.__file__ is not None
    before = code_version(part)
    (Path(part.__file__).parent / "new.py").write_text("")
    assert code_version(part) == before
    Path(part.__file__).write_text("x = 3\n")
    assert code_version(part) != before


def test_code_version_counts_every_module_given() -> None:
    assert code_version(toolkit.files) != code_version(toolkit.files, toolkit.workspace)
    assert code_version(toolkit.scene) == code_version(toolkit.scene)


def test_code_version_needs_a_source() -> None:
    with pytest.raises(ValueError, match="sys has no source file"):
        code_version(sys)
