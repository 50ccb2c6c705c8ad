"""What Windows does otherwise, simulated: renames refused for a moment, links refused for good."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from fake_recipe import RECIPE, FakeSettings, write_photos

from toolkit import files
from toolkit.cli import main
from toolkit.errors import RunError
from toolkit.files import atomic_folder, link_or_copy, stand_in, write_text
from toolkit.runs.detached import start_detached
from toolkit.runs.launch import create_run

ROOT = Path(__file__).parents[2]


def refuse(monkeypatch: pytest.MonkeyPatch, name: str, times: int) -> list[int]:
    """Refuse the first calls of a method of ``Path``, as Windows does while somebody reads the target."""
    plain, calls = getattr(Path, name), []

    def refusing(self: Path, target: Path) -> Path:
        calls.append(1)
        if len(calls) <= times:
            raise PermissionError(13, "Access is denied", str(target))
        return plain(self, target)

    monkeypatch.setattr(Path, name, refusing)
    return calls


def test_a_file_that_is_being_read_is_replaced_a_moment_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "_PATIENCE", 5.0)
    write_text(tmp_path / "status.json", "old")
    calls = refuse(monkeypatch, "replace", 3)
    write_text(tmp_path / "status.json", "new")
    assert (tmp_path / "status.json").read_text(encoding="utf-8") == "new"
    assert len(calls) == 4


def test_a_folder_that_is_looked_through_is_put_in_place_a_moment_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "_PATIENCE", 5.0)
    refuse(monkeypatch, "rename", 2)
    with atomic_folder(tmp_path / "stage") as place:
        place.mkdir()
    assert [path.name for path in tmp_path.iterdir()] == ["stage"]


def test_patience_ends_and_is_none_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = refuse(monkeypatch, "replace", 10**6)
    monkeypatch.setattr(files, "_PATIENCE", 0.05)
    with pytest.raises(RunError, match="Not allowed while writing"):
        write_text(tmp_path / "a", "x")
    assert len(calls) > 1
    calls.clear()
    monkeypatch.setattr(files, "_PATIENCE", 0.0)
    with pytest.raises(RunError, match="Not allowed while writing"):
        write_text(tmp_path / "a", "x")
    assert len(calls) == 1
    assert list(tmp_path.iterdir()) == []


def no_links(*_: object, **__: object) -> None:
    raise OSError(1314, "A required privilege is not held by the client")


def test_where_links_are_refused_hard_links_stand_in_and_else_copies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "images"
    (source / "left").mkdir(parents=True)
    (source / "left" / "1.jpg").write_bytes(b"picture")
    stand_in(source, tmp_path / "linked")
    assert (tmp_path / "linked").is_symlink()
    monkeypatch.setattr(Path, "symlink_to", no_links)
    stand_in(source, tmp_path / "hard")
    stand_in(source / "left" / "1.jpg", tmp_path / "one.jpg")
    assert (tmp_path / "one.jpg").samefile(source / "left" / "1.jpg")
    assert (tmp_path / "hard" / "left" / "1.jpg").samefile(source / "left" / "1.jpg")
    monkeypatch.setattr(os, "link", no_links)
    stand_in(source, tmp_path / "copied")
    link_or_copy(source / "left" / "1.jpg", tmp_path / "two.jpg")
    for path in (tmp_path / "copied" / "left" / "1.jpg", tmp_path / "two.jpg"):
        assert path.read_bytes() == b"picture"
        assert not path.samefile(source / "left" / "1.jpg")


def test_a_detached_process_is_out_of_reach_of_the_servers_ctrl_c_and_writes_utf_8(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: dict[str, Any] = {}

    class Process:
        def __init__(self, command: list[str], **options: Any) -> None:
            started.update(options)

        def wait(self) -> int:
            return 0

    monkeypatch.setattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0x200, raising=False)
    monkeypatch.setattr(subprocess, "Popen", Process)
    start_detached(["runs"], tmp_path / "out.txt")
    assert started["creationflags"] == 0x200
    assert started["env"]["PYTHONUTF8"] == "1"


def test_arrows_become_question_marks_where_the_output_cannot_hold_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    create_run(RECIPE, write_photos(tmp_path / "photos"), FakeSettings(), tmp_path / "runs", name="PSNR ↑")
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="cp1252"))
    assert main(["runs", "--runs", str(tmp_path / "runs")]) == 0
    sys.stdout.flush()
    assert "PSNR ?" in written.getvalue().decode("cp1252")


#: What is not there, or means something else, on Windows.
POSIX_ONLY = re.compile(
    r"os\.(fork|killpg|getpgid|setsid|geteuid|getuid|uname|mkfifo|nice|chown|statvfs)\b|signal\.(SIGKILL|SIGHUP|SIGALRM|SIGUSR1)"
    r"|\b(import|from) (fcntl|pwd|grp|resource|termios|pty)\b|shell=True|[\"'](/tmp|/dev/|/bin/)|\.venv/bin|AF_UNIX"
)


@pytest.mark.parametrize("folder", ["toolkit", "dashboards", "scripts"])
def test_what_users_run_asks_for_nothing_that_only_posix_has(folder: str) -> None:
    for path in sorted((ROOT / folder).rglob("*.py")):
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            assert not POSIX_ONLY.search(line), f"{path}:{number}: {line.strip()}"


def test_files_have_names_that_windows_and_macos_take() -> None:
    answer = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if answer.returncode:
        pytest.skip("no git checkout")
    names = answer.stdout.splitlines()
    reserved = re.compile(r"(?i)(^|/)(con|prn|aux|nul|com\d|lpt\d)(\.|/|$)|[<>:\"|?*\\]|[ .](/|$)")
    assert [name for name in names if reserved.search(name)] == []
    # Two names that differ in case alone are one file there.
    assert len({name.casefold() for name in names}) == len(names)
