"""What a run was made with."""

from __future__ import annotations

import sys

import pytest

from toolkit.errors import RunError
from toolkit.runs import machine
from toolkit.runs.machine import describe_threads, devices_here, threads_elsewhere


def test_a_new_process_computes_with_as_many_threads_as_this_one() -> None:
    threads_elsewhere.cache_clear()

    assert threads_elsewhere() == describe_threads()


def test_a_process_that_cannot_be_started_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    threads_elsewhere.cache_clear()
    monkeypatch.setattr(sys, "executable", "/nowhere/python")

    with pytest.raises(RunError, match="No process can be started"):
        threads_elsewhere()


def test_without_a_driver_there_is_no_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    devices_here.cache_clear()
    monkeypatch.setattr(machine, "find_library", lambda name: None)

    assert devices_here() == ("cpu",)
    devices_here.cache_clear()


def test_with_a_driver_pytorch_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    devices_here.cache_clear()
    monkeypatch.setattr(machine, "find_library", lambda name: "libcuda.so.1")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)

    assert devices_here() == ("cpu", "cuda")
    devices_here.cache_clear()
