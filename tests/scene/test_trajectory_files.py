"""Trajectories written, read back, cut off and damaged; and real ones, as evo reads them."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from toolkit.errors import DataError, RunError, SettingsError
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import pose_text
from toolkit.scene.trajectory_files import (
    TimedPoses,
    associate,
    read_euroc,
    read_kitti,
    read_tum,
    write_euroc,
    write_kitti,
    write_tum,
)

Read = Callable[[Path], TimedPoses]
Write = Callable[[TimedPoses, Path], None]

TUM = "0.5 1 2 3 0 0 0 1\n"
KITTI = "1 0 0 1 0 1 0 2 0 0 1 3\n"
EUROC = "500000000,1,2,3,1,0,0,0\n"
READERS: dict[str, tuple[Read, str]] = {
    "tum": (read_tum, TUM),
    "kitti": (read_kitti, KITTI),
    "euroc": (read_euroc, EUROC),
}
every_reader = pytest.mark.parametrize(("read", "line"), READERS.values(), ids=READERS)


def trajectory(seed: int, start: float = 0.0, count: int | None = None) -> TimedPoses:
    """Return random poses a millisecond and more apart."""
    rng = np.random.default_rng(seed)
    length = count or int(rng.integers(1, 6))
    times = start + np.cumsum(rng.integers(1000, 10**6, length)) / 1e6
    size = 10.0 ** rng.integers(-6, 7)
    return TimedPoses(
        times,
        tuple(RigidTransform(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * size) for _ in times),
    )


def assert_same(found: TimedPoses, expected: TimedPoses, *, times: float = 0.0) -> None:
    np.testing.assert_allclose(found.times, expected.times, rtol=0, atol=times)
    for one, other in zip(found.poses, expected.poses, strict=True):
        np.testing.assert_allclose(one.rotation, other.rotation, rtol=0, atol=1e-12)
        size = max(1.0, float(np.linalg.norm(other.translation)))
        np.testing.assert_allclose(one.translation, other.translation, rtol=0, atol=1e-12 * size)


# --------------------------------------------------------------------------------------------------- round trips

starts = st.sampled_from([0.0, -5.0, 1305031098.6659, 1403636579.7635555])


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), starts)
def test_tum_gives_back_what_was_written(seed: int, start: float) -> None:
    poses = trajectory(seed, start)
    with tempfile.TemporaryDirectory() as place:
        write_tum(poses, Path(place) / "a.txt")
        assert_same(read_tum(Path(place) / "a.txt"), poses)


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), starts)
def test_kitti_gives_back_what_was_written(seed: int, start: float) -> None:
    poses = trajectory(seed, start)
    with tempfile.TemporaryDirectory() as place:
        path, times = Path(place) / "poses.txt", Path(place) / "times.txt"
        write_kitti(poses, path, times)
        assert_same(read_kitti(path, times), poses)
        np.testing.assert_array_equal(read_kitti(path, frames_per_second=4.0).times, np.arange(len(poses)) / 4)


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), starts)
def test_euroc_gives_back_what_was_written(seed: int, start: float) -> None:
    poses = trajectory(seed, start)
    with tempfile.TemporaryDirectory() as place:
        write_euroc(poses, Path(place) / "a.csv")
        # The file holds whole nanoseconds: half of one is lost, where the double has as much.
        assert_same(read_euroc(Path(place) / "a.csv"), poses, times=0.5001e-9)


@pytest.mark.parametrize("start", [1305031098.6659, 1403636579.7635555])
def test_times_of_our_days_survive_euroc_to_the_bit(tmp_path: Path, start: float) -> None:
    poses = trajectory(1, start)
    write_euroc(poses, tmp_path / "a.csv")
    np.testing.assert_array_equal(read_euroc(tmp_path / "a.csv").times, poses.times)


def test_writing_to_a_folder_that_is_a_file_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="Something is in the way while writing"):
        write_tum(trajectory(0), tmp_path / "file" / "a.txt")


def test_what_was_there_stays_where_writing_fails(tmp_path: Path) -> None:
    close = TimedPoses(np.array([0.0, 1e-11]), (RigidTransform.identity(),) * 2)
    (tmp_path / "a.csv").write_text(EUROC)
    with pytest.raises(DataError, match=r"two poses have the same time; .* a nanosecond apart; found 0 ns twice"):
        write_euroc(close, tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text() == EUROC


# --------------------------------------------------------------------------------------------------- conventions

#: The camera at (1, 2, 3), turned by 90 degrees about its z axis: its x axis is world y.
AT_123 = RigidTransform(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([-2.0, 1.0, -3.0]))
HALF = math.sqrt(0.5)


@pytest.mark.parametrize(
    ("read", "text"),
    [
        (read_tum, f"# a comment\n\n0.25 1 2 3 0 0 {HALF} {HALF}\n"),
        (lambda path: read_kitti(path), "0 -1 0 1 1 0 0 2 0 0 1 3\n"),
        (read_euroc, f"#timestamp [ns], ...\r\n250000000,1,2,3,{HALF},0,0,{HALF}\r\n"),
        (read_euroc, f"250000000, 1, 2, 3, {HALF}, 0, 0, {HALF}, 9, 9, 9, 8, 8, 8, 7, 7, 7\n"),
        (read_euroc, f"250000000,1,2,3,{HALF},0,0,{HALF},9,9,9\n"),
        (read_euroc, f"250000000.000000 1 2 3 0 0 {HALF} {HALF}\n"),
        (read_tum, f"\ufeff 0.25\t1 2   3 0 0 {HALF} {HALF}  \n#end without line break"),
    ],
)
def test_every_format_holds_the_cameras_place_in_the_world(tmp_path: Path, read: Read, text: str) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(text.encode())
    found = read(path)
    assert found.times.tolist() == ([0.0] if "-1" in text else [0.25])
    np.testing.assert_allclose(found.poses[0].centre, [1, 2, 3], atol=1e-15)
    np.testing.assert_allclose(found.poses[0].matrix, AT_123.matrix, atol=1e-15)


def test_few_digits_are_taken_to_the_nearest_rotation(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("0.866 -0.5 0 1 0.5 0.866 0 2 0 0 1 3\n")
    rotation = read_kitti(tmp_path / "a.txt").poses[0].rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(rotation, Rotation.from_euler("z", -30, degrees=True).as_matrix(), atol=1e-4)


# -------------------------------------------------------------------------------------------------------- errors


@every_reader
def test_cut_off_at_any_byte_is_an_error_or_a_whole_shorter_file(tmp_path: Path, read: Read, line: str) -> None:
    write: dict[str, Write] = {TUM: write_tum, KITTI: write_kitti, EUROC: write_euroc}
    path, cut = tmp_path / "whole.txt", tmp_path / "cut.txt"
    poses = trajectory(3, count=3)
    write[line](poses, path)
    text = path.read_bytes()
    ends = {end + 1 for end in range(len(text)) if text[end : end + 1] == b"\n"}
    header = min(ends) if text.startswith(b"#") else 0
    whole = 0
    for length in range(len(text)):
        cut.write_bytes(text[:length])
        if length in ends and length > header:
            found = read(cut)
            whole += 1
            assert len(found) == whole
            np.testing.assert_array_equal(found.poses[-1].matrix, read(path).poses[whole - 1].matrix)
        else:
            with pytest.raises(DataError, match=r"is empty|is cut off"):
                read(cut)
    assert whole == len(poses) - 1


@every_reader
def test_a_last_line_without_line_break_is_refused_because_digits_may_be_missing(
    tmp_path: Path, read: Read, line: str
) -> None:
    (tmp_path / "a.txt").write_text(line.rstrip("\n"))
    with pytest.raises(DataError, match=r"a\.txt, line 1 is cut off; expected a line break .* end its last line"):
        read(tmp_path / "a.txt")


@every_reader
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda line: b"", r"a\.txt is empty; expected a .* trajectory: .*; found no line of numbers"),
        (lambda line: b"# nothing\n\n  \n", r"a\.txt is empty"),
        (
            lambda line: line * 2 + line[:-3] + b"\n",
            r"line 3 has a wrong number of values; expected .* found \d+\.",
        ),
        (lambda line: line.replace(b"3", b"nan"), r"line 1 is not finite; expected finite numbers; found 'nan'"),
        (lambda line: line.replace(b"3", b"-inf"), r"line 1 is not finite; .* found '-inf'"),
        (lambda line: line.replace(b"3", b"1e999"), r"line 1 is not finite; .* found '1e999'"),
        (lambda line: line + b"\n" + line.replace(b"3", b"x"), r"line 3 is no line of numbers; .* found 'x'"),
        (lambda line: line.replace(b"3", b"1_0"), r"line 1 is no line of numbers; .* found '1_0'"),
        (lambda line: line.replace(b"3", "\u0663".encode()), r"line 1 is no line of numbers"),
        (lambda line: line.replace(b"3", b"3\0"), r"line 1 is no line of numbers; .* found '3\\x00'"),
        (lambda line: line + b"\xff\xfe" + line, r"line 2 is no text; expected a .* trajectory"),
        (lambda line: b"\x89PNG\r\n\x1a\n\0\0\0", r"line 1 is no text"),
        (lambda line: line + b"1" * 5000, r"line 2 is too long; expected .* at most 4096 bytes a line"),
        (lambda line: b"#" * 5000 + b"\n" + line, r"line 1 is too long"),
    ],
)
def test_damage_is_named(
    tmp_path: Path, read: Read, line: str, damage: Callable[[bytes], bytes], message: str
) -> None:
    (tmp_path / "a.txt").write_bytes(damage(line.encode()))
    with pytest.raises(DataError, match=message):
        read(tmp_path / "a.txt")


@every_reader
def test_missing_files_and_folders_are_named(tmp_path: Path, read: Read, line: str) -> None:
    with pytest.raises(DataError, match=r"gone\.txt is missing; expected a .* trajectory"):
        read(tmp_path / "gone.txt")
    with pytest.raises(DataError, match=r"Cannot read .*; expected a .* trajectory"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("read", "text", "message"),
    [
        (read_tum, TUM + TUM, r"line 2 is not later .*; expected increasing times; found 0\.5 after 0\.5"),
        (read_tum, TUM + "\n0.4" + TUM[3:], r"line 3 is not later than the line before; .* found 0\.4 after 0\.5"),
        (read_tum, "0 1 2 3 0 0 0 0\n", r"The quaternion in .*line 1 is none; expected length 1 .* length 0"),
        (read_tum, "0 1 2 3 0 0 0 1.002\n", r"found length 1\.002"),
        (read_tum, "0 1 2 3 1e200 0 0 1e200\n", r"found length inf"),
        (read_tum, "500000000000000000 1 2 3 0 0 0 1\n", r"line 1 has an impossible time; .* EuRoC's format"),
        (read_tum, EUROC, r"line 1 is no line of numbers; expected 8 numbers"),
        (read_tum, "0 1.7e308 1.7e308 1.7e308 0.5 0.5 0.5 0.5\n0 1 2 3 0 0 0 1\n", "line 2 is not later"),
        (read_tum, f"0 1.7e308 1.7e308 0 0 0 {math.sin(0.4)} {math.cos(0.4)}\n", "Pose 0 .* is no rigid motion"),
        (read_kitti, "1 0 0 1 0 1 0 2 0 0 1.01 3\n", r"rotation in .*line 1 is none; expected orthonormal rows"),
        (read_kitti, KITTI + "1 0 0 1 0 1 0 2 0 0 -1 3\n", r"rotation in .*line 2 is none; .* found a mirror"),
        (read_kitti, "1e200 0 0 1 0 1 0 2 0 0 1 3\n", r"found rows off by inf"),
        (read_kitti, TUM, r"line 1 has a wrong number of values; expected 12 numbers; found 8\."),
        (read_euroc, EUROC + EUROC, r"line 2 is not later .*; found 500000000 after 500000000"),
        (read_euroc, "1" + EUROC + "100000000,1,2,3,1,0,0,0\n", r"line 2 is not later"),
        (read_euroc, "0.5" + TUM[3:], r"line 1 has an impossible time; expected whole nanoseconds; .* TUM's"),
        (read_euroc, "1e300" + TUM[3:], r"line 1 has an impossible time"),
        (read_euroc, "1e-99999999999999999999" + TUM[3:], r"line 1 has an impossible time"),
        (
            read_euroc,
            EUROC + "600000000 1 2 3 0 0 0 1\n",
            r"line 2 is of another format; .* 8 numbers without commas",
        ),
        (read_euroc, "1 2 3 4 5 6 7 8 9 10 11\n", r"line 1 is of another format; .* 11 numbers without commas"),
        (
            read_euroc,
            "1,1,2,3,1,0,0,\n",
            r"line 1 is no line of numbers; expected 8 or 11 or 17 numbers .* found ''",
        ),
        (read_euroc, "1,1,2,3,1,0,0,0,9\n", r"line 1 has a wrong number of values; .* found 9\."),
        (
            read_euroc,
            "1,1,2,3,1,0,0,0\n2,1,2,3,1,0,0,0,9,9,9\n",
            r"line 2 has .* expected 8 numbers as in the lines",
        ),
        (read_euroc, "1,1,2,3,1,1,0,0\n", r"The quaternion in .*line 1 is none"),
    ],
)
def test_impossible_values_are_named(tmp_path: Path, read: Read, text: str, message: str) -> None:
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(DataError, match=message):
        read(tmp_path / "a.txt")


def test_times_of_kitti_must_fit_and_increase(tmp_path: Path) -> None:
    path, times = tmp_path / "poses.txt", tmp_path / "times.txt"
    path.write_text(KITTI * 3)
    for text, message in (
        ("0\n1\n", r"times\.txt does not fit to poses\.txt; expected 3 times, one for each pose; found 2\."),
        ("0\n1\n1\n", r"times\.txt, line 3 is not later than the line before; .* found 1 after 1"),
        ("0\n1 2\n3\n", r"times\.txt, line 2 has a wrong number of values; expected 1 numbers; found 2\."),
    ):
        times.write_text(text)
        with pytest.raises(DataError, match=message):
            read_kitti(path, times)
    with pytest.raises(DataError, match=r"gone is missing; expected a KITTI times file"):
        read_kitti(path, tmp_path / "gone")
    for rate in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(SettingsError, match="Impossible frame rate; expected a positive number"):
            read_kitti(path, frames_per_second=rate)


@settings(max_examples=150)
@given(st.sampled_from(sorted(READERS)), st.binary(max_size=60), st.integers(0, 80))
def test_junk_is_an_error_or_a_trajectory_and_nothing_else(name: str, junk: bytes, place: int) -> None:
    read, line = READERS[name]
    text = line.encode() * 2
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        path.write_bytes(text[:place] + junk + text[place:])
        try:
            message = f"{path}: {len(read(path))} poses"
        except DataError as error:
            message = str(error)
        # Numbers too large to be turned round are found out after the last line.
        assert str(path) in message or "of a trajectory is no rigid motion" in message


def test_a_trajectory_that_contradicts_itself_is_refused() -> None:
    one = RigidTransform.identity()
    for times, poses, message in (
        ([], (), r"at least one pose, and a time for each; found 0 poses"),
        ([0.0], (one, one), r"found 2 poses and times \(1,\)"),
        ([1.0, 1.0], (one, one), r"do not increase; .* found 1\.0 after 1\.0"),
        ([math.nan], (one,), "do not increase"),
        ([0.0, math.inf], (one, one), "do not increase; expected finite seconds"),
        ([0.0], (RigidTransform(2 * np.eye(3), np.zeros(3)),), "Pose 0 of a trajectory is no rigid motion"),
        ([0.0], (RigidTransform(-np.eye(3), np.zeros(3)),), "Pose 0 of a trajectory is no rigid motion"),
        ([0.0, 1.0], (one, RigidTransform(np.eye(3), np.full(3, np.nan))), "Pose 1 of a trajectory"),
    ):
        with pytest.raises(DataError, match=message):
            TimedPoses(np.array(times), poses)


# --------------------------------------------------------------------------------------------------- association


def slow_association(a: list[float], b: list[float], limit: float) -> list[list[int]]:
    """All pairs, closest first, each time once: the definition."""
    pairs = sorted((abs(x - y), i, j) for i, x in enumerate(a) for j, y in enumerate(b) if abs(x - y) <= limit)
    found: list[list[int]] = []
    for _, i, j in pairs:
        if all(i != one and j != other for one, other in found):
            found.append([i, j])
    return sorted(found)


# Eighths, so that equal differences are equal to the bit.
moments = st.lists(st.integers(0, 60), max_size=15, unique=True).map(
    lambda eighths: [t / 8 for t in sorted(eighths)]
)


@settings(max_examples=200)
@given(moments, moments, st.sampled_from([0.0, 0.125, 0.5, 3.0, math.inf]))
def test_association_takes_the_closest_pair_first(a: list[float], b: list[float], limit: float) -> None:
    found = associate(a, b, limit)
    assert found.dtype == np.int64
    assert found.tolist() == slow_association(a, b, limit)


def test_association_is_quick_where_all_could_belong_to_all() -> None:
    a = np.arange(20000.0)
    found = associate(a, a + 0.25, math.inf)
    np.testing.assert_array_equal(found, np.stack([np.arange(20000)] * 2, axis=1))


def test_association_refuses_what_is_no_row_of_times() -> None:
    for bad in ([1.0, 1.0], [1.0, 0.0], [math.nan], [[0.0]]):
        with pytest.raises(DataError, match="Times cannot be associated; expected finite, increasing seconds"):
            associate([0.0], bad, 1.0)
    for limit in (-1.0, math.nan):
        with pytest.raises(SettingsError, match="Impossible largest difference"):
            associate([0.0], [0.0], limit)


# --------------------------------------------------------------------------------------------------- real files


def evo_reader(name: str) -> Callable[[str], Any]:
    interface = pytest.importorskip("evo.tools.file_interface", reason="evo is the judge")
    reader: Callable[[str], Any] = getattr(interface, name)
    return reader


def assert_as_evo(found: TimedPoses, evo: Any, *, times: bool = True) -> None:
    assert len(found) == len(evo.positions_xyz)
    if times:
        np.testing.assert_array_equal(found.times, evo.timestamps)
    for pose, position, wxyz in zip(found.poses, evo.positions_xyz, evo.orientations_quat_wxyz, strict=True):
        np.testing.assert_allclose(pose.centre, position, rtol=1e-12, atol=1e-12)
        angle = np.abs(pose.inverse().quaternion @ wxyz) / np.linalg.norm(wxyz)
        # Within the digits of the files: evo does not take rotations to the nearest one.
        assert angle > 1 - 1e-6


@pytest.mark.real
def test_real_tum_files_are_read_as_evo_reads_them(real_data: Path) -> None:
    files = [
        *sorted((real_data / "slam_trajectories").glob("freiburg1*.txt")),
        real_data / "video_kitti_03/groundtruth_tum.txt",
    ]
    assert [len(read_tum(path)) for path in files] == [32, 3000, 788, 788, 801]
    for path in files:
        assert_as_evo(read_tum(path), evo_reader("read_tum_trajectory_file")(str(path)))


@pytest.mark.real
def test_real_kitti_files_are_read_as_evo_reads_them(real_data: Path) -> None:
    folder = real_data / "slam_trajectories"
    for name in ("KITTI_00_gt.txt", "KITTI_00_ORB.txt"):
        found = read_kitti(folder / name, folder / "KITTI_00_gt_times.txt")
        assert len(found) == 4541
        np.testing.assert_array_equal(found.times, np.loadtxt(folder / "KITTI_00_gt_times.txt"))
        assert_as_evo(found, evo_reader("read_kitti_poses_file")(str(folder / name)), times=False)


@pytest.mark.real
def test_the_two_versions_of_kitti_03_agree(real_data: Path, tmp_path: Path) -> None:
    folder = real_data / "video_kitti_03"
    tum, kitti = read_tum(folder / "groundtruth_tum.txt"), read_kitti(folder / "groundtruth_poses_kitti.txt")
    np.testing.assert_allclose(tum.times, kitti.times, atol=1e-9)
    for one, other in zip(tum.poses, kitti.poses, strict=True):
        # Six digits after the point in one file, seven in all in the other, at up to a few hundred metres.
        np.testing.assert_allclose(one.centre, other.centre, atol=1e-4)
        np.testing.assert_allclose(one.rotation, other.rotation, atol=5e-6)
    write_tum(kitti, tmp_path / "again.txt")
    assert_same(read_tum(tmp_path / "again.txt"), kitti)


@pytest.mark.real
def test_real_times_associate(real_data: Path) -> None:
    folder = real_data / "slam_trajectories"
    estimate, truth = (
        read_tum(folder / "freiburg1_xyz-rgbdslam.txt"),
        read_tum(folder / "freiburg1_xyz-groundtruth.txt"),
    )
    pairs = associate(estimate.times, truth.times, 0.01)
    # Truth comes a hundred times a second, with gaps; the estimates are so far apart that none takes another's.
    near = np.abs(estimate.times[:, None] - truth.times).min(axis=1) <= 0.01
    np.testing.assert_array_equal(pairs[:, 0], np.flatnonzero(near))
    assert np.abs(estimate.times[pairs[:, 0]] - truth.times[pairs[:, 1]]).max() <= 0.01


def test_evo_reads_what_is_written(tmp_path: Path) -> None:
    poses = trajectory(5, 1403636579.0, count=4)
    write_tum(poses, tmp_path / "tum.txt")
    write_kitti(poses, tmp_path / "kitti.txt")
    write_euroc(poses, tmp_path / "euroc.csv")
    assert_as_evo(poses, evo_reader("read_tum_trajectory_file")(str(tmp_path / "tum.txt")))
    assert_as_evo(poses, evo_reader("read_kitti_poses_file")(str(tmp_path / "kitti.txt")), times=False)
    euroc = evo_reader("read_euroc_csv_trajectory")(str(tmp_path / "euroc.csv"))
    assert_as_evo(read_euroc(tmp_path / "euroc.csv"), euroc, times=False)
    # evo divides a rounded number of nanoseconds.
    np.testing.assert_allclose(euroc.timestamps, poses.times, rtol=0, atol=5e-7)


def test_a_huge_file_without_line_breaks_is_not_taken_into_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_text, "_LONGEST_LINE", 10)
    (tmp_path / "a.txt").write_text(KITTI)
    with pytest.raises(DataError, match=r"line 1 is too long; .* at most 10 bytes a line; found b'1 0 0 1 0 1'"):
        read_kitti(tmp_path / "a.txt")
