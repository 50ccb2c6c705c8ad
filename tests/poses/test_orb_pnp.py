"""The SLAM of our own: it follows a camera that moves, and says so where it cannot."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from textured_court import render, sideways, turning, write_pictures

from toolkit import optional
from toolkit.errors import Cancelled, DataError, MissingDependencyError, SettingsError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.trajectory import pose_errors
from toolkit.poses.slam.orb_pnp import OrbPnp, OrbPnpSettings
from toolkit.poses.slam.result import SlamBackend, SlamResult
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.samples.flights import FlightSettings, flight_camera, flight_poses
from toolkit.samples.town import TownSettings, build_town, render_view

CAMERA = ColmapCamera.pinhole(320, 240, 200.0)
FISHEYE = ColmapCamera("OPENCV_FISHEYE", 320, 240, (170.0, 170.0, 161.0, 119.0, 0.03, -0.01, 0.0, 0.0))
COUNT = 50
BLANK = range(24, 28)

Pictures = list[NDArray[np.uint8]]


def run(
    folder: Path, pictures: Pictures, camera: ColmapCamera = CAMERA, progress: Progress = silent, **settings: float
) -> SlamResult:
    backend: SlamBackend = OrbPnp(OrbPnpSettings(**{"features": 600, **settings}))
    paths = write_pictures(folder, pictures)
    times = 0.1 * np.arange(len(paths))
    return backend.track(paths, times, camera, seed=3, progress=progress, work_dir=folder)


def ate_percent(result: SlamResult, truth: list[RigidTransform]) -> float:
    """Return the error of the only segment as a part of the length of its path."""
    (segment,) = result.segments
    there = [truth[number] for number in segment.frame_numbers]
    steps = np.diff([pose.centre for pose in there], axis=0)
    # The path along the court is straight: orientations have to hold the alignment.
    errors = pose_errors(segment.frames.poses, there, "sim3_poses")
    return float(100 * errors.ate / np.linalg.norm(steps, axis=1).sum())


@pytest.fixture(scope="module")
def walk() -> Pictures:
    return [render(CAMERA, pose) for pose in sideways(COUNT)]


def test_an_orbit_of_the_town_is_followed(tmp_path: Path) -> None:
    settings = FlightSettings(
        frames=24, arc=45.0, height=30.0, radius=40.0, image_width=240, image_height=180, position_jitter=0.05,
        angle_jitter=0.2,
    )  # fmt: skip
    town = build_town(TownSettings(trees=6), np.random.default_rng(1))
    camera, truth = flight_camera(settings), flight_poses(settings, town, np.random.default_rng(1))
    pictures = [render_view(town, camera, pose, samples=1).colour[:, :, ::-1] for pose in truth]
    result = run(tmp_path, pictures, camera)
    assert result.to_dict()["tracked"] >= 22
    # 31 m of path at a distance of 50 m, where a pixel is 26 cm.
    assert ate_percent(result, truth) < 1.0


def test_a_walk_is_followed_to_half_a_percent(tmp_path: Path, walk: Pictures) -> None:
    result = run(tmp_path, walk)
    assert result.backend == "orb-pnp"
    assert result.frame_count == COUNT
    assert result.frame_seconds.shape == (COUNT,)
    (segment,) = result.segments
    assert len(segment.frames) == COUNT
    # A tenth of a pixel at 10 m is 5 mm; sideways motion and turning are told apart a few times worse. Of 6 m.
    assert ate_percent(result, sideways(COUNT)) < 0.5
    np.testing.assert_allclose(segment.frames.times, 0.1 * segment.frame_numbers)
    # Keyframes are frames, with the same poses.
    assert set(segment.keyframe_numbers) <= set(segment.frame_numbers)
    place = int(np.flatnonzero(segment.frame_numbers == segment.keyframe_numbers[-1])[0])
    np.testing.assert_array_equal(segment.keyframes.poses[-1].matrix, segment.frames.poses[place].matrix)


def test_a_fisheye_camera_is_followed_through_its_distortion(tmp_path: Path) -> None:
    truth = sideways(24, 0.2)
    result = run(tmp_path, [render(FISHEYE, pose) for pose in truth], FISHEYE)
    assert result.to_dict()["tracked"] >= 22
    assert ate_percent(result, truth) < 0.5
    # Taken for a pinhole camera the same pictures give another motion, or none.
    wrong = ColmapCamera("PINHOLE", 320, 240, FISHEYE.params[:4])
    bent = run(tmp_path, [render(FISHEYE, pose) for pose in truth], wrong)
    assert len(bent.segments) != 1 or ate_percent(bent, truth) > 0.5


def test_keyframes_follow_the_rule_of_the_paper(tmp_path: Path, walk: Pictures) -> None:
    (segment,) = run(tmp_path, walk, weak_shared=0.0).segments
    gaps = np.diff(segment.keyframe_numbers)[1:]  # the first two keyframes are those of the start
    assert len(gaps) >= 1
    assert (gaps >= 20).all()
    (often,) = run(tmp_path, walk, weak_shared=0.0, keyframe_interval=5).segments
    assert len(often.keyframes) > len(segment.keyframes)


def test_a_camera_that_only_turns_gets_no_map(tmp_path: Path) -> None:
    result = run(tmp_path, [render(CAMERA, pose) for pose in turning(40)])
    assert result.segments == ()
    assert len(result.notes) == 1
    assert result.notes[0].startswith("Frames 0 to 39 have no pose: the camera turned or stood still")
    assert result.to_dict()["tracked"] == 0


def test_after_blank_frames_a_new_segment_begins(tmp_path: Path, walk: Pictures) -> None:
    pictures = [np.full_like(grey, 90) if number in BLANK else grey for number, grey in enumerate(walk)]
    result = run(tmp_path, pictures)
    first, second = result.segments
    assert first.frame_numbers[-1] == BLANK.start - 1
    assert second.frame_numbers[0] >= BLANK.stop
    assert second.frame_numbers[-1] == COUNT - 1
    assert result.notes[0] == "Tracking was lost at frame 24: 0 points of the map found, 20 needed."
    assert result.notes[1].startswith("Frames 24 to ")
    truth = sideways(COUNT)
    for segment in result.segments:
        errors = pose_errors(segment.frames.poses, [truth[k] for k in segment.frame_numbers], "sim3_poses")
        assert errors.ate < 0.02  # metres, of two and a half


def test_nothing_but_blank_frames_says_why(tmp_path: Path) -> None:
    result = run(tmp_path, [np.full((240, 320), 90, np.uint8)] * 3)
    assert result.segments == ()
    assert result.notes == ("Frames 0 to 2 have no pose: 0 features in frame 2, 80 needed.",)


def test_the_same_seed_gives_the_same_poses(tmp_path: Path, walk: Pictures) -> None:
    first, second = (run(tmp_path, walk[:30]) for _ in range(2))
    assert first.notes == second.notes
    for one, other in zip(first.segments, second.segments, strict=True):
        np.testing.assert_array_equal(one.keyframe_numbers, other.keyframe_numbers)
        for a, b in zip(one.frames.poses, other.frames.poses, strict=True):
            np.testing.assert_array_equal(a.matrix, b.matrix)


def test_every_frame_is_told_and_a_raising_listener_stops(tmp_path: Path, walk: Pictures) -> None:
    events: list[ProgressEvent] = []

    def listen(event: ProgressEvent) -> None:
        events.append(event)
        if event.done == 5:
            raise Cancelled("enough")

    with pytest.raises(Cancelled, match="enough"):
        run(tmp_path, walk, progress=listen)
    assert [event.done for event in events] == [0, 1, 2, 3, 4, 5]
    assert {(event.stage, event.total) for event in events} == {("slam.orb-pnp", COUNT)}


@pytest.mark.parametrize(
    ("count", "times", "message"),
    [
        (2, [0.0, 1.0, 2.0], "Pictures and times do not belong together; .*; found 2 pictures and times"),
        (0, [], "expected at least one picture"),
        (3, [0.0, 2.0, 1.0], "must be in order of time; .* found 1.0 after 2.0. Sort the pictures"),
        (2, [0.0, np.nan], "must be in order of time"),
    ],
)
def test_pictures_and_times_must_fit(tmp_path: Path, count: int, times: list[float], message: str) -> None:
    paths = write_pictures(tmp_path, [np.zeros((240, 320), np.uint8)] * count)
    with pytest.raises(DataError, match=message):
        OrbPnp().track(paths, np.array(times), CAMERA, seed=0, progress=silent, work_dir=tmp_path)


def test_pictures_must_fit_the_camera_and_be_there(tmp_path: Path) -> None:
    paths = write_pictures(tmp_path, [np.zeros((24, 32), np.uint8)])

    def track(pictures: list[Path]) -> SlamResult:
        return OrbPnp().track(pictures, np.zeros(1), CAMERA, seed=0, progress=silent, work_dir=tmp_path)

    with pytest.raises(DataError, match=r"0000\.png does not fit the camera; expected 320x240 pixels; found 32x24"):
        track(paths)
    with pytest.raises(DataError, match="missing"):
        track([tmp_path / "none.png"])


def test_without_opencv_the_cure_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = write_pictures(tmp_path, [np.zeros((240, 320), np.uint8)])
    fail: Callable[[str], None] = _no_module
    monkeypatch.setattr(optional.importlib, "import_module", fail)
    with pytest.raises(MissingDependencyError, match=r"'cv2' cannot be imported.*sightline-toolkit\[video\]"):
        OrbPnp().track(paths, np.zeros(1), CAMERA, seed=0, progress=silent, work_dir=tmp_path)


def _no_module(name: str) -> None:
    raise ImportError(name)


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(SettingsError, match="min_points"):
        OrbPnpSettings(min_points=2)
