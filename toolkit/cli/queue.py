"""Commands on runs that wait and work: queue, work, cancel."""

from __future__ import annotations

import argparse

from toolkit.cli.common import RUN_HELP, add, add_runs_dir


def add_commands(commands: argparse._SubParsersAction) -> None:
    """Add all of them."""
    add_runs_dir(add(commands, "queue", _queue, "List the runs that wait for their turn.", "queue"))
    add_runs_dir(add(commands, "work", _work, "Work on the runs that wait, one after the other, then end.", "work"))
    added = add(
        commands, "cancel", _cancel, "Stop a run that works, or take one out of the queue.", "cancel latest"
    )
    added.add_argument("run", metavar="RUN", help=RUN_HELP)
    add_runs_dir(added)


def _queue(arguments: argparse.Namespace) -> None:
    from toolkit.runs.queue import waiting_runs

    waiting = waiting_runs(arguments.runs)
    print("\n".join(run.id for run in waiting) if waiting else f"Nothing waits in {arguments.runs}")


def _work(arguments: argparse.Namespace) -> None:
    from toolkit.runs.queue import work

    print(f"Worked on {work(arguments.runs)} runs")


def _cancel(arguments: argparse.Namespace) -> None:
    from toolkit.runs.index import find_run
    from toolkit.runs.stop import stop_run

    run = find_run(arguments.run, arguments.runs)
    print(f"{stop_run(run)} It can go on: toolkit resume {run.path}")
