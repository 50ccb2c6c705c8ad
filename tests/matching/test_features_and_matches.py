"""SIFT features and their matches in a COLMAP database, from small pictures cut out of one texture."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy import ndimage

from toolkit.errors import Cancelled, CapabilityError, DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.database import copy_database, keypoint_counts, match_counts
from toolkit.matching.features import SiftSettings, extract_sift, start_cameras
from toolkit.matching.match import MatchSettings, match_pairs
from toolkit.matching.pairs import ChosenPairs, PairSettings, choose_pairs
from toolkit.progress import ProgressEvent
from toolkit.scene import Frame, PosePrior, Scene

WIDTH, HEIGHT = 160, 120
QUICK = SiftSettings(first_octave=0, max_features=500)


def texture(seed: int) -> np.ndarray:
    """Return a grey texture (260, 360) with blobs of all sizes."""
    noise = np.random.default_rng(seed).normal(size=(260, 360))
    layers = sum(size * ndimage.gaussian_filter(noise, size) for size in (1.0, 2.0, 4.0, 8.0))
    return np.clip(128 + 60 * layers / np.std(layers), 0, 255).astype(np.uint8)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """Four pictures: three windows of one texture, 12 pixels apart, and one of another."""
    folder = tmp_path / "images"
    (folder / "strip 2").mkdir(parents=True)
    ground = texture(0)
    cuts = {
        "a.png": ground[:HEIGHT, :WIDTH],
        "strip 2/b 1.png": ground[6 : HEIGHT + 6, 12 : WIDTH + 12],
        "strip 2/b 2.png": ground[12 : HEIGHT + 12, 24 : WIDTH + 24],
        "other.png": texture(1)[:HEIGHT, :WIDTH],
    }
    for name, cut in cuts.items():
        Image.fromarray(cut).save(folder / name)
    camera = ColmapCamera("SIMPLE_RADIAL", WIDTH, HEIGHT, (190.0, 80.0, 60.0, 0.01), prior_focal_length=True)
    return Scene(folder, {5: camera}, tuple(Frame(name, 5) for name in cuts))


@pytest.fixture
def matched(scene: Scene, tmp_path: Path) -> Path:
    extract_sift(scene, tmp_path / "features.db", QUICK)
    copy_database(tmp_path / "features.db", tmp_path / "matches.db")
    return tmp_path / "matches.db"


def rows(path: Path, query: str) -> list[tuple]:
    with closing(sqlite3.connect(path)) as connection:
        return connection.execute(query).fetchall()


def test_every_picture_gets_its_features_and_the_report_counts_them(scene: Scene, tmp_path: Path) -> None:
    report = extract_sift(scene, tmp_path / "f.db", QUICK)
    assert list(report.counts) == [frame.name for frame in scene.frames]
    assert keypoint_counts(tmp_path / "f.db") == report.counts
    assert report.too_few == ()
    summary = report.to_dict()
    assert summary["images"] == 4
    assert summary["features"] == sum(report.counts.values())
    assert summary["features_min"] > 50


def test_the_database_is_one_file_that_starts_anew(scene: Scene, tmp_path: Path) -> None:
    first = extract_sift(scene, tmp_path / "db" / "f.db", QUICK)
    again = extract_sift(scene, tmp_path / "db" / "f.db", QUICK)
    assert [path.name for path in (tmp_path / "db").iterdir()] == ["f.db"]
    assert first.counts == again.counts


def test_features_repeat_whatever_the_threads(scene: Scene, tmp_path: Path) -> None:
    query = "SELECT image_id, data FROM keypoints UNION ALL SELECT image_id, data FROM descriptors"
    for threads, name in ((1, "one.db"), (2, "two.db")):
        extract_sift(scene, tmp_path / name, QUICK.replace({"threads": threads}), seed=threads)
    assert rows(tmp_path / "one.db", query) == rows(tmp_path / "two.db", query)


def test_cameras_keep_number_intrinsics_and_whether_the_focal_length_is_known(scene: Scene, tmp_path: Path) -> None:
    extract_sift(scene, tmp_path / "f.db", QUICK)
    with closing(pycolmap.Database.open(tmp_path / "f.db")) as database:
        (camera,) = database.read_all_cameras()
        images = database.read_all_images()
    assert camera.camera_id == 5
    assert camera.has_prior_focal_length
    assert ColmapCamera.from_pycolmap(camera) == scene.cameras[5]
    assert [(image.image_id, image.name, image.camera_id) for image in images] == [
        (i, frame.name, 5) for i, frame in enumerate(scene.frames, start=1)
    ]


def test_position_priors_come_from_the_frames(scene: Scene, tmp_path: Path) -> None:
    known = PosePrior(np.array([1.0, 2.0, 30.0]), np.array([0.5, 0.5, 2.0]))
    unsure = PosePrior(np.array([4.0, 5.0, 6.0]))
    frames = (
        Frame("a.png", 5, prior=known),
        Frame("other.png", 5, prior=PosePrior(rotation=np.eye(3))),
        Frame("strip 2/b 1.png", 5, prior=unsure),
    )
    extract_sift(scene.replace(frames=frames), tmp_path / "f.db", QUICK)
    with closing(pycolmap.Database.open(tmp_path / "f.db")) as database:
        priors = {prior.corr_data_id.id: prior for prior in database.read_all_pose_priors()}
    assert sorted(priors) == [1, 3]
    np.testing.assert_array_equal(priors[1].position, [1.0, 2.0, 30.0])
    np.testing.assert_array_equal(priors[1].position_covariance, np.diag([0.25, 0.25, 4.0]))
    assert priors[1].coordinate_system == pycolmap.PosePriorCoordinateSystem.CARTESIAN
    assert np.isnan(priors[3].position_covariance).all()


def test_masked_ground_has_no_features(scene: Scene, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    keep = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    keep[:, 80:] = 255
    Image.fromarray(keep).save(masks / "a.png.png")
    free = extract_sift(scene, tmp_path / "free.db", QUICK)
    report = extract_sift(scene.replace(mask_dir=masks), tmp_path / "f.db", QUICK)
    with closing(pycolmap.Database.open(tmp_path / "f.db")) as database:
        keypoints = database.read_keypoints(1)
    assert 20 < report.counts["a.png"] < free.counts["a.png"]
    assert keypoints[:, 0].min() >= 80
    # The others have no mask: nothing of them is left out.
    assert report.counts["other.png"] == free.counts["other.png"]


def test_pictures_with_next_to_nothing_in_them_are_named(scene: Scene, tmp_path: Path) -> None:
    Image.new("L", (WIDTH, HEIGHT), 128).save(scene.image_dir / "other.png")
    assert extract_sift(scene, tmp_path / "f.db", QUICK).too_few == ("other.png",)


def test_a_model_of_choice_keeps_focal_length_and_principal_point(scene: Scene) -> None:
    (camera,) = start_cameras(scene, "OPENCV").values()
    assert camera == ColmapCamera("OPENCV", WIDTH, HEIGHT, (190.0, 190.0, 80.0, 60.0, 0, 0, 0, 0))
    assert camera.prior_focal_length
    assert start_cameras(scene, "SIMPLE_RADIAL")[5] is scene.cameras[5]
    assert start_cameras(scene, "scene")[5] is scene.cameras[5]
    two = scene.replace(cameras={5: ColmapCamera("PINHOLE", WIDTH, HEIGHT, (180.0, 200.0, 81.0, 59.0))})
    assert start_cameras(two, "SIMPLE_PINHOLE")[5].params == (190.0, 81.0, 59.0)


class OtherCamera:
    """A camera that COLMAP has no model for."""

    width, height = WIDTH, HEIGHT

    def project(self, points: np.ndarray) -> np.ndarray:
        return points[:, :2]

    def ray(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return pixels, pixels


def test_a_camera_that_is_none_of_colmaps_is_refused(scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(CapabilityError, match="camera 5; expected a central camera .*; found OtherCamera"):
        extract_sift(scene.replace(cameras={5: OtherCamera()}), tmp_path / "f.db", QUICK)


def test_a_missing_picture_is_named(scene: Scene, tmp_path: Path) -> None:
    (scene.image_dir / "other.png").unlink()
    with pytest.raises(DataError, match=r"other\.png is missing"):
        extract_sift(scene, tmp_path / "f.db", QUICK)


def test_a_picture_of_another_size_is_named(scene: Scene, tmp_path: Path) -> None:
    Image.new("L", (50, 40)).save(scene.image_dir / "other.png")
    with pytest.raises(DataError, match=r"other\.png has another size .*expected 160x120; found 50x40"):
        extract_sift(scene, tmp_path / "f.db", QUICK)


def test_a_damaged_picture_is_named(scene: Scene, tmp_path: Path) -> None:
    path = scene.image_dir / "other.png"
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(DataError, match=r"other\.png is cut off or damaged"):
        extract_sift(scene, tmp_path / "f.db", QUICK)


def test_a_damaged_mask_is_told_with_its_picture(scene: Scene, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    (masks / "a.png.png").write_bytes(b"no mask")
    with pytest.raises(DataError, match=r"a\.png.*mask"):
        extract_sift(scene.replace(mask_dir=masks), tmp_path / "f.db", QUICK)


def test_a_scene_without_pictures_is_refused(scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="The scene has no pictures"):
        extract_sift(scene.replace(frames=()), tmp_path / "f.db", QUICK)


def test_extraction_tells_how_far_it_is_and_can_be_cancelled(scene: Scene, tmp_path: Path) -> None:
    events: list[ProgressEvent] = []
    extract_sift(scene, tmp_path / "f.db", QUICK, progress=events.append)
    assert list(dict.fromkeys(event.stage for event in events)) == ["features.check", "features"]
    assert (events[-1].done, events[-1].total) == (4, 4)
    done = [event.done for event in events if event.stage == "features"]
    assert done == sorted(done)

    def stop(event: ProgressEvent) -> None:
        if event.stage == "features":
            raise Cancelled("enough")

    with pytest.raises(Cancelled, match="enough"):
        extract_sift(scene, tmp_path / "f.db", QUICK, progress=stop)


def test_overlapping_pictures_match_and_the_other_does_not(scene: Scene, matched: Path) -> None:
    report = match_pairs(matched, scene, choose_pairs(scene, PairSettings()), MatchSettings(), seed=1)
    verified = {tuple(pair) for pair in report.pairs[report.verified].tolist()}
    assert verified == {(0, 1), (0, 2), (1, 2)}
    assert report.groups == ((0, 1, 2), (3,))
    summary = report.to_dict()
    assert summary["pairs_tried"] == 6
    assert summary["pairs_verified"] == 3
    assert summary["unmatched"] == ["other.png"]
    assert summary["group_sizes"] == [3, 1]
    assert [row[:2] for row in summary["verified_pairs"]] == [[0, 1], [0, 2], [1, 2]]
    assert all(row[2] >= row[3] >= 15 for row in summary["verified_pairs"])
    assert summary["inliers"] == sum(row[3] for row in summary["verified_pairs"])


def test_matched_features_are_the_same_place_of_the_texture(scene: Scene, matched: Path) -> None:
    match_pairs(matched, scene, choose_pairs(scene, PairSettings()), MatchSettings(), seed=1)
    with closing(pycolmap.Database.open(matched)) as database:
        inliers = database.read_two_view_geometry(1, 3).inlier_matches
        first, second = database.read_keypoints(1)[inliers[:, 0], :2], database.read_keypoints(3)[inliers[:, 1], :2]
    # The third window lies 24 columns and 12 rows further. SIFT places a feature to a fraction of a pixel; one
    # pixel leaves room for the coarsest.
    off = np.linalg.norm(first - second - [24.0, 12.0], axis=1)
    assert np.mean(off < 1.0) > 0.95


def test_names_with_spaces_are_back_after_matching(scene: Scene, matched: Path) -> None:
    match_pairs(matched, scene, choose_pairs(scene, PairSettings()), MatchSettings())
    assert list(keypoint_counts(matched)) == [frame.name for frame in scene.frames]
    assert [path.name for path in matched.parent.iterdir() if ".tmp" in path.name] == []


def test_the_same_seed_gives_the_same_matches(scene: Scene, matched: Path) -> None:
    query = "SELECT pair_id, rows, data, config, F, E, H FROM two_view_geometries ORDER BY pair_id"
    found = []
    for number in range(3):
        copy = matched.with_name(f"{number}.db")
        copy_database(matched, copy)
        pairs = choose_pairs(scene, PairSettings())
        match_pairs(copy, scene, pairs, MatchSettings(), seed=3)
        found.append(rows(copy, query))
    assert found[0] == found[1] == found[2]


def test_only_the_pairs_that_were_asked_for_are_matched(scene: Scene, matched: Path) -> None:
    pairs = ChosenPairs("by hand", 4, np.array([[0, 1], [2, 3]]))
    report = match_pairs(matched, scene, pairs, MatchSettings())
    assert report.pairs.tolist() == [[0, 1], [2, 3]]
    assert report.verified.tolist() == [True, False]
    assert match_counts(matched)[0].tolist() == [[0, 1], [2, 3]]


def test_guided_matching_finds_no_less(scene: Scene, matched: Path) -> None:
    pairs = ChosenPairs("by hand", 4, np.array([[0, 2]]))
    copy_database(matched, matched.with_name("guided.db"))
    plain = match_pairs(matched, scene, pairs, MatchSettings())
    guided = match_pairs(matched.with_name("guided.db"), scene, pairs, MatchSettings(guided=True))
    assert guided.inliers[0] >= plain.inliers[0]


def test_a_database_with_matches_is_refused(scene: Scene, matched: Path) -> None:
    pairs = choose_pairs(scene, PairSettings())
    match_pairs(matched, scene, pairs, MatchSettings())
    with pytest.raises(StageError, match=r"has matches already; .*copy_database"):
        match_pairs(matched, scene, pairs, MatchSettings(max_ratio=0.7))


def test_a_database_of_another_scene_is_refused(scene: Scene, matched: Path) -> None:
    fewer = scene.replace(frames=scene.frames[:3])
    with pytest.raises(DataError, match="does not belong to this scene; expected its 3 frames"):
        match_pairs(matched, fewer, choose_pairs(fewer, PairSettings()), MatchSettings())


def test_matching_tells_how_far_it_is_and_can_be_cancelled(scene: Scene, matched: Path) -> None:
    copy_database(matched, matched.with_name("again.db"))
    events: list[ProgressEvent] = []
    pairs = choose_pairs(scene, PairSettings())
    match_pairs(matched, scene, pairs, MatchSettings(), progress=events.append)
    assert {event.stage for event in events} == {"match"}
    assert (events[-1].done, events[-1].total) == (6, 6)

    def stop(event: ProgressEvent) -> None:
        raise Cancelled("enough")

    with pytest.raises(Cancelled, match="enough"):
        match_pairs(matched.with_name("again.db"), scene, pairs, MatchSettings(), progress=stop)


def test_a_missing_or_damaged_database_is_told(scene: Scene, tmp_path: Path) -> None:
    pairs = choose_pairs(scene, PairSettings())
    with pytest.raises(DataError, match=r"none\.db is missing; expected a COLMAP database"):
        match_pairs(tmp_path / "none.db", scene, pairs, MatchSettings())
    with pytest.raises(DataError, match=r"none\.db is missing"):
        copy_database(tmp_path / "none.db", tmp_path / "copy.db")
    (tmp_path / "bad.db").write_bytes(b"this is no database" * 100)
    with pytest.raises(DataError, match=r"Cannot read .*bad\.db"):
        match_pairs(tmp_path / "bad.db", scene, pairs, MatchSettings())


def test_no_setting_names_a_feature_that_ends_the_process() -> None:
    # ALIKED and LightGlue types abort where COLMAP was built without their runtime.
    for settings in (SiftSettings, MatchSettings, PairSettings):
        assert not any(
            "aliked" in row.allowed.lower() or "lightglue" in row.allowed.lower() for row in settings.table()
        )


def test_a_copy_is_not_spoilt_by_the_logs_of_an_older_one(matched: Path) -> None:
    target = matched.with_name("target.db")
    for ending in ("", "-wal", "-shm"):
        target.with_name(target.name + ending).write_bytes(b"left over from a killed run")
    copy_database(matched, target)
    assert keypoint_counts(target) == keypoint_counts(matched)
    assert [path.name for path in matched.parent.glob("target.db*")] == ["target.db"]
