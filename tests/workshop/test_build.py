"""Building: what is refused before anything is made, and what the manifest says."""

from __future__ import annotations

import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest
from tiny_wheels import write_wheel

from scripts.workshop import __main__ as command
from scripts.workshop import bundle as parts
from scripts.workshop.bundle import Bundle
from scripts.workshop.laptop.kit.manifest import NAME, read_manifest
from scripts.workshop.targets import Target
from toolkit.errors import RunError, SettingsError, StageError

TARGET = Target("windows", (3, 11))


def test_a_folder_with_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("", encoding="utf-8")
    with pytest.raises(SettingsError, match="holds something else; expected a bundle, or a new folder"):
        parts.begin(Bundle(tmp_path))
    parts.begin(Bundle(tmp_path / "new"))
    parts.begin(Bundle(tmp_path / "new"))


def test_room_is_asked_for_beside_what_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bundle = Bundle(tmp_path / "bundle")
    parts.begin(bundle)
    (bundle.folder / "wheels" / "w").write_bytes(bytes(600))
    monkeypatch.setattr(parts.shutil, "disk_usage", lambda _: SimpleNamespace(free=500))
    parts.require_room(bundle, 1000)
    with pytest.raises(RunError, match=r"The disk of .* is too full for the bundle"):
        parts.require_room(bundle, 1200)


def test_the_oldest_release_of_python_that_all_wheels_take_is_found(tmp_path: Path) -> None:
    wheels = [write_wheel(tmp_path, "a", python=">=3.9"), write_wheel(tmp_path, "b", python=">=3.11.5,!=3.11.6")]
    assert parts.least_python(TARGET, wheels) == "3.11.5"
    wheels.append(write_wheel(tmp_path, "c", python=">=3.12"))
    with pytest.raises(StageError, match="No release of Python fits all wheels for windows-x86_64-cp311"):
        parts.least_python(TARGET, wheels)


def test_the_oldest_system_is_that_of_the_wheel_that_asks_for_most(tmp_path: Path) -> None:
    linux, macos = Target("linux", (3, 11)), Target("macos", (3, 11))
    pure = write_wheel(tmp_path, "pure")
    either = write_wheel(tmp_path, "either", tag="cp311-abi3-manylinux2014_x86_64.manylinux_2_28_x86_64")
    newer = write_wheel(tmp_path, "newer", tag="cp311-cp311-manylinux_2_9_x86_64")
    assert parts.least_system(linux, [pure, newer]) == "2.9"
    assert parts.least_system(linux, [pure, newer, either]) == "2.17"
    assert (
        parts.least_system(macos, [pure, write_wheel(tmp_path, "m", tag="cp311-cp311-macosx_12_0_arm64")]) == "12.0"
    )
    assert parts.least_system(TARGET, [pure, write_wheel(tmp_path, "w", tag="cp311-cp311-win_amd64")]) == ""


def test_the_longest_path_is_that_of_a_compiled_file(tmp_path: Path) -> None:
    wheel = write_wheel(tmp_path, "module" * 10)
    name = "module" * 10
    assert parts.longest_path([wheel]) == len(f"Lib\\site-packages\\__pycache__\\{name}.cpython-311.pyc")


def test_wheels_that_no_laptop_installs_go(tmp_path: Path) -> None:
    bundle = Bundle(tmp_path / "bundle")
    parts.begin(bundle)
    kept = write_wheel(bundle.folder / "wheels", "kept")
    write_wheel(bundle.folder / "wheels", "old")
    (bundle.folder / "requirements").mkdir()
    (bundle.folder / "requirements" / "linux-x86_64-cp311.txt").write_text("", encoding="utf-8")
    parts.write_requirements(bundle, {TARGET: {"kept": kept}})
    assert [path.name for path in (bundle.folder / "wheels").iterdir()] == [kept.name]
    (listed,) = (bundle.folder / "requirements").iterdir()
    assert listed.name == "windows-x86_64-cp311.txt"
    assert listed.read_text(encoding="utf-8").startswith("kept==1.0 --hash=sha256:")


def test_what_an_installation_left_is_neither_listed_nor_zipped(tmp_path: Path) -> None:
    bundle = Bundle(tmp_path / "bundle")
    parts.begin(bundle)
    wheel = write_wheel(bundle.folder / "wheels", "kept")
    for name in (".venv/bin/python", "kit/__pycache__/here.pyc"):
        (bundle.folder / name).parent.mkdir(parents=True)
        (bundle.folder / name).write_text("", encoding="utf-8")
    parts.write_manifest(bundle, {TARGET: {"kept": wheel}})
    assert list(read_manifest(bundle.folder).files) == [f"wheels/{wheel.name}"]
    with zipfile.ZipFile(parts.zip_bundle(bundle)) as archive:
        assert sorted(archive.namelist()) == [f"bundle/{NAME}", f"bundle/wheels/{wheel.name}"]
    assert parts.sizes(bundle) == {"wheels": wheel.stat().st_size}


@pytest.mark.slow
def test_the_toolkits_own_wheel_has_what_the_package_needs(tmp_path: Path) -> None:
    old = write_wheel(tmp_path, "sightline-toolkit", "0.0.1")
    wheel = parts.toolkit_wheel(tmp_path)
    assert not old.exists()
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert {"toolkit/py.typed", "toolkit/samples/registry.json", "toolkit/__main__.py"} <= set(names)
    assert not [name for name in names if "node_modules" in name or "__pycache__" in name]


def test_errors_end_the_command_with_their_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["--out", str(tmp_path / "b"), "--platforms", "amiga"]) == 2
    assert "error: Unknown platform 'amiga'" in capsys.readouterr().err
    assert not (tmp_path / "b").exists()
