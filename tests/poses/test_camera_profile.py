"""Intrinsics kept in a file: what comes back, for which pictures they serve, and when there are none to keep."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from roof_pictures import roof_scene
from scipy import ndimage

from toolkit.errors import Cancelled, DataError, SettingsError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.poses.calibrate import CalibrationSettings, calibrate, calibrate_folder
from toolkit.poses.camera_profile import (
    CameraProfile,
    find_profile,
    read_profile,
    with_fixed_cameras,
    with_profile,
    write_profile,
)
from toolkit.poses.pipeline import SfmPipelineSettings
from toolkit.progress import ProgressEvent
from toolkit.scene import Frame, Scene

PROFILE = CameraProfile(
    name="DJI FC220",
    model="SIMPLE_RADIAL",
    width=1920,
    height=1080,
    params=(1500.5, 960.25, 540.0, -0.0125),
    focal_sigma=0.0005,
    reprojection_error=0.4,
    photos=30,
    source="roof",
    created="2026-06-01T10:00:00+00:00",
    seconds=61.5,
)


def scene_of(*cameras: ColmapCamera) -> Scene:
    numbered = dict(enumerate(cameras, start=1))
    return Scene(Path(), numbered, tuple(Frame(f"{number}.jpg", number) for number in numbered))


def test_a_profile_comes_back_as_it_was_written(tmp_path: Path) -> None:
    write_profile(PROFILE, tmp_path / "a.camera.json")
    assert read_profile(tmp_path / "a.camera.json") == PROFILE


def changed(path: Path, **values: Any) -> Path:
    write_profile(PROFILE, path)
    record = {**json.loads(path.read_text()), **values}
    path.write_text(json.dumps({key: value for key, value in record.items() if value is not ...}))
    return path


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"format": "sightline-scene"}, "expected a camera profile.*found format 'sightline-scene'.*calibrate"),
        ({"version": 2}, "version 1; found format 'sightline-camera', version 2"),
        ({"params": ...}, "Cannot read 'params' in .*expected list; found None"),
        ({"params": [1500.0, 960.0, 540.0]}, "SIMPLE_RADIAL"),
        ({"params": [1500.0, 960.0, "x", 0.0]}, "Cannot read the params of .*finite number; found 'x'"),
        ({"params": [-1500.0, 960.0, 540.0, 0.0]}, "focal length"),
        ({"model": "NOTHING"}, "NOTHING"),
        ({"width": 0}, "pixels"),
        ({"photos": True}, "Cannot read 'photos'.*expected int; found True"),
        ({"photos": 0}, "photos of camera profile 'DJI FC220' is out of range; expected a whole number from 1"),
        ({"focal_sigma": -0.1}, "focal_sigma of camera profile 'DJI FC220' is out of range"),
        ({"name": " "}, "has no name"),
        ({"created": "yesterday"}, "created in .* is no date; found 'yesterday'"),
    ],
)
def test_a_damaged_profile_is_told_with_file_and_key(tmp_path: Path, values: dict[str, Any], message: str) -> None:
    path = changed(tmp_path / "a.camera.json", **values)
    with pytest.raises(DataError, match=message) as told:
        read_profile(path)
    assert str(path) in str(told.value)


def test_what_is_no_json_and_what_is_missing_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"format": "sight')
    with pytest.raises(DataError, match=r"Cannot read .*a\.json.*expected a JSON file"):
        read_profile(tmp_path / "a.json")
    with pytest.raises(DataError, match=r"b\.json is missing"):
        read_profile(tmp_path / "b.json")


def test_cameras_of_the_same_aspect_ratio_are_scaled() -> None:
    half, odd = (ColmapCamera.pinhole(*size, 500.0) for size in ((960, 540), (1366, 768)))
    made = with_profile(scene_of(half, odd), PROFILE)
    assert made.cameras[1] == ColmapCamera("SIMPLE_RADIAL", 960, 540, (750.25, 480.125, 270.0, -0.0125))
    # 1366 x 768 is 16:9 to the rounding of a pixel.
    assert made.cameras[2] == PROFILE.camera.scaled(1366, 768)
    assert all(camera.prior_focal_length for camera in made.cameras.values())


def test_pictures_of_another_format_or_lens_are_refused() -> None:
    with pytest.raises(
        DataError,
        match=r"'DJI FC220' does not fit pictures of 1600 x 1200 px; expected the aspect ratio of 1920 x 1080 px; "
        r"found 1\.3333 instead of 1\.7778\. Calibrate with pictures of this format",
    ):
        with_profile(scene_of(ColmapCamera.pinhole(1600, 1200, 900.0)), PROFILE)
    zoomed = dataclasses.replace(ColmapCamera.pinhole(1920, 1080, 3000.0), prior_focal_length=True)
    with pytest.raises(DataError, match=r"another lens or zoom.*near 3000 px.*found 15\d\d px"):
        with_profile(scene_of(zoomed), PROFILE)
    # A focal length that was only guessed says nothing.
    with_profile(scene_of(dataclasses.replace(zoomed, prior_focal_length=False)), PROFILE)


def test_a_profile_is_found_by_camera_and_format(tmp_path: Path) -> None:
    newer = dataclasses.replace(PROFILE, created="2026-07-01T10:00:00+00:00", params=(1501.0, 960.0, 540.0, 0.0))
    small = CameraProfile(
        **{**dataclasses.asdict(PROFILE), "width": 640, "height": 360, "params": (500, 320, 180, 0)}
    )
    square = dataclasses.replace(PROFILE, width=1080)
    other = dataclasses.replace(PROFILE, name="Other")
    for number, profile in enumerate((newer, PROFILE, small, square, other)):
        write_profile(profile, tmp_path / f"{number}.camera.json")
    (tmp_path / "notes.json").write_text("[]")  # no profile by its name: none of our business
    assert find_profile(tmp_path, "dji fc220", 1920, 1080) == newer
    assert find_profile(tmp_path, "DJI FC220", 600, 338).width == 640
    assert find_profile(tmp_path, "DJI FC220", 1080, 1080) == square
    with pytest.raises(
        DataError, match=r"of camera 'DJI FC220' with pictures of 400 x 300.*found 'DJI FC220' 1920 x 1080"
    ):
        find_profile(tmp_path, "DJI FC220", 400, 300)
    (tmp_path / "bad.camera.json").write_text("{}")
    with pytest.raises(DataError, match=r"Cannot read 'format' in .*bad\.camera\.json"):
        find_profile(tmp_path, "DJI FC220", 1920, 1080)
    with pytest.raises(DataError, match="nowhere is missing; expected a folder with camera profiles"):
        find_profile(tmp_path / "nowhere", "DJI FC220", 1920, 1080)


def test_known_cameras_are_not_refined() -> None:
    fixed = with_fixed_cameras(SfmPipelineSettings())
    assert SfmPipelineSettings().differences(fixed) == {
        f"sfm.{name}": (True, False) for name in ("refine_focal", "refine_distortion", "refine_principal_point")
    }


# ------------------------------------------------------------------------------------------------------ calibration

QUICK = CalibrationSettings(camera_name="mine").replace({"sift.max_features": 1500})


def test_intrinsics_are_found_from_pictures_whatever_the_scene_says(tmp_path: Path) -> None:
    true = ColmapCamera("SIMPLE_RADIAL", 240, 180, (225.0, 120.0, 90.0, -0.08))
    wrong = ColmapCamera("SIMPLE_RADIAL", 240, 180, (120.0, 100.0, 80.0, 0.3))
    scene = roof_scene(tmp_path / "images", true, 8).replace(cameras={1: wrong})
    events: list[ProgressEvent] = []
    found = calibrate(scene, QUICK, progress=events.append, work_dir=tmp_path / "work", source="roof")
    assert (found.name, found.model, found.width, found.height, found.photos) == (
        "mine",
        "SIMPLE_RADIAL",
        240,
        180,
        8,
    )
    # The formal standard deviation is about 0.2 %.
    assert found.params[0] == pytest.approx(225.0, rel=0.01)
    assert found.params[3] == pytest.approx(-0.08, abs=0.015)
    assert 0.0 < found.focal_sigma < 0.005
    assert 0.1 < found.reprojection_error < 1.0
    assert found.source == "roof"
    assert found.seconds > 0
    assert {"features", "match", "sfm"} <= {event.stage for event in events}


def level_block(folder: Path) -> Scene:
    """Write pictures of a flat ground from one height, looking straight down: windows of one large picture."""
    noise = np.random.default_rng(0).normal(size=(500, 600))
    ground = sum(size * ndimage.gaussian_filter(noise, size) for size in (1.0, 2.0, 4.0))
    grey = np.clip(128 + 55 * ground / np.std(ground), 0, 255).astype(np.uint8)
    folder.mkdir()
    frames = []
    for number, (row, column) in enumerate((r, c) for r in (20, 110, 200) for c in (20, 110, 200)):
        Image.fromarray(grey[row : row + 180, column : column + 240]).save(folder / f"{number}.png")
        frames.append(Frame(f"{number}.png", 1))
    return Scene(folder, {1: ColmapCamera.pinhole(240, 180, 250.0)}, tuple(frames))


def test_pictures_that_fit_any_focal_length_are_refused(tmp_path: Path) -> None:
    scene = level_block(tmp_path / "images")
    with pytest.raises(StageError, match=r"do not determine the focal length; expected.*at most 0\.5 %.*oblique"):
        calibrate(scene, QUICK, work_dir=tmp_path / "work")


def test_few_of_many_pictures_are_used_and_neighbours_are_matched(tmp_path: Path) -> None:
    true = ColmapCamera("SIMPLE_RADIAL", 240, 180, (225.0, 120.0, 90.0, 0.0))
    scene = roof_scene(tmp_path / "images", true, 15)
    stop = Cancelled("enough")
    seen: list[ProgressEvent] = []

    def listen(event: ProgressEvent) -> None:
        seen.append(event)
        if event.stage == "match":
            raise stop

    with pytest.raises(Cancelled):
        calibrate(
            scene, QUICK.replace({"max_photos": 5, "exhaustive": 3}), progress=listen, work_dir=tmp_path / "work"
        )
    assert {event.total for event in seen if event.stage == "features"} == {5}


def test_what_cannot_be_calibrated_is_told(tmp_path: Path) -> None:
    scene = level_block(tmp_path / "images")
    work = tmp_path / "work"
    with pytest.raises(DataError, match=r"too few pictures of one camera.*at least 3.*found 2"):
        calibrate(scene.replace(frames=scene.frames[:2]), QUICK, work_dir=work)
    with pytest.raises(DataError, match=r"do not tell make and model.*Give it a name with camera_name"):
        calibrate(scene, QUICK.replace({"camera_name": ""}), work_dir=work)
    with pytest.raises(SettingsError, match=r"'sfm\.refine_focal' does not serve a calibration.*expected true"):
        calibrate(scene, QUICK.replace({"sfm.refine_focal": False}), work_dir=work)
    with pytest.raises(SettingsError, match=r"'sfm\.use_positions'.*wrong height; expected false; found true"):
        calibrate_folder(tmp_path, QUICK.replace({"sfm.use_positions": True}), work_dir=work)
    assert not work.exists()
