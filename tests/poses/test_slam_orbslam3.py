"""ORB-SLAM3 in its own process: what it is told, how it fails, what is read back, and a real run."""

from __future__ import annotations

import importlib
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from toolkit.errors import Cancelled, CapabilityError, DataError, MissingDependencyError, StageError
from toolkit.files import read_json, write_json
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.poses.slam import orbslam3
from toolkit.poses.slam.orbslam3 import OrbSlam3, OrbSlam3Settings, orbslam3_yaml, run_child
from toolkit.poses.slam.orbslam3_read import clock, read_segments
from toolkit.poses.slam.points import SlamPointSettings, slam_points
from toolkit.poses.slam.segments import choose_segment, scene_with_segment
from toolkit.poses.slam.vocabulary import VocabularySettings, train_vocabulary
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.samples import SampleSettings, make_sample
from toolkit.scene import Scene
from toolkit.scene.timed_poses import TimedPoses
from toolkit.scene.trajectory_files import write_tum

CAMERA = ColmapCamera.pinhole(64, 48, 50.0)
TIMES = np.arange(5) / 10.0


def yaml_values(text: str) -> dict[str, str]:
    pairs = (line.split(": ", 1) for line in text.splitlines() if ": " in line)
    return {name: value.strip('"') for name, value in pairs}


# ---------------------------------------------------------------------------------------------- what it is told


@pytest.mark.parametrize(
    ("model", "params", "kind", "expected"),
    [
        ("SIMPLE_PINHOLE", (50, 32, 24), "PinHole", {"fy": 50, "k1": 0, "p2": 0}),
        ("RADIAL", (50, 32, 24, 0.1, 0.2), "PinHole", {"fx": 50, "k1": 0.1, "k2": 0.2, "p1": 0}),
        ("OPENCV", (50, 51, 32, 24, 1, 2, 3, 4), "PinHole", {"fy": 51, "k1": 1, "k2": 2, "p1": 3, "p2": 4}),
        ("OPENCV_FISHEYE", (50, 51, 32, 24, 1, 2, 3, 4), "KannalaBrandt8", {"k1": 1, "k2": 2, "k3": 3, "k4": 4}),
        ("SIMPLE_RADIAL_FISHEYE", (50, 32, 24, 0.1), "KannalaBrandt8", {"fy": 50, "k1": 0.1, "k4": 0}),
    ],
)
def test_camera_models_become_those_of_orbslam3(
    model: str, params: tuple[float, ...], kind: str, expected: dict[str, float]
) -> None:
    values = yaml_values(orbslam3_yaml(ColmapCamera(model, 64, 48, params), TIMES, OrbSlam3Settings()))
    assert values["Camera.type"] == kind
    assert {name: float(values[f"Camera1.{name}"]) for name in expected} == expected
    # Its pixel centres are whole numbers, ours lie at a half.
    assert (float(values["Camera1.cx"]), float(values["Camera1.cy"])) == (31.5, 23.5)
    assert (values["Camera.width"], values["Camera.height"], values["Camera.fps"]) == ("64", "48", "10")


def test_other_camera_models_are_refused_with_those_that_can_be_taken() -> None:
    camera = ColmapCamera("FULL_OPENCV", 64, 48, (50, 50, 32, 24, 0, 0, 0, 0, 0, 0, 0, 0))
    with pytest.raises(CapabilityError, match=r"no camera model FULL_OPENCV.*OPENCV_FISHEYE.*Undistort"):
        orbslam3_yaml(camera, TIMES, OrbSlam3Settings())


def test_reals_have_a_point_and_whole_numbers_none() -> None:
    """OpenCV's reader ends the process where the kind of a number is not the one that it expects."""
    values = yaml_values(orbslam3_yaml(CAMERA, TIMES, OrbSlam3Settings(scale_factor=2.0)))
    assert all("." in value for name, value in values.items() if name.startswith(("Camera1.", "Viewer.")))
    assert "." in values["ORBextractor.scaleFactor"]
    assert "." not in values["ORBextractor.nFeatures"] + values["Camera.fps"]


# ----------------------------------------------------------------------------------------------- how it can fail


def fake(tmp_path: Path, code: str, *, time_limit: float = 30.0, progress: Progress = silent) -> None:
    """Run Python code in place of ORB-SLAM3."""
    run_child([sys.executable, "-c", code], tmp_path, frames=5, time_limit=time_limit, progress=progress)


def test_a_crash_is_told_with_its_signal_and_the_last_words(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys, pathlib; "
        f"pathlib.Path({str(tmp_path / 'progress.txt')!r}).write_text('0 OK\\n1 OK\\n2 O'); "
        "print('one\\ntwo', flush=True); os.kill(os.getpid(), signal.SIGSEGV)"
    )
    with pytest.raises(
        StageError, match=r"crashed.*signal 11 after 2 of 5 frames; its last words: one / two.*log\.txt"
    ):
        fake(tmp_path, code)


def test_an_exit_code_is_told(tmp_path: Path) -> None:
    with pytest.raises(StageError, match=r"exit code 3 after 0 of 5 frames; it said nothing"):
        fake(tmp_path, "import sys; sys.exit(3)")


def test_what_the_child_cannot_read_is_told_by_it(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "toolkit.poses.slam.orbslam3_child", str(tmp_path / "job.json")]
    with pytest.raises(StageError, match=r"exit code 1 after 0 of 5 frames.*error: .*job\.json is missing"):
        run_child(command, tmp_path, frames=5, time_limit=60.0, progress=silent)


def test_the_time_limit_ends_it(tmp_path: Path) -> None:
    start = time.monotonic()
    with pytest.raises(StageError, match=r"took too long.*time_limit = 0\.3 s.*0 of 5 frames.*Raise time_limit"):
        fake(tmp_path, "import time; time.sleep(60)", time_limit=0.3)
    assert time.monotonic() - start < 20


def test_cancelling_leaves_no_process(tmp_path: Path) -> None:
    mark = tmp_path / "alive.txt"
    code = f"import time\nwhile True:\n    open({str(mark)!r}, 'a').write('x')\n    time.sleep(0.02)"

    def stop(event: ProgressEvent) -> None:
        if mark.exists():
            raise Cancelled("stop")

    with pytest.raises(Cancelled):
        fake(tmp_path, code, progress=stop)
    size = mark.stat().st_size
    time.sleep(0.2)
    assert mark.stat().st_size == size


def test_progress_counts_frames(tmp_path: Path) -> None:
    events: list[ProgressEvent] = []
    path = str(tmp_path / "progress.txt")
    fake(tmp_path, f"open({path!r}, 'w').write('0 NOT_INITIALIZED\\n1 OK\\n')", progress=events.append)
    assert (events[-1].done, events[-1].total, events[-1].message) == (2, 5, "ok")


def pictures(folder: Path, size: tuple[int, int] = (64, 48)) -> list[Path]:
    paths = [folder / f"{i}.png" for i in range(5)]
    for path in paths:
        Image.new("L", size).save(path)
    return paths


def track(tmp_path: Path, paths: list[Path], times: np.ndarray = TIMES, camera: ColmapCamera = CAMERA) -> None:
    backend = OrbSlam3(tmp_path / "missing.txt", OrbSlam3Settings())
    backend.track(paths, times, camera, seed=0, progress=silent, work_dir=tmp_path)


def test_what_is_wrong_before_the_start_is_told_before_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(orbslam3, "require", lambda name: None)
    paths = pictures(tmp_path)
    with pytest.raises(DataError, match=r"missing\.txt is missing\. Train one"):
        track(tmp_path, paths)
    with pytest.raises(DataError, match=r"not of its camera's size; expected 64x50; found 64x48"):
        track(tmp_path, paths, camera=ColmapCamera.pinhole(64, 50, 50.0))
    with pytest.raises(DataError, match=r"found 5 frames and times \(4,\)"):
        track(tmp_path, paths, TIMES[:4])
    with pytest.raises(DataError, match=r"Frame 2 is not later.*found 0\.1 s after 0\.1 s"):
        track(tmp_path, paths, np.array([0.0, 0.1, 0.1, 0.2, 0.3]))


def test_without_the_package_the_cure_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(f"No module named '{name}'")

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(MissingDependencyError, match=r"'pyorbslam3' cannot be imported.*\[slam\].*GPL"):
        track(tmp_path, pictures(tmp_path))


def test_the_child_is_told_whose_it_is_and_ends_where_that_process_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise Cancelled("stop")

    monkeypatch.setattr(orbslam3, "require", lambda name: None)
    monkeypatch.setattr(orbslam3, "check_vocabulary", lambda path: None)
    monkeypatch.setattr(orbslam3, "run_child", stop)
    with pytest.raises(Cancelled):
        track(tmp_path, pictures(tmp_path))
    job = read_json(tmp_path / "job.json")
    assert job["parent"] == os.getpid()
    # The package takes seconds to load; this process is not the one that started the child.
    fake_package = "class Sensor:\n    MONOCULAR = 0\ndef Slam(*_, **__):\n    return None\n"
    (tmp_path / "pyorbslam3.py").write_text(fake_package, encoding="ascii")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    write_json(tmp_path / "job.json", {**job, "parent": os.getppid()})
    command = [sys.executable, "-m", "toolkit.poses.slam.orbslam3_child", str(tmp_path / "job.json")]
    with pytest.raises(StageError, match=r"exit code 1 after 0 of 5 frames.*the process that wanted this is gone"):
        run_child(command, tmp_path, frames=5, time_limit=60.0, progress=silent)


# ---------------------------------------------------------------------------------------------- what is read back


def pose(i: float) -> RigidTransform:
    angle = 0.1 * i
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return RigidTransform(turn, np.array([i, 0.2 * i, 1.0]))


def write_map(
    folder: Path, number: int, keyframes: list[int], frames: list[int], times: np.ndarray
) -> dict[str, str]:
    """Write a map as ORB-SLAM3 does: all frames in the world of the first keyframe, a repeated line at the end."""
    seconds = clock(times) / 512
    write_tum(TimedPoses(seconds[keyframes], tuple(pose(i) for i in keyframes)), folder / f"keyframes_{number}.txt")
    lines = []
    for i in frames:
        inverse = (pose(i) @ pose(keyframes[0]).inverse()).inverse()
        w, x, y, z = inverse.quaternion
        numbers = " ".join(f"{value:.9f}" for value in (*inverse.translation, x, y, z, w))
        lines.append(f"{1e9 * seconds[i]:.6f} {numbers}\n")
    (folder / f"frames_{number}.txt").write_text("".join([*lines, *lines[-1:]]))
    return {"keyframes": f"keyframes_{number}.txt", "frames": f"frames_{number}.txt"}


def states(text: str) -> list[dict[str, Any]]:
    names = {"n": "NOT_INITIALIZED", "o": "OK", "l": "RECENTLY_LOST"}
    return [{"state": names[letter], "tracked": letter == "o", "seconds": 0.01} for letter in text]


def test_each_map_is_a_segment_and_all_its_poses_are_in_one_world(tmp_path: Path) -> None:
    times = 100.0 + np.arange(12) / 10.0
    found = {
        "frames": states("noooollnoooo"),
        "segments": [
            {"first": 1, "last": 4, **write_map(tmp_path, 0, [0, 2, 4], [1, 2, 3, 4, 5], times)},
            {"first": 8, "last": 11, **write_map(tmp_path, 1, [7, 9], [8, 9, 10, 11], times)},
        ],
        "map_changes": [],
    }
    segments, notes = read_segments(found, tmp_path, times)
    assert [segment.keyframe_numbers.tolist() for segment in segments] == [[0, 2, 4], [7, 9]]
    # Frame 5 was lost: the pose that is in the file is no measurement.
    assert [segment.frame_numbers.tolist() for segment in segments] == [[0, 1, 2, 3, 4], [7, 8, 9, 10, 11]]
    for segment in segments:
        np.testing.assert_array_equal(segment.frames.times, times[segment.frame_numbers])
        for number, found_pose in zip(segment.frame_numbers, segment.frames.poses, strict=True):
            # Nine digits in the file.
            np.testing.assert_allclose(found_pose.matrix, pose(number).matrix, atol=1e-7)
    assert notes == ("tracking was lost at frames 5 to 6",)


def test_a_map_that_was_merged_is_no_segment_of_its_own(tmp_path: Path) -> None:
    found = {
        "frames": states("noooollnoooo"),
        "segments": [
            {"first": 1, "last": 4, **write_map(tmp_path, 0, [0, 2, 4], [1, 2, 3, 4], np.arange(12) / 10.0)},
            {
                "first": 8,
                "last": 11,
                **write_map(tmp_path, 1, [0, 2, 4, 9], [*range(1, 5), 8, 9], np.arange(12) / 10.0),
            },
        ],
        "map_changes": [10],
    }
    segments, notes = read_segments(found, tmp_path, np.arange(12) / 10.0)
    assert [segment.keyframe_numbers.tolist() for segment in segments] == [[0, 2, 4, 9]]
    assert any("was merged with that of frames 0 to 4" in note for note in notes)
    assert any("at frames 10" in note for note in notes)


def test_what_could_not_be_read_is_told(tmp_path: Path) -> None:
    times = np.arange(12) / 10.0
    small = {"first": 8, "last": 11, **write_map(tmp_path, 1, [7, 9], [8, 9], times)}
    (tmp_path / "frames_1.txt").write_text("")
    found = {"frames": states("noooonnnoooo"), "segments": [{"first": 1, "last": 4}, small], "map_changes": []}
    segments, notes = read_segments(found, tmp_path, times)
    assert [segment.frame_numbers.tolist() for segment in segments] == [[7, 9]]
    assert notes[0] == "the map of frames 1 to 4 was gone before it could be read"
    assert "of the map of frames 8 to 11 only keyframes could be read" in notes[1]
    with pytest.raises(StageError, match=r"keyframes_1\.txt belongs to no frame"):
        read_segments(found, tmp_path, times + np.arange(12) * 0.01)


# ------------------------------------------------------------------------------------------------------ a real run


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("video") / "town"
    flight = {
        "frames": 60,
        "arc": 34.0,
        "height": 30.0,
        "radius": 50.0,
        "image_width": 320,
        "image_height": 240,
        "samples": 1,
        "frame_interval": 0.1,
        "position_jitter": 0.02,
        "angle_jitter": 0.05,
    }
    return make_sample(
        folder, SampleSettings().replace({f"flight.{name}": value for name, value in flight.items()}), seed=1
    )


@pytest.mark.slow
def test_a_flight_is_tracked_and_its_points_lie_on_the_town(flight: Scene, tmp_path: Path) -> None:
    pytest.importorskip("pyorbslam3", reason="the real ORB-SLAM3 (GPL) is not installed")
    paths = [flight.image_path(frame) for frame in flight.frames]
    times = np.array([frame.time for frame in flight.frames], dtype=np.float64)
    camera = flight.cameras[1]
    assert isinstance(camera, ColmapCamera)
    train_vocabulary(paths[::7], tmp_path / "words.txt", VocabularySettings(features=500))
    work = tmp_path / "work"
    work.mkdir()
    events: list[ProgressEvent] = []
    # At half the video's own time its threads keep in step, on a busy machine too.
    settings = OrbSlam3Settings(features=1000, time_limit=120.0, pace=0.5)
    backend = OrbSlam3(tmp_path / "words.txt", settings)
    result = backend.track(paths, times, camera, seed=0, progress=events.append, work_dir=work)
    assert events[-1].done == events[-1].total == len(paths)
    assert result.to_dict()["tracked"] > 30
    assert (result.frame_seconds > 0).all()
    posed = scene_with_segment(flight, choose_segment(result))
    assert posed.georeference is None
    assert all(frame.prior is None for frame in posed.frames)
    # Centres on a short arc hardly tell the turn about its chord: orientations take part in the alignment.
    errors = trajectory_errors(posed, flight, "sim3_poses")
    path = np.linalg.norm(np.diff(flight.centres(), axis=0), axis=1).sum()
    # Measured in fifteen runs: 0.2 to 0.5 % of the path, 0.6 degrees; a wrong map is tens of percent off.
    assert errors.ate < 0.02 * path
    assert errors.rot < 2.0
    seen = slam_points(posed, SlamPointSettings(), work_dir=tmp_path)
    assert seen.points is not None
    assert seen.points.tracks is not None
    assert len(seen.points) > 100
    known = {i for i, frame in enumerate(seen.frames) if frame.cam_from_world is not None}
    assert set(seen.points.tracks.frame.tolist()) <= known
    assert seen.frames == posed.frames
