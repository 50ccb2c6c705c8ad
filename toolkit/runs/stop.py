"""Stopping a run and letting it go on, whether it works or waits: what buttons and commands mean by it."""

from __future__ import annotations

from toolkit.runs.cancel import request_cancel
from toolkit.runs.folder import RunFolder
from toolkit.runs.queue import enqueue, ensure_worker, withdraw

#: States that a run can be stopped in, and those from which it goes on.
STOPPABLE = frozenset({"queued", "running"})
RESUMABLE = frozenset({"failed", "cancelled", "interrupted"})


def stop_run(run: RunFolder) -> str:
    """Take a run out of those that wait, and ask it to stop where it works; return what that does, a sentence.

    Raises
    ------
    RunError
        Where it neither waits nor works, and where the disk refuses.
    DataError
        Where its status is damaged.
    """
    waited = withdraw(run)
    state = run.status().state
    if waited and state not in STOPPABLE:
        return f"Run {run.id} waits no more."
    request_cancel(run)
    return f"Run {run.id} stops at its next step." if state == "running" else f"Run {run.id} is cancelled."


def let_wait(run: RunFolder) -> str:
    """Let a run wait for its turn and see that somebody works; return what that does, a sentence.

    Raises
    ------
    RunError
        Where it works or is finished, and where the disk refuses.
    DataError
        Where its status is damaged.
    """
    enqueue(run)
    began = ensure_worker(run.path.parent)
    return f"Run {run.id} waits for its turn" + (": it is the next." if began else ".")
