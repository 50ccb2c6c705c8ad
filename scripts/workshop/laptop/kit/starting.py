"""Starting what is installed: JupyterLab, the dashboard, or a check that all of it works."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from .here import VENV, Refused, venv_python
from .installing import MARK, RUNS
from .manifest import read_manifest, sample_folders

#: The notebook that JupyterLab opens.
FIRST = "notebooks/00_tour.ipynb"
#: Where the dashboard puts what participants bring.
OWN = "data"


def main(arguments: Sequence[str], folder: Path | None = None) -> int:
    """Start and return the exit code of what was started, or 2 where nothing is installed."""
    parser = argparse.ArgumentParser(
        prog="start.py",
        description=__doc__,
        epilog="What follows is handed on: start.py lab --port 8889, start.py dashboard --port 5007",
    )
    parser.add_argument("what", choices=("lab", "dashboard", "check"))
    given, more = parser.parse_known_args(arguments)
    place = folder or Path(__file__).resolve().parent.parent
    try:
        return start(place, given.what, more)
    except Refused as refused:
        print(refused, file=sys.stderr)
        return 2


def start(folder: Path, what: str, more: Sequence[str] = ()) -> int:
    """Start it in ``folder`` and return its exit code when it ends. Raises :class:`Refused` before the install."""
    python = venv_python(folder)
    if not python.is_file() or not (folder / VENV / MARK).is_file():
        raise Refused(f"The workshop is not installed in {folder} yet. First: install.py, see START-HERE.md.")
    command = [str(python), *arguments_of(what, folder), *more]
    try:
        # UTF-8 also where the output is a file or a Windows console of another code page.
        return subprocess.run(command, cwd=folder, env={**os.environ, "PYTHONUTF8": "1"}, check=False).returncode
    except KeyboardInterrupt:
        return 0


def arguments_of(what: str, folder: Path) -> list[str]:
    """Return how the virtual environment's Python is called for it."""
    if what == "lab":
        config = folder / "kit" / "jupyter_config.py"
        return ["-m", "jupyterlab", f"--config={config}", f"--ServerApp.root_dir={folder}", FIRST]
    if what == "dashboard":
        data = [OWN, *sample_folders(read_manifest(folder), RUNS)]
        return ["-m", "toolkit", "dashboard", "--runs", RUNS, "--data", *data, "--open"]
    return [str(folder / "kit" / "smoke.py")]
