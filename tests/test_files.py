"""Files: a reader sees the old content or the new, whatever happens in between."""

from __future__ import annotations

import errno
import math
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.errors import DataError, RunError
from toolkit.files import atomic_path, disk_errors, read_json, write_json, write_text


def _tmpfs(folder: Path, *options: str) -> Path:
    """Mount a small file system on a new folder, or skip saying why."""
    mount = shutil.which("mount")
    if mount is None or not hasattr(os, "geteuid") or os.geteuid() != 0:
        pytest.skip("a real full or read-only disk needs root and mount: it is a tmpfs mounted for the test")
    folder.mkdir()
    command = [mount, "-t", "tmpfs", "-o", ",".join(options), "tmpfs", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"this machine does not let root mount a tmpfs: {done.stderr.strip()}")
    return folder


@pytest.fixture
def full_disk(tmp_path: Path) -> Iterator[Path]:
    folder = _tmpfs(tmp_path / "small", "size=64k")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


@pytest.fixture
def read_only_disk(tmp_path: Path) -> Iterator[Path]:
    folder = _tmpfs(tmp_path / "fixed", "size=64k", "ro")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_new_content_takes_the_place_of_the_old_and_nothing_else_stays(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "er" / "a.txt"
    write_text(path, "old")
    write_text(path, "neu, größer\n")
    assert path.read_text(encoding="utf-8") == "neu, größer\n"
    assert list(path.parent.iterdir()) == [path]


def test_temporary_path_is_beside_the_file_and_keeps_its_ending(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    with atomic_path(path) as temporary:
        assert temporary.parent == path.parent
        assert temporary.suffix == ".ply"
        assert temporary.name.startswith(".")
        temporary.write_bytes(b"ply")
        assert not path.exists()
    assert path.read_bytes() == b"ply"


@pytest.mark.parametrize("error", [RuntimeError("no"), KeyboardInterrupt(), OSError(errno.EIO, "broken")])
def test_failure_keeps_the_old_content_and_removes_the_new(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def fail() -> None:
        with atomic_path(path) as temporary:
            temporary.write_text("half of the n")
            raise error

    with pytest.raises(type(error)) as caught:
        fail()
    assert caught.value is error
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_readers_never_see_half_a_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")
    with path.open() as reader:
        write_text(path, "new and longer")
        assert reader.read() == "old"
    assert path.read_text() == "new and longer"


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_full_disk_is_told_and_the_old_content_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def full(self: Path, *args: Any, **kwargs: Any) -> int:
        self.touch()
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(RunError) as caught:
        write_text(path, "new")
    message = str(caught.value)
    assert message.startswith(f"The disk is full while writing {path}; found ")
    assert "MiB free. Free some space, or choose another folder, and resume." in message
    monkeypatch.undo()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_disk_that_is_full_before_the_folder_exists_is_told_too(tmp_path: Path) -> None:
    with (
        pytest.raises(RunError, match="The disk is full while preparing"),
        disk_errors(tmp_path / "a" / "b", "preparing"),
    ):
        raise OSError(errno.ENOSPC, "full")


def test_real_full_disk_keeps_the_old_content(full_disk: Path) -> None:
    path = full_disk / "a.txt"
    write_text(path, "old")
    with pytest.raises(RunError, match=r"The disk is full while writing .*; found 0\.0 MiB free"):
        write_text(path, "x" * 100_000)
    assert path.read_text() == "old"
    assert list(full_disk.iterdir()) == [path]
    write_text(path, "new")
    assert path.read_text() == "new"


def test_read_only_disk_is_told(read_only_disk: Path) -> None:
    with pytest.raises(RunError, match="Not allowed while writing .* Choose a folder you may write to"):
        write_text(read_only_disk / "a.txt", "new")
    with pytest.raises(RunError, match="Not allowed while writing .* Choose a folder you may write to"):
        write_text(read_only_disk / "folder" / "a.txt", "new")


def test_folder_without_permission_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Path, *args: Any, **kwargs: Any) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(RunError, match="Not allowed while writing .* Choose a folder you may write to"):
        write_text(tmp_path / "sub" / "a.txt", "new")


def test_file_in_the_place_of_a_folder_is_told(tmp_path: Path) -> None:
    write_text(tmp_path / "a", "file")
    for path in (tmp_path / "a" / "b.txt", tmp_path / "a" / "b" / "c.txt"):
        with pytest.raises(
            RunError, match="Something is in the way while writing .* Choose another folder, or move"
        ):
            write_text(path, "new")
    assert (tmp_path / "a").read_text() == "file"


def test_folder_in_the_place_of_a_file_is_told(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    with pytest.raises(RunError, match="Something is in the way while writing"):
        write_text(tmp_path / "a", "new")
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


def test_other_refusals_of_the_system_pass_as_they_are(tmp_path: Path) -> None:
    error = OSError(errno.EIO, "broken")
    with pytest.raises(OSError, match="broken") as caught, disk_errors(tmp_path, "writing"):
        raise error
    assert caught.value is error


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=10,
)


@given(value=json_values)
def test_json_round_trip(tmp_path_factory: pytest.TempPathFactory, value: Any) -> None:
    path = tmp_path_factory.mktemp("json") / "a.json"
    # Lone surrogates are no text that UTF-8 can hold; JSON escapes them.
    write_json(path, value)
    assert read_json(path) == value


@pytest.mark.parametrize("value", [math.nan, math.inf, {"a": [-math.inf]}])
def test_json_refuses_what_no_other_reader_takes(tmp_path: Path, value: Any) -> None:
    path = tmp_path / "a.json"
    write_json(path, 1)
    with pytest.raises(ValueError, match="Out of range float values are not JSON compliant"):
        write_json(path, value)
    assert read_json(path) == 1


def test_missing_json_is_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"a\.json is missing; expected a JSON file"):
        read_json(tmp_path / "a.json")


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[" * 100_000])
def test_damaged_json_is_told(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"Cannot read .*a\.json; expected a JSON file; found "):
        read_json(path)


def test_folder_in_the_place_of_json_is_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="Cannot read .*; expected a JSON file"):
        read_json(tmp_path)
