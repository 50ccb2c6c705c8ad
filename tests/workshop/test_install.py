"""A bundle of one tiny wheel, installed by the code of the real one, and everything that may be wrong with it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tiny_wheels import write_wheel

from scripts.workshop import bundle as parts
from scripts.workshop.bundle import LAPTOP, Bundle
from scripts.workshop.laptop.kit import here, installing, manifest, starting
from scripts.workshop.laptop.kit.here import Refused, this_key, venv_python
from scripts.workshop.laptop.kit.installing import install, main
from scripts.workshop.laptop.kit.manifest import NAME, read_manifest
from scripts.workshop.targets import Target, targets_of
from scripts.workshop.wheels import Wanted, collect
from toolkit.cli import build_parser

#: What the tiny wheel's module does when it is run: it prints what it is given.
ECHO = "import sys\nprint('echo', *sys.argv[1:])\n"


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    """Return a bundle for this machine: a wheel called jupyterlab, a notebook, a run."""
    made = Bundle(tmp_path / "bundle")
    parts.begin(made)
    wheels = made.folder / "wheels"
    write_wheel(wheels, "jupyterlab", requires=["base"], source=ECHO, python=">=3.11.1")
    write_wheel(wheels, "base")
    write_wheel(wheels, "left-over")
    (target,) = targets_of(["this"], ["this"])
    chosen = {target: collect(wheels, target, Wanted(("jupyterlab",)), no_fetch)}
    parts.write_requirements(made, chosen)
    parts.copy_texts(made)
    run = made.folder / "runs" / "workshop" / "one"
    run.mkdir(parents=True)
    (run / "run.json").write_text(json.dumps({"data": "runs/tour/town"}), encoding="utf-8")
    for name in ("tour/town/images/1.jpg", "tour/town/scene.json", "blades/engine/images/1.jpg"):
        path = made.folder / "runs" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name, encoding="utf-8")
    parts.write_manifest(made, chosen)
    return made.folder


def no_fetch(requirements: list[str], target: Target) -> None:
    raise AssertionError(f"{requirements} are not there")


def edit_manifest(bundle: Path, **changes: Any) -> None:
    path = bundle / NAME
    path.write_text(json.dumps({**json.loads(path.read_text(encoding="utf-8")), **changes}), encoding="utf-8")


def refusal(bundle: Path, folder: Path | None = None) -> str:
    with pytest.raises(Refused) as caught:
        install(bundle, folder or bundle)
    return str(caught.value)


def test_the_bundle_has_what_is_needed_and_nothing_else(bundle: Path) -> None:
    names = sorted(path.name for path in (bundle / "wheels").iterdir())
    assert names == ["base-1.0-py3-none-any.whl", "jupyterlab-1.0-py3-none-any.whl"]
    told = read_manifest(bundle)
    assert told.least_python == {
        this_key(): f"{sys.version_info[0]}.{sys.version_info[1]}.{1 if sys.version_info[:2] == (3, 11) else 0}"
    }
    assert {"install.py", "start.py", "START-HERE.md", "kit/installing.py", "notebooks/00_tour.ipynb"} <= set(
        told.files
    )
    assert not [name for name in told.files if "solutions" in name]
    teacher = {path.name for path in (bundle.parent / "bundle-teacher").iterdir()}
    assert teacher == {"solutions", "instructor.md"}


@pytest.mark.slow
def test_it_is_installed_elsewhere_started_and_not_installed_twice(
    bundle: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "my workshop"
    command = [sys.executable, str(bundle / "install.py"), "--to", str(folder)]
    # An index that pip is told of elsewhere is not asked.
    environment = {"PIP_INDEX_URL": "https://nowhere.invalid/simple", "PIP_NO_INDEX": "0"}
    answer = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stderr
    assert "start.py check" in answer.stdout
    assert not (folder / "wheels").exists()
    assert json.loads((folder / "runs/workshop/one/run.json").read_text())["data"] == str(folder / "runs/tour/town")
    # What it starts is the virtual environment's own.
    assert starting.main(["lab", "--no-browser"], folder) == 0
    said = capfd.readouterr().out.split()
    assert said[0] == "echo"
    assert said[-2:] == ["notebooks/00_tour.ipynb", "--no-browser"]
    # Notebooks that were worked on are no damage, and stay.
    (folder / "notebooks" / "00_tour.ipynb").write_text("mine", encoding="utf-8")
    install(bundle, folder)
    assert "is installed in" in capfd.readouterr().out
    install(bundle, folder, again=True)
    assert "files were there already and are as they were" in capfd.readouterr().out
    assert (folder / "notebooks" / "00_tour.ipynb").read_text(encoding="utf-8") == "mine"


def test_missing_truncated_and_changed_files_are_named(bundle: Path) -> None:
    (wheel,) = bundle.glob("wheels/jupyterlab*")
    whole = wheel.read_bytes()
    wheel.write_bytes(whole[:-9])
    said = refusal(bundle)
    assert f"wheels/{wheel.name}: {len(whole) - 9} bytes in the place of {len(whole)}" in said
    assert "Copy the bundle again" in said
    wheel.write_bytes(whole[:-1] + b"x")
    assert f"wheels/{wheel.name}: its content is another than when the bundle was made" in refusal(bundle)
    wheel.unlink()
    assert f"wheels/{wheel.name}: missing" in refusal(bundle)
    assert not (bundle / ".venv").exists()


def test_of_many_damaged_files_the_first_are_named(bundle: Path) -> None:
    shutil.rmtree(bundle / "kit")
    count = len([name for name in read_manifest(bundle).files if name.startswith("kit/")])
    assert f"and {count - 5} more" in refusal(bundle)


@pytest.mark.slow
def test_a_manifest_that_lies_does_not_get_another_wheel_installed(
    bundle: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (wheel,) = bundle.glob("wheels/jupyterlab*")
    write_wheel(bundle / "wheels", "jupyterlab", source="import os  # something else\n")
    entries = manifest.entries_of(bundle, [wheel])
    files = {**read_manifest(bundle).to_dict()["files"]}
    files |= {name: {"size": entry.size, "sha256": entry.sha256} for name, entry in entries.items()}
    edit_manifest(bundle, files=files)
    # The list of what is installed has hashes of its own, which pip judges by.
    assert "pip could not install the wheels" in refusal(bundle)
    assert "DO NOT MATCH THE HASHES" in capfd.readouterr().err
    assert not (bundle / ".venv" / installing.MARK).exists()


@pytest.mark.parametrize(
    "name", ["../outside", "/etc/passwd", "C:/Windows/x", "a\\..\\b", "a//b", "./a", "", "a/../../b"]
)
def test_a_manifest_that_leads_out_of_the_bundle_is_refused(bundle: Path, name: str) -> None:
    edit_manifest(bundle, files={name: {"size": 0, "sha256": "0"}})
    assert f"names {name!r}, which does not lie in the bundle: do not use this bundle" in refusal(bundle)


def test_a_manifest_that_is_none_is_told(bundle: Path) -> None:
    edit_manifest(bundle, files={"a": {"size": "much"}})
    assert "is damaged: " in refusal(bundle)
    edit_manifest(bundle, format=7)
    assert "is not of format 1, which this installer reads" in refusal(bundle)
    (bundle / NAME).write_text("{", encoding="utf-8")
    assert "cannot be read" in refusal(bundle)
    (bundle / NAME).unlink()
    assert "is missing: this is no whole bundle" in refusal(bundle)


def test_other_pythons_and_systems_are_told_what_the_bundle_is_for(
    bundle: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(installing, "this_key", lambda: "windows-x86_64-cp314")
    said = refusal(bundle)
    assert f"no wheels for this Python, windows-x86_64-cp314; it has them for: {this_key()}." in said


def test_an_early_release_of_the_right_python_is_refused(bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    edit_manifest(bundle, least_python={this_key(): "3.99.7"})
    assert "Python 3.99.7 or a later release of it is needed, this is" in refusal(bundle)


def test_an_early_system_is_refused_before_anything_is_made(bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    edit_manifest(bundle, least_system={this_key(): "2.35"})
    monkeypatch.setattr(installing, "system_version", lambda: "2.9")
    monkeypatch.setattr(installing.sys, "platform", "linux")
    assert "A Linux with glibc 2.35 or newer is needed, this is 2.9." in refusal(bundle)
    monkeypatch.setattr(installing.sys, "platform", "darwin")
    assert "macOS 2.35 or newer is needed, this is 2.9." in refusal(bundle)
    assert not (bundle / ".venv").exists()


def test_versions_are_compared_as_numbers_and_unknown_ones_pass() -> None:
    assert here.older("2.9", "2.35")
    assert not here.older("2.35", "2.35")
    assert not here.older("14.2.1", "14.0")
    assert not here.older("", "2.35")
    assert not here.older("2.9", "")


def test_a_full_disk_is_told_before_anything_is_made(
    bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    edit_manifest(bundle, unpacked={this_key(): 3_000_000_000})
    monkeypatch.setattr(installing.shutil, "disk_usage", lambda _: SimpleNamespace(free=1_000_000_000))
    assert "has 1.0 GB free, 3.0 GB are needed" in refusal(bundle, tmp_path / "elsewhere")
    assert not (tmp_path / "elsewhere").exists()


def test_long_paths_are_refused_on_windows_alone(bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = read_manifest(bundle)
    room = installing._check_room
    deep = bundle.parent / ("deep" * 50)
    room(told, this_key(), bundle, deep)
    monkeypatch.setattr(installing, "on_windows", lambda: True)
    with pytest.raises(Refused, match=r"would have up to \d+ characters, of which Windows takes 259.*C:\\workshop"):
        room(told, this_key(), bundle, deep)


def test_on_windows_the_environment_keeps_its_python_elsewhere(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(here, "on_windows", lambda: True)
    assert venv_python(tmp_path) == tmp_path / ".venv" / "Scripts" / "python.exe"
    monkeypatch.setattr(installing, "on_windows", lambda: True)
    assert "py start.py lab" in installing.next_steps(tmp_path)


def test_missing_libraries_of_the_system_are_named(monkeypatch: pytest.MonkeyPatch, bundle: Path) -> None:
    monkeypatch.setattr(installing, "LIBRARIES", "libnowhere.so.7")
    monkeypatch.setattr(installing.sys, "platform", "linux")
    assert "Libraries of the system are missing: libnowhere.so.7. With the network, on Debian" in refusal(bundle)
    # On Windows it is Microsoft's runtime, which this machine has not.
    monkeypatch.setattr(installing, "on_windows", lambda: True)
    edit_manifest(bundle, longest_path={this_key(): 0})
    said = refusal(bundle)
    assert f"are missing: {installing.RUNTIME}. Install Microsoft's Visual C++ Redistributable" in said


def test_a_python_that_makes_no_environments_is_told(bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installing.subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=1))
    assert "Python could not make a virtual environment" in refusal(bundle)


def test_a_folder_that_cannot_be_written_is_told(bundle: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    assert "cannot be written" in refusal(bundle, tmp_path / "file" / "in it")


def test_refusals_are_printed_with_exit_code_2(bundle: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (bundle / NAME).unlink()
    assert main([], bundle) == 2
    assert "Not installed." in capsys.readouterr().err


def test_nothing_is_started_before_the_install(bundle: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert starting.main(["check"], bundle) == 2
    assert "is not installed in" in capsys.readouterr().err


def test_lab_dashboard_and_check_are_called_with_what_came_with_the_bundle(bundle: Path) -> None:
    assert starting.arguments_of("check", bundle) == [str(bundle / "kit" / "smoke.py")]
    assert starting.arguments_of("lab", bundle)[:2] == ["-m", "jupyterlab"]
    called = starting.arguments_of("dashboard", bundle)
    # The command line takes it; what is uploaded goes into a folder of its own.
    given = build_parser().parse_args(called[2:])
    assert given.runs == Path("runs/workshop")
    assert given.data == [Path("data"), Path("runs/blades/engine"), Path("runs/tour/town")]


@pytest.mark.parametrize("name", ["install.py", "start.py"])
def test_an_old_python_reads_as_far_as_the_message(name: str) -> None:
    source = (LAPTOP / name).read_text(encoding="utf-8")
    before, _, _ = source.partition("from kit")
    # Nothing that Python 2 could not parse: no f-strings, no annotations.
    assert 'f"' not in before
    assert "->" not in source
    assert "sys.version_info < (3, 11)" in before


def test_what_runs_before_the_install_needs_the_standard_library_only() -> None:
    for path in (LAPTOP / "kit").glob("*.py"):
        if path.name == "smoke.py":
            continue  # run by the environment's own Python
        lines = [
            line for line in path.read_text(encoding="utf-8").splitlines() if line.startswith(("from", "import"))
        ]
        roots = {line.split()[1].partition(".")[0] for line in lines}
        assert roots <= {*sys.stdlib_module_names, ""}, path


def test_the_libraries_are_those_that_the_checkout_asks_for() -> None:
    script = (LAPTOP.parents[1] / "system-libraries.sh").read_text(encoding="utf-8")
    assert f'libraries="{installing.LIBRARIES}"' in script
    assert f'packages="{installing.PACKAGES}"' in script
