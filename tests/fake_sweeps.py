"""Sweeps of the fake recipe, worked on in the test's own process unless a test needs others."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fake_recipe import RECIPE, FakeSettings

from toolkit.runs.sweep import create_sweep
from toolkit.runs.sweep_plan import SweepPlan
from toolkit.runs.sweep_record import SweepFolder
from toolkit.runs.sweep_space import Method, parse_dimension
from toolkit.runs.threads import threads


def make_sweep(
    photos: Path, runs_dir: Path, method: Method, *texts: str, base: dict[str, Any] | None = None, **arguments: Any
) -> SweepFolder:
    """Create a sweep of the fake recipe."""
    settings = FakeSettings().replace({"loop.steps": 4, **(base or {})})
    space = [parse_dimension(text, method, settings) for text in texts]
    return create_sweep(RECIPE, photos, settings, runs_dir, method=method, space=space, **arguments)


@contextmanager
def in_this_process(plan: SweepPlan, folder: Path) -> Iterator[tuple[Executor, int]]:
    """Stand for worker processes: threads, which need no start."""
    with threads(plan.threads), ThreadPoolExecutor(plan.workers) as executor:
        yield executor, plan.workers


def wait_for(what: Callable[[], bool], seconds: float = 60.0) -> None:
    """Wait until something is so; the limit is generous: busy machines take seconds to begin a process."""
    deadline = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.05)
