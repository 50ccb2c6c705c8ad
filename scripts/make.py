"""What the Makefile's targets do for users, where there is no make (Windows): python scripts/make.py demo

Sets up ``.venv`` by itself and is quick the second time, as make is. Python's standard library only.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"


@dataclass(frozen=True)
class Task:
    """A target: what it does, which extra of the toolkit it needs, and what the environment's Python then runs."""

    help: str
    extra: str = ""
    command: tuple[str, ...] = ()


TASKS = {
    "setup": Task("install the toolkit into .venv"),
    "demo": Task(
        "make a sample flight, run two methods on it, compare the two",
        "",
        ("-m", "toolkit", "demo", "--folder", "runs/demo"),
    ),
    "lab": Task(
        "open the notebooks in JupyterLab",
        "ui",
        ("-m", "jupyterlab", "--config", "scripts/jupyter_config.py", "notebooks/00_tour.ipynb"),
    ),
    "dashboard": Task(
        "serve the dashboard on this machine",
        "ui",
        ("-m", "toolkit", "dashboard", "--runs", "runs/demo/runs", "--data", "runs/demo/data"),
    ),
    "test": Task("run the tests", "dev", ("-m", "pytest", "-n", "2", "--dist", "worksteal")),
    "workshop": Task(
        "put all that a workshop needs without network into dist/workshop", "dev", ("-m", "scripts.workshop")
    ),
    "reproduce": Task("make every paper's table at standard size", "dev", ("scripts/reproduce.py",)),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Do it and return the exit code of what was run."""
    parser = argparse.ArgumentParser(
        prog="make.py", epilog="What follows is handed on: make.py dashboard --port 5007"
    )
    tasks = parser.add_subparsers(title="tasks", dest="task", required=True, metavar="TASK")
    for name, task in TASKS.items():
        tasks.add_parser(name, help=task.help, add_help=False)
    if sys.version_info < (3, 11):  # noqa: UP036
        parser.error(f"Python 3.11 or newer is needed, found {sys.version.split()[0]}")
    given, more = parser.parse_known_args(arguments)
    task = TASKS[given.task]
    code = set_up(task.extra)
    if code or not task.command:
        return code
    environment = {**os.environ, "PYTHONUTF8": "1", "OMP_WAIT_POLICY": "passive"}
    try:
        return subprocess.run(
            [str(python()), *task.command, *more], cwd=ROOT, env=environment, check=False
        ).returncode
    except KeyboardInterrupt:
        return 130


def python() -> Path:
    """Return where the environment's Python lies."""
    return VENV / "Scripts" / "python.exe" if os.name == "nt" else VENV / "bin" / "python"


def set_up(extra: str) -> int:
    """Make the environment, install the toolkit with an extra where that is not done yet; return the exit code."""
    mark = VENV / f".{extra or 'core'}"
    newest = max((ROOT / name).stat().st_mtime for name in ("pyproject.toml", "constraints.txt"))
    if mark.exists() and mark.stat().st_mtime >= newest:
        return 0
    if not python().exists():
        code = subprocess.run([sys.executable, "-m", "venv", str(VENV)], check=False).returncode
        if code:
            return code
    print(
        f"Installing the toolkit{f' with what {extra} needs' if extra else ''} into {VENV}: some minutes ...",
        flush=True,
    )
    install = [str(python()), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    what = ["--constraint", "constraints.txt", "--editable", f".[{extra}]" if extra else "."]
    code = subprocess.run([*install, *what], cwd=ROOT, check=False).returncode
    if code == 0:
        mark.touch()
    return code


if __name__ == "__main__":
    sys.exit(main())
