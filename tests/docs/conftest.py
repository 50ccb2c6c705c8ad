"""A folder with a few photos of the sample town, in which the documentation's code runs."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from toolkit.samples.make import SampleSettings, make_sample


@pytest.fixture(scope="session")
def tiny_photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with twelve photos of a turn around the town, 320 x 240, as a drone writes them."""
    flight = {"flight.frames": 12, "flight.arc": 150.0, "flight.image_width": 320, "flight.image_height": 240}
    made = tmp_path_factory.mktemp("docs") / "town"
    make_sample(made, SampleSettings().replace(flight), seed=1)
    photos = made.parent / "photos"
    shutil.copytree(made / "images", photos)
    return photos


@pytest.fixture
def folder(tiny_photos: Path, tmp_path: Path) -> Path:
    """Return an empty folder with ``photos/`` in it."""
    shutil.copytree(tiny_photos, tmp_path / "photos")
    return tmp_path
