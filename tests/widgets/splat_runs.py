"""Fixtures of runs with a splat, imported by the tests of the View tab."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

import pytest
from fake_recipe import MakeRun
from splat_recipe import SPLAT_RECIPE

from toolkit.errors import ToolkitError
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import execute


class AtOnce(Executor):
    """Does everything before it returns: pages can be tested line by line."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except ToolkitError as error:
            future.set_exception(error)
        return future


@pytest.fixture
def splat_run(queued: MakeRun) -> MakeRun:
    """Return a function that makes a finished run with a splat."""

    def make(**arguments: Any) -> RunFolder:
        run = queued(**arguments)
        execute(run, recipe=SPLAT_RECIPE)
        return run

    return make
