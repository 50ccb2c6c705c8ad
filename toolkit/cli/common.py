"""What all commands share: how one is added, the progress bar, the flag that names the runs."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from toolkit.progress import TqdmProgress

T = TypeVar("T")
#: Returns the exit code; None is 0.
Command = Callable[[argparse.Namespace], int | None]

RUN_HELP = "id, unique beginning of an id, name, path, latest or latest-<n> (n runs before)"


def add(
    commands: argparse._SubParsersAction, name: str, command: Command, help: str, example: str
) -> argparse.ArgumentParser:
    """Add a command with its help and an example; return its parser."""
    added: argparse.ArgumentParser = commands.add_parser(
        name, help=help, description=help, epilog=f"Example: toolkit {example}"
    )
    added.set_defaults(command=command)
    added.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return added


def add_runs_dir(parser: argparse.ArgumentParser) -> None:
    """Add the flag that names the folder of runs."""
    default = Path(os.environ.get("TOOLKIT_RUNS") or "runs")
    parser.add_argument(
        "--runs", type=Path, default=default, metavar="DIR", help="folder of runs [runs, or $TOOLKIT_RUNS]"
    )


def data_dirs_beside(runs_dir: Path) -> list[Path]:
    """Return where captures are looked for unless it is said: ``data`` beside the runs, and ``TOOLKIT_DATA``."""
    named = os.environ.get("TOOLKIT_DATA")
    return [runs_dir.parent / "data", *([Path(named)] if named else [])]


def with_bar(work: Callable[[TqdmProgress], T]) -> T:
    """Return ``work(bar)`` with a progress bar that is closed afterwards."""
    bar = TqdmProgress()
    try:
        return work(bar)
    finally:
        bar.close()
