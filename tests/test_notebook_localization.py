"""What the notebook on localisation leans on: a nadir flight and further queries over its town, made once."""

from __future__ import annotations

from pathlib import Path

import pytest

from toolkit.errors import StageError
from toolkit.notebook import sample_folder
from toolkit.samples.nadir_flight import NadirFlightSettings
from toolkit.samples.nadir_queries import NadirQuerySampleSettings
from toolkit.scene.folder import read_scene

TINY = {"town.extent": 150.0, "town.buildings": 15, "town.trees": 0, "path.map_photos": 5, "path.leg_spacing": 4.0}
SMALL = {"camera.image_width": 32, "camera.image_height": 24, "camera.samples": 1}
FLIGHT = NadirFlightSettings().replace({**TINY, **SMALL})


def test_a_flight_and_queries_over_its_town_are_made_once(tmp_path: Path) -> None:
    folder = sample_folder(tmp_path, FLIGHT)
    made = (folder / "sample.json").stat().st_mtime_ns
    assert sample_folder(tmp_path, FLIGHT) == folder
    assert (folder / "sample.json").stat().st_mtime_ns == made
    splits = [frame.split for frame in read_scene(folder).frames]
    assert splits == ["train", "test"] * 4 + ["train"]
    asked = NadirQuerySampleSettings(flight=FLIGHT).replace({"queries.kind": "black", "queries.frames": 2})
    queries = sample_folder(tmp_path, asked)
    assert queries != folder
    assert [frame.split for frame in read_scene(queries).frames] == ["test"] * 2
    assert sample_folder(tmp_path, asked.replace({"queries.frames": 1})) != queries


def test_what_cannot_be_flown_is_told(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="is too short for its turn"):
        sample_folder(tmp_path, FLIGHT.replace({"path.leg_spacing": 55.0}))
