"""Matchers that other packages add: their features and matches in the database, and what is refused."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from toolkit.errors import CapabilityError, DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching import added
from toolkit.matching.added import (
    AddedMatcherSettings,
    Detected,
    Matcher,
    added_matchers,
    extract_added,
    match_added,
    matcher_of,
)
from toolkit.matching.database import copy_database
from toolkit.matching.descriptors import descriptor_path, read_keypoints
from toolkit.matching.feature_choice import FeatureSettings, extract_features, match_features
from toolkit.matching.pairs import PairSettings, choose_pairs
from toolkit.scene import Frame, Scene
from toolkit.settings import Integer

PIXELS = np.random.default_rng(0).uniform(5, 75, (60, 2)).round(1)


class DotSettings(AddedMatcherSettings):
    """Of a matcher that knows where its features are."""

    most = Integer(60, bounds=(1, 1000), doc="How many.")


class OtherSettings(AddedMatcherSettings):
    """Of another one."""


def detect(picture: NDArray[np.uint8], settings: DotSettings) -> tuple[Any, Any]:
    """The features lie so many pixels farther right as the picture is bright."""
    pixels = PIXELS[: settings.most] + np.array([picture[0, 0, 0], 0])
    return pixels, np.arange(len(pixels))[:, None]


def match(one: Detected, other: Detected, settings: DotSettings) -> NDArray[np.int64]:
    equal = one.descriptors[:, None, 0] == other.descriptors[None, :, 0]
    return np.argwhere(equal)


DOTS = Matcher("dots", "Dots of the test", DotSettings, detect, match)


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Matcher]]:
    """Let the packages in this table be installed."""
    there = {"dots": DOTS}
    monkeypatch.setattr(added, "added_by_packages", lambda group, kind: there)
    added_matchers.cache_clear()
    yield there
    added_matchers.cache_clear()


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    (tmp_path / "images").mkdir()
    for i in range(3):
        Image.fromarray(np.full((80, 96, 3), 4 * i, np.uint8)).save(tmp_path / "images" / f"{i}.png")
    frames = tuple(Frame(f"{i}.png", 1) for i in range(3))
    return Scene(tmp_path / "images", {1: ColmapCamera.pinhole(96, 80, 90.0)}, frames)


def both(scene: Scene, database: Path, settings: AddedMatcherSettings, matcher: Matcher | None = None) -> Any:
    pairs = choose_pairs(scene, PairSettings(method="exhaustive"))
    features = extract_added(scene, database, settings, matcher=matcher)
    return features, match_added(database, scene, pairs, settings, matcher=matcher)


def test_features_are_in_the_database_and_matches_are_verified(scene: Scene, tmp_path: Path) -> None:
    features, matches = both(scene, tmp_path / "a.db", DotSettings(most=40))
    assert features.counts == {"0.png": 40, "1.png": 40, "2.png": 40}
    np.testing.assert_allclose(read_keypoints(tmp_path / "a.db")[2], PIXELS[:40] + np.array([4, 0]), atol=1e-5)
    assert matches.matches.tolist() == [40, 40, 40]
    # All moved by the same, which one geometry explains.
    assert matches.inliers.min() >= 38


def test_the_stages_dispatch_by_the_settings(scene: Scene, tmp_path: Path) -> None:
    settings = DotSettings()
    extract_features(scene, tmp_path / "a.db", settings)
    copy_database(tmp_path / "a.db", tmp_path / "b.db")
    pairs = choose_pairs(scene, PairSettings(method="sequential", overlap=1))
    report = match_features(tmp_path / "b.db", scene, pairs, settings, features_from=tmp_path / "a.db")
    assert report.matches.tolist() == [60, 60]


def test_features_under_a_mask_are_left_out(scene: Scene, tmp_path: Path) -> None:
    mask = np.full((80, 96), 255, np.uint8)
    mask[:, :40] = 0
    (tmp_path / "masks").mkdir()
    Image.fromarray(mask).save(tmp_path / "masks" / "0.png.png")
    features = extract_added(scene.replace(mask_dir=tmp_path / "masks"), tmp_path / "a.db", DotSettings())
    assert features.counts["0.png"] == int((PIXELS[:, 0] >= 40).sum())
    assert features.counts["1.png"] == 60


def test_a_picture_without_features_has_no_matches(scene: Scene, tmp_path: Path) -> None:
    def nothing_in_the_first(picture: NDArray[np.uint8], settings: Any) -> tuple[Any, Any]:
        found = detect(picture, settings)
        return found if picture[0, 0, 0] else (np.zeros((0, 2)), np.zeros((0, 1)))

    _, matches = both(scene, tmp_path / "a.db", DotSettings(), replace(DOTS, detect=nothing_in_the_first))
    assert matches.matches.tolist() == [0, 0, 60]


@pytest.mark.parametrize(
    ("pixels", "descriptors"),
    [
        (np.zeros((3, 3)), np.zeros((3, 1))),
        (np.zeros((3, 2)), np.zeros((2, 1))),
        (np.full((3, 2), np.nan), np.zeros((3, 1))),
        (np.zeros((3, 2)), np.full((3, 1), np.inf)),
    ],
)
def test_what_are_no_features_is_refused(scene: Scene, tmp_path: Path, pixels: Any, descriptors: Any) -> None:
    odd = replace(DOTS, detect=lambda picture, settings: (pixels, descriptors))
    with pytest.raises(StageError, match=r"'dots' gave no features of 0.png; expected finite pixels \(K, 2\)"):
        extract_added(scene, tmp_path / "a.db", DotSettings(), matcher=odd)


@pytest.mark.parametrize("index", [[[0, 60]], [[-1, 0]], [[0.5, 1.0]], [0, 1]])
def test_what_are_no_matches_is_refused(scene: Scene, tmp_path: Path, index: Any) -> None:
    odd = replace(DOTS, match=lambda one, other, settings: np.array(index))
    with pytest.raises(StageError, match=r"'dots' gave no matches; expected \(M, 2\) places among 60 and 60"):
        both(scene, tmp_path / "a.db", DotSettings(), odd)


def test_descriptors_of_another_matcher_are_refused(scene: Scene, tmp_path: Path) -> None:
    extract_added(scene, tmp_path / "a.db", DotSettings())
    other = replace(DOTS, name="other")
    pairs = choose_pairs(scene, PairSettings(method="exhaustive"))
    with pytest.raises(DataError, match="is not of 'other'; expected other; found 'dots'"):
        match_added(tmp_path / "a.db", scene, pairs, DotSettings(), matcher=other)
    assert descriptor_path(tmp_path / "a.db").is_file()


def test_settings_of_no_matcher_are_refused() -> None:
    assert matcher_of(DotSettings()) is DOTS
    with pytest.raises(
        StageError, match="No matcher has settings of the class OtherSettings.*DotSettings.*Install"
    ):
        matcher_of(OtherSettings())


@pytest.mark.parametrize("name", ["sift", "aliked-lightglue", "match", "2d", "a.b"])
def test_names_that_are_taken_or_no_names_are_refused(known: dict[str, Matcher], name: str) -> None:
    known[name] = replace(DOTS, name=name, settings_type=OtherSettings)
    with pytest.raises(CapabilityError, match=f"A matcher cannot be named '{name}'"):
        added_matchers()


@pytest.mark.parametrize("kind", [DotSettings, AddedMatcherSettings, FeatureSettings])
def test_each_matcher_has_settings_of_its_own(known: dict[str, Matcher], kind: Any) -> None:
    known["other"] = replace(DOTS, name="other", settings_type=kind)
    with pytest.raises(CapabilityError, match="settings of the matcher 'other' are not its own"):
        added_matchers()


def test_the_group_and_the_module_follow_from_the_declaration() -> None:
    matcher = replace(DOTS, name="my-dots")
    assert matcher.group == "my_dots"
    assert matcher.module.__name__ == __name__
