"""Features and matches in one call are those of the three calls."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from toolkit.errors import ToolkitError
from toolkit.matching.features import SiftSettings, extract_sift
from toolkit.matching.match import MatchSettings, match_pairs
from toolkit.matching.pairs import PairSettings, choose_pairs
from toolkit.matching.scene_matches import match_scene
from toolkit.samples.make import SampleSettings, make_sample
from toolkit.scene import Scene


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    small = {"frames": 3, "arc": 30, "image_width": 160, "image_height": 120}
    return make_sample(tmp_path_factory.mktemp("flight") / "town", SampleSettings().replace({"flight": small}))


def test_one_call_is_the_three_calls(flight: Scene, tmp_path: Path) -> None:
    sift, pairs = SiftSettings(max_features=512), PairSettings(method="exhaustive")
    found = match_scene(flight, tmp_path / "one.db", sift, pairs)
    extract_sift(flight, tmp_path / "three.db", sift)
    wanted = match_pairs(tmp_path / "three.db", flight, choose_pairs(flight, pairs), MatchSettings())
    np.testing.assert_array_equal(found.report.pairs, wanted.pairs)
    np.testing.assert_array_equal(found.report.matches, wanted.matches)
    np.testing.assert_array_equal(found.report.inliers, wanted.inliers)
    assert found.report.inliers.max() > 15
    assert found.database == tmp_path / "one.db"
    assert set(found.seconds) == {"features", "matches"}
    assert min(found.seconds.values()) > 0


def test_missing_positions_are_told_before_features_are_extracted(flight: Scene, tmp_path: Path) -> None:
    import dataclasses

    bare = flight.replace(frames=tuple(dataclasses.replace(frame, prior=None) for frame in flight.frames))
    with pytest.raises(ToolkitError):
        match_scene(bare, tmp_path / "none.db", SiftSettings(), PairSettings(method="spatial"))
    assert not (tmp_path / "none.db").exists()
