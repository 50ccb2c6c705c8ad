"""Which process works on a run, and whether it still lives."""

from __future__ import annotations

import os
import socket
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

Life = Literal["alive", "gone", "unknown"]


@dataclass(frozen=True, slots=True)
class ProcessMark:
    """A process that can be told from every later one with the same number.

    Attributes
    ----------
    pid:
        Number of the process.
    host:
        Name of its machine.
    boot:
        Identity of the machine's boot, empty where the system has none.
    started:
        Start of the process in the system's ticks since boot, empty where the system does not tell.
    """

    pid: int
    host: str
    boot: str
    started: str

    @classmethod
    def current(cls) -> ProcessMark:
        """Return the mark of this process."""
        return cls(os.getpid(), socket.gethostname(), _boot(), _started(os.getpid()))

    def life(self) -> Life:
        """Whether the process still lives; ``"unknown"`` from other machines and where the system hides it."""
        if self.host != socket.gethostname():
            return "unknown"
        if self.boot != _boot():
            return "gone"
        if self.started:
            return "alive" if _started(self.pid) == self.started else "gone"
        if sys.platform == "win32":
            return "unknown"  # os.kill(pid, 0) would end the process there.
        return _answers(self.pid)


@cache
def _boot() -> str:
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return ""


def _started(pid: int) -> str:
    """Return field 22 of ``/proc/<pid>/stat``, empty for a process that is gone or only waits to be reaped."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    # The second field is the program's name in brackets and may itself hold spaces and brackets.
    fields = text.rpartition(")")[2].split()
    return "" if fields[0] in "ZX" else fields[19]


def _answers(pid: int) -> Life:
    """Ask by a signal that does nothing."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return "gone"
    except PermissionError:
        return "alive"
    return "alive"
