"""Real pictures open as they are."""

from __future__ import annotations

import csv
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from toolkit.geometry.attitude import Attitude
from toolkit.geometry.cameras import ColmapCamera
from toolkit.scene.dataset import Capture, open_capture
from toolkit.scene.exif import read_tags
from toolkit.scene.pictures import area_resize, load_picture

pytestmark = pytest.mark.real


def test_every_folder_with_pictures_opens(real_data: Path) -> None:
    folders = sorted(path.parent for path in real_data.glob("*/images") if path.is_dir())
    assert folders, f"no data set with an images folder in {real_data}"
    for folder in folders:
        capture = open_capture(folder, check=False)
        count = len(list((folder / "images").iterdir()))
        assert len(capture.scene) == count, folder
        assert capture.scene.registered == (), folder
        assert sum(frame.split == "test" for frame in capture.scene.frames) == (count + 7) // 8, folder
        for camera in capture.scene.cameras.values():
            assert isinstance(camera, ColmapCamera)
            # Lenses of these sets see 30 to 100 degrees.
            assert 0.4 < camera.params[0] / max(camera.width, camera.height) < 2, folder


def test_brighton_has_a_position_for_every_photo(real_data: Path) -> None:
    capture = open_capture(real_data / "uav_brighton_beach")
    positions = [frame.prior.position for frame in capture.scene.frames if frame.prior is not None]
    assert len(positions) == len(capture.scene) == 18
    assert capture.warnings == ()
    spread = np.array(positions)
    # Three strips of one flight at one height (the README: about 40 m above take-off, block of some 100 m).
    assert np.abs(spread).max() < 200
    assert np.ptp(spread[:, 2]) < 5
    assert 40 < np.ptp(spread[:, :2], axis=0).max() < 200
    origin = capture.scene.georeference
    assert origin is not None
    # Brighton Beach, Duluth, Minnesota.
    assert (round(origin.latitude, 1), round(origin.longitude, 1)) == (46.8, -92.0)
    assert next(iter(capture.scene.cameras.values())).prior_focal_length


def sift_matches(capture: Capture, first: int, second: int) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (M, 2) and (M, 2) of matched SIFT features of two reference frames."""
    found = []
    for index in (first, second):
        frame = capture.scene.frames[index]
        photo = load_picture(capture.scene.image_path(frame))
        height, width = photo.shape[:2]
        small = area_resize(photo, width // 2, height // 2).mean(axis=2).astype(np.uint8)
        options = pycolmap.FeatureExtractionOptions()
        options.num_threads = 1
        options.sift.max_num_features = 1500
        options.sift.first_octave = 0
        extractor = pycolmap.FeatureExtractor.create(options)
        keypoints, descriptors = extractor.extract(pycolmap.Bitmap.from_array(small))
        found.append((np.array([[2 * k.x, 2 * k.y] for k in keypoints]), descriptors.data.astype(float)))
    (one, left), (other, right) = found
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    close = left @ right.T
    best = close.argmax(axis=1)
    ordered = np.sort(close, axis=1)
    sure = (np.arccos(np.clip(ordered[:, -1], -1, 1)) < 0.8 * np.arccos(np.clip(ordered[:, -2], -1, 1))) & (
        close.argmax(axis=0)[best] == np.arange(len(best))
    )
    return one[sure], other[best[sure]]


@pytest.mark.parametrize("name", ["strecha_fountain_p11", "strecha_herz_jesus_p25"])
def test_strechas_reference_agrees_with_its_pictures(real_data: Path, name: str) -> None:
    capture = open_capture(real_data / name, check=False)
    reference = capture.reference
    assert reference is not None
    assert len(reference.registered) == len(capture.scene)
    one, other = sift_matches(capture, 4, 5)
    assert len(one) > 50
    first, second = reference.frames[4], reference.frames[5]
    assert first.cam_from_world is not None
    assert second.cam_from_world is not None
    # Distance of matches to the epipolar line of the true cameras: a wrong axis, scale or transposition gives
    # tens of pixels; features of half resolution were seen to lie 0.3 to 0.4 pixels off.
    second_from_first = second.cam_from_world @ first.cam_from_world.inverse()
    x, y, z = second_from_first.translation
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ second_from_first.rotation
    rays = [reference.camera_of(frame).ray(pixels)[1] for frame, pixels in ((first, one), (second, other))]
    lines = rays[0] @ essential.T
    camera = reference.camera_of(second)
    assert isinstance(camera, ColmapCamera)
    normalised = rays[1] / rays[1][:, 2:]
    distance = np.abs((lines * normalised).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1) * camera.params[0]
    assert np.median(distance) < 1.0


@pytest.mark.parametrize("name", ["uav_brighton_beach", "uav_gimbal_rotation"])
def test_tags_are_those_of_the_table_beside_the_photos(real_data: Path, name: str) -> None:
    """The table was made by another reader."""
    with (real_data / name / "metadata.csv").open(newline="") as handle:
        rows = list(csv.DictReader(handle))
    assert rows
    for row in rows:
        with Image.open(real_data / name / "images" / row["image"]) as picture:
            tags = read_tags(picture)
        assert tags.doubts == ()
        assert tags.position == pytest.approx((float(row["lat"]), float(row["lon"]), float(row["alt"])), abs=1e-2)
        assert tags.position is not None
        # Seven decimals of a degree.
        assert tags.position[:2] == pytest.approx((float(row["lat"]), float(row["lon"])), abs=1e-7)
        assert tags.relative_altitude == float(row["rel_alt"])
        assert tags.gimbal == Attitude(*(float(row[f"gimbal_{axis}"]) for axis in ("yaw", "pitch", "roll")))
        assert tags.flight is not None
        assert tags.flight.yaw == float(row["flight_yaw"])
        assert tags.time is not None
        assert datetime.fromtimestamp(tags.time, UTC).strftime("%Y:%m:%d %H:%M:%S") == row["datetime"]


def test_every_photo_gives_tags_or_a_doubt(real_data: Path) -> None:
    photos = sorted(path for path in real_data.glob("*/images/*") if path.suffix.lower() in (".jpg", ".jpeg"))
    assert len(photos) > 200
    placed = 0
    for path in photos:
        with Image.open(path) as picture:
            tags = read_tags(picture)
        placed += tags.position is not None
        assert "damaged" not in " ".join(tags.doubts), (path, tags.doubts)
    # Brighton, Sheffield and the gimbal set have GPS.
    assert placed == 18 + 81 + 8
