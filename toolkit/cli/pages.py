"""Commands that show things: the demonstration and the page of runs."""

from __future__ import annotations

import argparse
from pathlib import Path

from toolkit.cli.common import add, add_runs_dir, data_dirs_beside, with_bar


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
        "Serve the dashboard on this machine, until Ctrl-C.",
        "dashboard --open",
    )
    added.add_argument(
        "--data",
        type=Path,
        nargs="+",
        metavar="DIR",
        help="folders with captures; new data go into the first one [data beside the runs, and $TOOLKIT_DATA]",
    )
    added.add_argument("--port", type=int, default=5006, help="where it listens [5006]")
    added.add_argument(
        "--host", default="127.0.0.1", help="address that it listens on; a network's needs --passwords [127.0.0.1]"
    )
    added.add_argument(
        "--passwords", type=Path, metavar="FILE", help='who may log in: a JSON file, {"name": "password"}'
    )
    added.add_argument(
        "--origin",
        nargs="+",
        default=[],
        metavar="HOST",
        help="further addresses (host or host:port) by which browsers reach it, as behind a proxy",
    )
    added.add_argument(
        "--cluster", nargs="+", default=[], metavar="ADDRESS", help="Dask schedulers on which sweeps may run"
    )
    added.add_argument("--open", action="store_true", help="open the page in the browser")
    add_runs_dir(added)


def _dashboard(arguments: argparse.Namespace) -> None:
    from toolkit.widgets.serve import Opening, serve

    opening = Opening(arguments.port, arguments.host, arguments.passwords, tuple(arguments.origin))
    data = arguments.data or data_dirs_beside(arguments.runs)
    serve(arguments.runs, data, opening, clusters=arguments.cluster, open_browser=arguments.open)
