"""What a SLAM backend found, written and read again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from toolkit.errors import DataError
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.slam.result import SlamResult, SlamSegment
from toolkit.poses.slam.result_files import frames_file, read_result, write_result
from toolkit.scene.timed_poses import TimedPoses

RNG = np.random.default_rng(0)
TIMES = 0.1 + np.arange(40) / 30.0


def poses(numbers: list[int]) -> TimedPoses:
    turns = Rotation.random(len(numbers), rng=RNG).as_matrix()
    return TimedPoses(TIMES[numbers], tuple(RigidTransform(turn, RNG.normal(size=3)) for turn in turns))


def segment(frames: list[int], keyframes: list[int]) -> SlamSegment:
    # Keyframes may be elsewhere than the same frames: a backend can tell them at another time.
    return SlamSegment(poses(keyframes), np.array(keyframes), poses(frames), np.array(frames))


def made() -> SlamResult:
    parts = segment([2, 3, 4, 7], [2, 7]), segment([20], [20]), segment(list(range(21, 40)), [21, 30, 39])
    return SlamResult("orbslam3", parts, 40, RNG.random(40), 12.5, ("lost at 8", "lost at 21"))


def test_all_segments_are_read_as_they_were_written(tmp_path: Path) -> None:
    result = made()
    write_result(result, tmp_path / "segments")
    again = read_result(tmp_path / "segments")
    assert again.to_dict() == result.to_dict()
    np.testing.assert_array_equal(again.frame_seconds, result.frame_seconds)
    for was, now in zip(result.segments, again.segments, strict=True):
        np.testing.assert_array_equal(now.frame_numbers, was.frame_numbers)
        np.testing.assert_array_equal(now.keyframe_numbers, was.keyframe_numbers)
        for before, after in ((was.frames, now.frames), (was.keyframes, now.keyframes)):
            np.testing.assert_array_equal(after.times, before.times)
            for a, b in zip(before.poses, after.poses, strict=True):
                # Files have the inverse motion: turning it round twice costs a few roundings.
                np.testing.assert_allclose(b.matrix, a.matrix, atol=1e-14)


def test_nothing_tracked_is_read_as_nothing(tmp_path: Path) -> None:
    write_result(SlamResult("orb-pnp", (), 3, np.zeros(3), 1.0, ("too dark",)), tmp_path)
    again = read_result(tmp_path)
    assert (again.segments, again.frame_count, again.notes) == ((), 3, ("too dark",))


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"result\.json is missing"):
        read_result(tmp_path)
    write_result(made(), tmp_path)
    (tmp_path / frames_file(1)).unlink()
    with pytest.raises(DataError, match=r"1\.tum"):
        read_result(tmp_path)
