"""Runs of the fake recipe, to be shown."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browsing import collect_problems, launch
from fake_recipe import RECIPE, FakeSettings, MakeRun, write_photos
from playwright.sync_api import Page, sync_playwright

from toolkit.errors import StageError
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import create_run, execute

# It has no slash: names may not.
_ODD = "<script>window.harm=1<img src=x onerror=window.harm=1>&'\""


@pytest.fixture
def odd_name() -> str:
    """Return a name that would do harm where it is not escaped."""
    return _ODD


@pytest.fixture
def runs_dir(tmp_path: Path) -> Path:
    return tmp_path / "runs"


@pytest.fixture
def queued(tmp_path: Path, runs_dir: Path) -> MakeRun:
    """Return a function that makes a queued run; two underscores in a setting's name stand for a dot."""
    photos = write_photos(tmp_path / "photos")

    def make(*, name: str = "", seed: int = 0, data: Path | None = None, **changes: Any) -> RunFolder:
        settings = FakeSettings().replace({key.replace("__", "."): value for key, value in changes.items()})
        return create_run(RECIPE, data or photos, settings, runs_dir, seed=seed, name=name)

    return make


@pytest.fixture
def finished(queued: MakeRun) -> MakeRun:
    """Return a function that makes a finished run."""

    def make(**arguments: Any) -> RunFolder:
        run = queued(**arguments)
        execute(run, recipe=RECIPE)
        return run

    return make


@pytest.fixture
def failed(queued: MakeRun) -> RunFolder:
    """Return a run that failed at its 20th step."""
    run = queued(name="stopped early", fail_at=20)
    with pytest.raises(StageError):
        execute(run, recipe=RECIPE)
    return run


@pytest.fixture
def pair(finished: MakeRun, odd_name: str) -> list[RunFolder]:
    """Return two finished runs that differ in a setting, the first with a harmful name."""
    return [finished(name=odd_name, loop__rate=0.8), finished(name="fast", loop__rate=0.2)]


@pytest.fixture
def problems() -> list[str]:
    """Return what went wrong on :func:`page` so far."""
    return []


@pytest.fixture
def page(problems: list[str]) -> Iterator[Page]:
    """Yield a page in a browser of its own; the test is skipped where there is none."""
    with sync_playwright() as playwright:
        browser = launch(playwright)
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        collect_problems(page, problems)
        yield page
        browser.close()
