"""The form of samples: a nadir flight and further queries for it, each with settings of its own."""

from __future__ import annotations

from pathlib import Path

import pytest
from page_parts import said, widget, working

from toolkit.samples.nadir_flight import NadirFlightSettings
from toolkit.samples.nadir_queries import NadirQuerySampleSettings
from toolkit.scene.folder import read_scene
from toolkit.settings import Settings
from toolkit.widgets.sample_form import SampleForm

TINY = {
    "town.extent": 180.0,
    "town.buildings": 20,
    "town.trees": 0,
    "town.mast": False,
    "path.map_photos": 3,
    "path.speed": 60.0,
    "camera.image_width": 48,
    "camera.image_height": 36,
    "camera.samples": 1,
}


@pytest.mark.parametrize(
    ("kind", "settings", "about", "splits"),
    [
        ("nadir", NadirFlightSettings().replace(TINY), "looking straight down", "train test train test train"),
        (
            "nadir-queries",
            NadirQuerySampleSettings().replace(
                {**{f"flight.{name}": value for name, value in TINY.items()}, "queries.kind": "black"}
            ),
            "same seed and settings of the flight, same town",
            "test test",
        ),
    ],
)
def test_a_nadir_sample_is_made(tmp_path: Path, kind: str, settings: Settings, about: str, splits: str) -> None:
    taken: list[Path] = []
    form = SampleForm([tmp_path], taken.append)
    form.prepare()
    widget(form, "Kind").value = kind
    assert about in said(form)
    form.form.fill(settings)
    widget(form, "Name of its folder").value = "over-town"
    form.make()
    working(form.task)
    assert taken == [tmp_path / "over-town"]
    assert " ".join(frame.split for frame in read_scene(taken[0]).frames) == splits
