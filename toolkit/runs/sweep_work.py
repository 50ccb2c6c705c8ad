"""What a worker of a sweep does: it works on one run, once for each time that the run is handed out."""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path

from toolkit.errors import DataError, ToolkitError
from toolkit.files import disk_errors
from toolkit.recipes.base import Recipe
from toolkit.runs.folder import RunFolder, open_run
from toolkit.runs.launch import resume
from toolkit.runs.threads import use_threads

#: Seconds between looks at a run that a worker elsewhere seems to work on.
_LOOK_EVERY = 1.0


def work_on(run_path: Path, mark: Path, state: str, threads: int, recipe: Recipe | None = None) -> str:
    """Work on a run in this process and return the state in which it is then.

    How a run ends stands in its folder; only what kept a worker from beginning is raised.

    Parameters
    ----------
    run_path:
        Folder of the run.
    mark:
        File that is made when work begins. Where it is there already, a scheduler gave out the same task again
        because its first worker died: the sweep itself hands runs out again and counts how often, so nothing is
        done here.
    state:
        In which the run was handed out; where it has another one meanwhile (cancelled, say), nothing is done.
    threads:
        To compute with.
    recipe:
        For recipes that are not registered.

    Raises
    ------
    RunError
        Where the run is not there, another process holds it, or the disk refuses.
    """
    run = open_run(run_path)
    if not _marked(mark):
        return state_of(run)
    use_threads(threads)
    while (now := state_of(run)) == "running":
        # Its worker died on another machine, which shows by its silence; or somebody resumed it by hand.
        time.sleep(_LOOK_EVERY)
    if now not in (state, "interrupted"):
        return now
    try:
        resume(run, recipe=recipe)
    except ToolkitError:
        if state_of(run) == now:  # it never began: the reason is nowhere but here
            raise
    return state_of(run)


def state_of(run: RunFolder) -> str:
    """Return a run's state; one that cannot be read counts as that of an interrupted run."""
    try:
        return run.status().state
    except DataError:
        return "interrupted"


def _marked(mark: Path) -> bool:
    """Leave a mark and return whether it is the first."""
    with disk_errors(mark, "writing"):
        try:
            with mark.open("x", encoding="utf-8") as file:
                file.write(f"{socket.gethostname()} {os.getpid()}\n")
        except FileExistsError:
            return False
    return True
