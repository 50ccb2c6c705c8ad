"""A tiny flight over the town, with its video and subtitles."""

from __future__ import annotations

from pathlib import Path

import pytest

from toolkit.samples.make import SampleSettings, make_sample
from toolkit.scene import Scene

TINY = SampleSettings().replace(
    {
        "town.trees": 0,
        "flight.frames": 12,
        "flight.image_width": 160,
        "flight.image_height": 120,
        "flight.samples": 1,
        "points": 0,
        "video": True,
    }
)


@pytest.fixture(scope="session")
def town_flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Scene]:
    """Return the folder with ``video.mp4`` and ``video.srt``, and the scene that they were made of."""
    pytest.importorskip("av", reason="PyAV is not installed: pip install 'sightline-toolkit[video]'")
    folder = tmp_path_factory.mktemp("capture") / "town"
    return folder, make_sample(folder, TINY, seed=2)
