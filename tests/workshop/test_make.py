"""The targets for where there is no make: the same as the Makefile's, and quick the second time."""

from __future__ import annotations

import os
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from scripts import make
from scripts.make import ROOT, TASKS, main


@pytest.fixture
def ran(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Take note of what would be run, in a checkout without an environment."""
    commands: list[list[str]] = []

    def run(command: list[str], **_: object) -> SimpleNamespace:
        commands.append(command)
        if command[1:3] == ["-m", "venv"]:
            make.python().parent.mkdir(parents=True)
            make.python().touch()
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(make, "VENV", tmp_path / ".venv")
    monkeypatch.setattr(make.subprocess, "run", run)
    return commands


def test_an_environment_is_made_once_and_each_extra_installed_once(ran: list[list[str]]) -> None:
    assert main(["demo"]) == 0
    assert [command[1:3] for command in ran] == [["-m", "venv"], ["-m", "pip"], ["-m", "toolkit"]]
    assert ran[1][-4:] == ["--constraint", "constraints.txt", "--editable", "."]
    ran.clear()
    assert main(["demo"]) == 0
    assert len(ran) == 1
    assert main(["dashboard", "--port", "5007"]) == 0
    assert ran[1][-1] == ".[ui]"
    assert ran[2][-2:] == ["--port", "5007"]
    # A newer list of dependencies has them installed again.
    os.utime(make.VENV / ".ui", (0, 0))
    ran.clear()
    assert main(["lab"]) == 0
    assert len(ran) == 2


def test_where_the_installation_fails_nothing_is_run(ran: list[list[str]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(make.subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=7))
    assert main(["demo"]) == 7
    assert not (make.VENV / ".core").exists()


def test_each_task_is_a_target_that_does_the_same() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    values = {"DEMO": "runs/demo", "RUNS": "runs/demo/runs", "DATA": "runs/demo/data", "JOBS": "2", "VENV": ".venv"}
    expanded = re.sub(r"\$\((\w+)\)", lambda found: values.get(found[1], found[0]), makefile)
    for name, task in TASKS.items():
        (target,) = re.findall(rf"^{name}: .venv/\.(\w+)[^\n]*\n((?:\t.*\n)*)", expanded, re.M)
        extra, recipe = target
        assert extra == (task.extra or "core"), name
        # Programs of the environment are called there by their own names, here as modules.
        words = [word for word in task.command if word not in ("-m", "toolkit", "jupyterlab", "pytest")]
        assert [word for word in words if word not in recipe] == [], name
        if task.command:
            module = next(word for word in task.command if word != "-m")
            assert module.replace("jupyterlab", "jupyter lab") in recipe


def test_an_unknown_task_is_told_those_that_there_are(
    ran: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["dance"])
    assert "invalid choice: 'dance'" in capsys.readouterr().err
    assert ran == []
