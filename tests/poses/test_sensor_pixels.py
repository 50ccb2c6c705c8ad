"""Sensors against pictures: turned photos, wrong readings, and the gimbal convention on real photos."""

from __future__ import annotations

import dataclasses
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from flight_matches import flight, nadir_block, pose, with_prior

from toolkit.errors import DataError
from toolkit.geometry.attitude import Attitude, cam_from_enu
from toolkit.geometry.rigid import rotation_angle
from toolkit.matching.features import SiftSettings, extract_sift
from toolkit.matching.match import MatchSettings, match_pairs
from toolkit.matching.pairs import PairSettings, choose_pairs
from toolkit.poses.sensor_pixels import PixelCheck, check_pixels
from toolkit.poses.sensors import SensorPoseSettings, sensor_poses
from toolkit.scene import Scene
from toolkit.scene.dataset import open_capture


def check(scene: Scene, database: Path) -> PixelCheck:
    return check_pixels(sensor_poses(scene, SensorPoseSettings()).scene, database)


def test_a_sound_flight_agrees_within_its_noise(tmp_path: Path) -> None:
    scene, _, database = flight(tmp_path, nadir_block())
    found = check(scene, database)
    assert found.turns == {}
    assert found.warnings == ()
    assert len(found.frame_rotation) == len(scene)
    # Two readings with one degree an axis differ by 1.6 * sqrt(2) degrees on average; pictures add little.
    assert np.median([pair.rotation for pair in found.pairs]) < 4.0


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_turned_photos_are_found_and_named(tmp_path: Path, quarters: int) -> None:
    turns = dict.fromkeys((3, 4, 9), quarters)
    scene, _, database = flight(tmp_path, nadir_block(), turns=turns)
    found = check(scene, database)
    assert found.turns == dict.fromkeys(("003.jpg", "004.jpg", "009.jpg"), 90.0 * quarters)
    assert found.anchored
    assert any(
        f"3 of 15 photos are turned by {90 * quarters} degrees against their gimbal angles" in text
        for text in found.warnings
    )
    assert max(found.frame_rotation.values()) < 8.0


def test_positions_tell_when_most_photos_are_turned(tmp_path: Path) -> None:
    scene, _, database = flight(tmp_path, nadir_block(), turns=dict.fromkeys(range(12), 2))
    found = check(scene, database)
    assert len(found.turns) == 12
    assert found.anchored


def test_without_positions_that_differ_the_larger_group_counts_as_upright(tmp_path: Path) -> None:
    hover = [pose((0.0, 0.0, 50.0), Attitude(0.0, pitch)) for pitch in (-90.0, -85.0, -80.0, -75.0, -70.0)]
    scene, _, database = flight(tmp_path, hover, position_noise=0.3, turns={1: 2})
    found = check(scene, database)
    assert found.turns == {"001.jpg": 180.0}
    assert not found.anchored
    assert any("positions do not tell" in text for text in found.warnings)


def test_a_wrong_position_and_wrong_angles_are_told(tmp_path: Path) -> None:
    scene, _, database = flight(tmp_path, nadir_block())
    far, askew = scene.frames[7].prior, scene.frames[11].prior
    assert far is not None
    assert far.position is not None
    assert askew is not None
    scene = with_prior(scene, 7, dataclasses.replace(far, position=far.position + np.array([150.0, 0.0, 0.0])))
    scene = with_prior(scene, 11, dataclasses.replace(askew, rotation=cam_from_enu(Attitude(40.0, -60.0))))
    found = check(scene, database)
    assert found.contradicted == {"007.jpg": "position", "011.jpg": "gimbal angles"}
    assert any("contradict the position of 1 photos: 007.jpg" in text for text in found.warnings)


def test_a_database_of_another_scene_is_refused(tmp_path: Path) -> None:
    scene, _, database = flight(tmp_path, nadir_block())
    other = scene.replace(frames=scene.frames[:4])
    with pytest.raises(DataError, match="does not belong to this scene"):
        check(other, database)


@pytest.mark.real
def test_six_photos_of_brighton_beach_are_turned(real_data: Path, tmp_path: Path) -> None:
    scene = open_capture(real_data / "uav_brighton_beach", check=False).scene
    found = check(scene, matched(scene, tmp_path, 2048))
    names = [f"DJI_{number:04d}.JPG" for number in range(24, 30)]
    assert dict(found.turns) == dict.fromkeys(names, 180.0)
    assert found.anchored


@pytest.mark.real
def test_homographies_from_one_place_agree_with_the_gimbal(real_data: Path, tmp_path: Path) -> None:
    """The drone hovers and turns its camera: H = K R K^-1, with R as the gimbal's angles say."""
    scene = open_capture(real_data / "uav_gimbal_rotation", check=False).scene
    hover = ("DJI_0019.JPG", "DJI_0020.JPG", "DJI_0022.JPG", "DJI_0030.JPG", "DJI_0031.JPG")
    scene = scene.replace(frames=tuple(frame for frame in scene.frames if frame.name in hover))
    database_path = matched(scene, tmp_path, 4096)
    # Of the photos' size; 26 mm of 36 x 24 mm by the diagonal. Homographies alone give 1140 to 1220 px.
    width, height = 1600, 900
    focal = 26.0 / np.hypot(36.0, 24.0) * np.hypot(width, height)
    matrix = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    options = pycolmap.RANSACOptions(max_error=4.0, random_seed=0)
    angles = {}
    with closing(pycolmap.Database.open(database_path)) as database:
        pairs, geometries = database.read_two_view_geometries()
        for pair, geometry in zip(pairs, geometries, strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair)
            matches = geometry.inlier_matches
            if len(matches) < 200:
                continue
            pixels1 = database.read_keypoints(first)[matches[:, 0], :2].astype(np.float64)
            pixels2 = database.read_keypoints(second)[matches[:, 1], :2].astype(np.float64)
            found = pycolmap.estimate_homography_matrix(pixels1, pixels2, options)
            assert found is not None
            turn = np.linalg.inv(matrix) @ found["H"] @ matrix
            left, _, right = np.linalg.svd(turn / np.cbrt(np.linalg.det(turn)))
            one, other = (gimbal_rotation(scene, number - 1) for number in (first, second))
            by_gimbal = other @ one.T
            names = scene.frames[first - 1].name, scene.frames[second - 1].name
            angles[names] = np.degrees(rotation_angle(left @ right @ by_gimbal.T))
    assert len(angles) >= 6
    assert max(angles.values()) < 2.0, angles


def gimbal_rotation(scene: Scene, index: int) -> np.ndarray:
    prior = scene.frames[index].prior
    assert prior is not None
    assert prior.rotation is not None
    return prior.rotation


def matched(scene: Scene, folder: Path, features: int) -> Path:
    path = folder / "matches.db"
    extract_sift(scene, path, SiftSettings(max_features=features))
    match_pairs(path, scene, choose_pairs(scene, PairSettings(method="exhaustive")), MatchSettings())
    return path
