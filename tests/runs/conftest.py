"""Runs of the fake recipe."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fake_recipe import RECIPE, FakeSettings, MakeRun, write_photos

from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import create_run, execute


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    return write_photos(tmp_path / "photos")


@pytest.fixture
def runs_dir(tmp_path: Path) -> Path:
    return tmp_path / "runs"


@pytest.fixture
def queued(photos: Path, runs_dir: Path) -> MakeRun:
    """Return a function that makes a queued run; two underscores in a setting's name stand for a dot."""

    def make(*, name: str = "", seed: int = 0, data: Path | None = None, **changes: Any) -> RunFolder:
        dotted = {key.replace("__", "."): value for key, value in changes.items()}
        settings = FakeSettings().replace(dotted)
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
