"""The journal of a working run: every progress event becomes status, measurements and log."""

from __future__ import annotations

import threading
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TextIO

from toolkit.errors import Cancelled, RunError, ToolkitError
from toolkit.files import write_text
from toolkit.progress import ProgressEvent
from toolkit.runs.curves import CurveWriter
from toolkit.runs.folder import RunFolder
from toolkit.runs.lines import LineFile
from toolkit.runs.process import ProcessMark
from toolkit.runs.status import RunStatus, State, utc_now, write_status

#: Seconds between two writings of the status, in the same stage and where a new one began, and between two
#: heartbeats while no event comes.
STATUS_EVERY = 1.0
NEW_STAGE_AFTER = 0.1
HEARTBEAT_EVERY = 10.0
#: Bytes set aside while a run works and given back when it ends, so that a full disk still takes the reason.
RESERVE = 64 * 1024


class Journal:
    """Listens to a run's progress and writes it down. Made by :func:`journal`."""

    def __init__(self, run: RunFolder, curves: CurveWriter, log: LineFile) -> None:
        self._run, self._curves, self._lines = run, curves, log
        self._began = time.monotonic()
        self._lock = threading.Lock()
        self._ended = threading.Event()
        # Of each stage that did not reach its total: when it began, when it last said something, and what.
        self._open: dict[str, tuple[float, float, ProgressEvent]] = {}
        self._done: set[str] = set()
        self._status = RunStatus("running", started=utc_now(), process=ProcessMark.current())
        self._write_status()

    @property
    def seconds(self) -> float:
        """Working time of the run so far, that before it was resumed included."""
        return self._curves.seconds + time.monotonic() - self._began

    def __call__(self, event: ProgressEvent) -> None:
        """Write an event down. Raises :class:`RunError` when the disk is full or may not be written."""
        with self._lock:
            if event.values:
                self._curves.write(self.seconds, event.stage, event.done, event.values)
            self._status = replace(
                self._status, stage=event.stage, done=event.done, total=event.total, message=event.message
            )
            self._follow_stage(event)
            wait = STATUS_EVERY if event.stage == self._written_stage else NEW_STAGE_AFTER
            if time.monotonic() - self._written >= wait:
                self._write_status()

    def log(self, text: str) -> None:
        """Append a line, or several, under the current time."""
        self._lines.append(f"{utc_now()} {text}\n")

    def end(self, error: BaseException | None) -> None:
        """Write how the work ended."""
        state, message = _ending(error)
        for began, seen, last in self._open.values():
            at = f"{last.done} of {last.total}" if last.total is not None else f"{last.done}"
            self.log(f"left {last.stage} at {at} after {seen - began:.1f} s")
        if state == "failed" and error is not None:
            self.log("".join(traceback.format_exception(error)).rstrip())
        self.log(f"{state} after {self.seconds:.1f} s of work" + (f": {message}" if message else ""))
        self._status = replace(self._status, state=state, error=message)
        self._write_status()

    def _follow_stage(self, event: ProgressEvent) -> None:
        """Log a stage when it begins and when it reaches its total; stages may take turns."""
        now = time.monotonic()
        began = self._open.pop(event.stage, (now, now, event))[0]
        if event.total is not None and event.done >= event.total:
            # Some tell their end more than once; others, found in the workspace, tell nothing but their end.
            if began < now or event.stage not in self._done:
                note = f": {event.message}" if event.message else ""
                self.log(f"end {event.stage} after {now - began:.1f} s{note}")
            self._done.add(event.stage)
            return
        if began == now:
            self.log(f"start {event.stage}" + (f" ({event.total} steps)" if event.total else ""))
        self._open[event.stage] = (began, now, event)

    def _write_status(self) -> None:
        self._status = replace(self._status, heartbeat=utc_now())
        write_status(self._run.status_file, self._status)
        self._written, self._written_stage = time.monotonic(), self._status.stage

    def _beat(self) -> None:
        """Keep the heartbeat young through stages that say nothing for minutes."""
        while not self._ended.wait(STATUS_EVERY):
            with self._lock:
                if time.monotonic() - self._written >= HEARTBEAT_EVERY:
                    # Whatever refuses here will refuse the working thread too, which then raises.
                    with suppress(RunError, OSError):
                        self._write_status()

    @contextmanager
    def beating(self) -> Iterator[None]:
        """Write heartbeats in a thread of their own."""
        heart = threading.Thread(target=self._beat, name=f"heartbeat of {self._run.id}", daemon=True)
        heart.start()
        try:
            yield
        finally:
            self._ended.set()
            heart.join()


@contextmanager
def journal(run: RunFolder) -> Iterator[Journal]:
    """Write down the work on a run, and how it ends.

    Leaving the block well means ``finished``; :class:`Cancelled` and Ctrl-C mean ``cancelled``; any other
    exception means ``failed``, with its traceback in the log. Exceptions pass through.

    Raises
    ------
    RunError
        When the disk is full or may not be written.
    DataError
        When metrics.csv holds something else.
    """
    with ExitStack() as stack:
        curves = stack.enter_context(closing(CurveWriter(run.metrics_file)))
        log = stack.enter_context(closing(LineFile(run.log_file)))
        reserve = run.path / ".reserve"
        stack.callback(reserve.unlink, missing_ok=True)
        write_text(reserve, "-" * RESERVE)
        made = Journal(run, curves, log)
        try:
            with made.beating(), _warnings_to(made):
                yield made
        except BaseException as error:
            reserve.unlink(missing_ok=True)
            # Where even the reserve does not help, the error on its way says what is wrong.
            with suppress(RunError, OSError):
                made.end(error)
            raise
        reserve.unlink(missing_ok=True)
        made.end(None)


@contextmanager
def _warnings_to(listener: Journal) -> Iterator[None]:
    """Log warnings of Python's beside showing them."""
    with warnings.catch_warnings():
        shown = warnings.showwarning

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            text = " ".join(str(message).split())
            listener.log(f"warning: {category.__name__}: {text} ({Path(filename).name}:{lineno})")
            shown(message, category, filename, lineno, file, line)

        warnings.showwarning = show
        yield


def _ending(error: BaseException | None) -> tuple[State, str]:
    """Return the state that an exception leads to, and its text."""
    if error is None:
        return "finished", ""
    if isinstance(error, KeyboardInterrupt):
        return "cancelled", "Stopped by Ctrl-C."
    if isinstance(error, Cancelled):
        return "cancelled", str(error)
    return "failed", f"{error}" if isinstance(error, ToolkitError) else f"{type(error).__name__}: {error}"
