"""Commands that show things: the demonstration and the page of runs."""

from __future__ import annotations

import argparse
from pathlib import Path

from toolkit.cli.common import add, add_runs_dir, with_bar


def add_commands(commands: argparse._SubParsersAction) -> None:
    """Add both."""
    _add_demo(commands)
    _add_dashboard(commands)


def _add_demo(commands: argparse._SubParsersAction) -> None:
    added = add(commands, "demo", _demo, "Make a sample flight, run a method in two ways, compare.", "demo")
    added.add_argument("--folder", type=Path, default=Path("demo"), metavar="DIR", help="where to write [demo]")


def _demo(arguments: argparse.Namespace) -> None:
    from toolkit.demo import run_demo
    from toolkit.runs.text import comparison_text

    comparison, page = with_bar(lambda bar: run_demo(arguments.folder, bar))
    print(comparison_text(comparison))
    print(f"\nThe same with curves, camera paths and pictures: {page.resolve().as_uri()}")
    print(
        "The same to click through: make dashboard, or toolkit dashboard --runs " + str(arguments.folder / "runs")
    )


def _add_dashboard(commands: argparse._SubParsersAction) -> None:
    added = add(
        commands,
        "dashboard",
        _dashboard,
        "Serve the page of runs on this machine, until Ctrl-C.",
        "dashboard --open",
    )
    added.add_argument("--port", type=int, default=5006, help="where it listens, on this machine only [5006]")
    added.add_argument("--open", action="store_true", help="open the page in the browser")
    add_runs_dir(added)


def _dashboard(arguments: argparse.Namespace) -> None:
    from toolkit.widgets.serve import serve

    serve(arguments.runs, port=arguments.port, open_browser=arguments.open)
