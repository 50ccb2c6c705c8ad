"""A map on disk comes back as it was, and says what is wrong with it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_scene import true_gaussians

from toolkit.errors import DataError
from toolkit.geometry.alignment import Similarity
from toolkit.scene import Georeference
from toolkit.splat.map_file import MAP, StoredMap, read_map, write_map


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    world = Similarity(150.0, np.eye(3), np.array([1.0, 2.0, 3.0]))
    origin = Georeference(48.0, 9.0, 600.0)
    write_map(StoredMap(true_gaussians(), "2d", world, origin, {"steps": 3}, {"sparse": 7.0}), tmp_path)
    return tmp_path


def change(folder: Path, **entries: object) -> None:
    record = json.loads((folder / MAP).read_text())
    (folder / MAP).write_text(json.dumps({**record, **entries}))


def test_a_map_comes_back(folder: Path) -> None:
    found = read_map(folder)
    for (name, one), (_, other) in zip(found.gaussians.named(), true_gaussians().named(), strict=True):
        assert torch.equal(one, other), name
    assert found.kind == "2d"
    assert found.world_from_normalised.scale == 150.0
    assert found.world_from_normalised.translation.tolist() == [1.0, 2.0, 3.0]
    assert found.georeference == Georeference(48.0, 9.0, 600.0)
    assert (found.settings, found.counts) == ({"steps": 3}, {"sparse": 7.0})


def test_a_map_need_not_lie_on_earth(folder: Path) -> None:
    change(folder, georeference=None)
    assert read_map(folder).georeference is None


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"version": 2}, "no map of this version; expected format 'sightline-map', version 1; .*version 2"),
        ({"format": "other"}, "found format 'other'"),
        ({"kind": "4d"}, "is damaged; expected kind '2d' or '3d'; found '4d'"),
        ({"world_from_normalised": {"scale": 1.0}}, "is damaged; expected what write_map writes; .*rotation"),
        ({"counts": 3}, "is damaged"),
    ],
)
def test_damage_is_told(folder: Path, entries: dict[str, object], message: str) -> None:
    change(folder, **entries)
    with pytest.raises(DataError, match=message):
        read_map(folder)


def test_a_folder_without_a_map_is_none(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"map\.json is missing"):
        read_map(tmp_path)
    (tmp_path / MAP).write_text("[]")
    with pytest.raises(DataError, match="no map of this version"):
        read_map(tmp_path)
