"""A run's process is told from every other, also from a later one with the same number."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from toolkit.runs.process import ProcessMark

linux = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc to tell processes apart")


def test_this_process_is_alive() -> None:
    mark = ProcessMark.current()
    assert mark.pid == os.getpid()
    assert mark.life() == "alive"


@linux
def test_a_later_process_with_the_same_number_is_another_one() -> None:
    assert replace(ProcessMark.current(), started="1").life() == "gone"


@linux
def test_after_a_restart_of_the_machine_every_process_is_gone() -> None:
    assert replace(ProcessMark.current(), boot="another boot").life() == "gone"


def test_a_process_of_another_machine_cannot_be_judged() -> None:
    assert replace(ProcessMark.current(), host="elsewhere").life() == "unknown"


@linux
def test_a_killed_process_is_gone_even_before_it_is_reaped() -> None:
    code = "from toolkit.runs.process import ProcessMark as P; print(P.current().started, flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        started = child.stdout.readline().decode().strip()
        mark = replace(ProcessMark.current(), pid=child.pid, started=started)
        assert mark.life() == "alive"
        child.send_signal(signal.SIGKILL)
        deadline = time.monotonic() + 10  # generous: the kernel needs microseconds
        while mark.life() == "alive" and time.monotonic() < deadline:
            time.sleep(0.01)
        assert mark.life() == "gone"  # not waited for yet: a zombie
    assert mark.life() == "gone"


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_where_start_times_are_hidden_the_number_decides() -> None:
    mark = replace(ProcessMark.current(), started="")
    assert mark.life() == "alive"
    with subprocess.Popen([sys.executable, "-c", ""]) as child:
        child.wait()
    assert replace(mark, pid=child.pid).life() == "gone"
