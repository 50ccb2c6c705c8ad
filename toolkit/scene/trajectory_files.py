"""Trajectories as text files: TUM RGB-D, KITTI odometry and EuRoC (ASL).

The files hold ``world_from_cam`` (the camera's place and attitude in the world); it becomes ``cam_from_world`` here
and nowhere else. EuRoC's truth is that of the vehicle's body, which is then what "cam" means. Formats:
https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats, KITTI's ``devkit_odometry/readme.txt``, and Burri et
al., "The EuRoC micro aerial vehicle datasets", 2016.

Numbers are written with the fewest digits that read back as the same double; reading and writing turn a motion
round, which costs about 1e-15 of its size. Blank lines and comments (``#``) are skipped. A last line of numbers
without a line break is refused as cut off.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from decimal import Decimal
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, SettingsError
from toolkit.files import write_text
from toolkit.geometry.rigid import RigidTransform, rotation_from_quaternion
from toolkit.scene.pose_text import Row, check_quaternions, nearest_rotations, number_rows
from toolkit.scene.timed_poses import TimedPoses, associate

__all__ = [
    "TimedPoses",
    "associate",
    "read_euroc",
    "read_kitti",
    "read_tum",
    "write_euroc",
    "write_kitti",
    "write_tum",
]

Array = NDArray[np.float64]

_TUM = "a TUM trajectory: lines 'time tx ty tz qx qy qz qw'"
_KITTI = "a KITTI trajectory: lines of 3x4 numbers, row by row"
_TIMES = "a KITTI times file: one time in seconds a line"
_EUROC = "a EuRoC trajectory: 'ns,px,py,pz,qw,qx,qy,qz[,...]' or 'ns tx ty tz qx qy qz qw'"
_EUROC_HEADER = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
#: Poses alone, with velocity, and with velocity and the biases of gyroscope and accelerometer.
_EUROC_WIDTHS = (8, 11, 17)
#: Thirty thousand years: beyond it, "seconds" are something else.
_LATEST = 1e12


# ---------------------------------------------------------------------------------------------------------- TUM


def read_tum(path: Path) -> TimedPoses:
    """Read a TUM trajectory: ``time tx ty tz qx qy qz qw`` a line, in seconds and the scene's unit.

    Raises
    ------
    DataError
        Where the file is missing, damaged or cut off, a quaternion's length is not 1 within 1e-3, times do not
        increase, or are too large for seconds; the message names the line.
    """
    rows = number_rows(path, _TUM, (8,))
    for row in rows:
        if abs(row.values[0]) > _LATEST:
            raise DataError(
                f"{path}, line {row.line} has an impossible time",
                expected="seconds",
                found=row.words[0][:40],
                todo="Nanoseconds are EuRoC's format",
            )
    values = np.array([row.values for row in rows])
    return _timed(values[:, 0], _from_quaternions(values[:, 1:4], values[:, [7, 4, 5, 6]], rows, path), rows, path)


def write_tum(poses: TimedPoses, path: Path) -> None:
    """Write a TUM trajectory in one step.

    Raises
    ------
    RunError
        When the disk is full or the folder may not be written.
    """
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for time, pose in zip(poses.times.tolist(), poses.poses, strict=True):
        inverse = pose.inverse()
        w, x, y, z = inverse.quaternion.tolist()
        lines.append(_line((time, *inverse.translation.tolist(), x, y, z, w)))
    _write(path, lines)


# -------------------------------------------------------------------------------------------------------- KITTI


def read_kitti(path: Path, times_path: Path | None = None, frames_per_second: float = 10.0) -> TimedPoses:
    """Read a KITTI trajectory: the 3x4 matrix ``world_from_cam`` a line, row by row.

    Parameters
    ----------
    path:
        Of the poses.
    times_path:
        A file with a time in seconds a line, one for each pose; by default the frame rate gives the times.
    frames_per_second:
        Frame ``i`` was taken at ``i / frames_per_second`` seconds. KITTI's cameras take ten a second.

    Raises
    ------
    DataError
        Where a file is missing, damaged or cut off, a rotation's rows are not orthonormal within 1e-3 (what is
        nearer is taken to the nearest rotation: the files have six digits), or the times do not increase or fit
        to the poses; the message names the line.
    SettingsError
        Where the frame rate is not positive.
    """
    if not (math.isfinite(frames_per_second) and frames_per_second > 0):
        raise SettingsError("Impossible frame rate", expected="a positive number", found=str(frames_per_second))
    rows = number_rows(path, _KITTI, (12,))
    matrices = np.array([row.values for row in rows]).reshape(-1, 3, 4)
    rotations = nearest_rotations(matrices[:, :, :3], lambda i: f"{path}, line {rows[i].line}")
    poses = _inverted(rotations, matrices[:, :, 3])
    if times_path is None:
        return TimedPoses(np.arange(len(poses)) / frames_per_second, poses)
    time_rows = number_rows(times_path, _TIMES, (1,))
    if len(time_rows) != len(poses):
        raise DataError(
            f"{times_path} does not fit to {path.name}",
            expected=f"{len(poses)} times, one for each pose",
            found=str(len(time_rows)),
        )
    return _timed(np.array([row.values[0] for row in time_rows]), poses, time_rows, times_path)


def write_kitti(poses: TimedPoses, path: Path, times_path: Path | None = None) -> None:
    """Write a KITTI trajectory, and its times where ``times_path`` names a file for them, each in one step.

    Raises
    ------
    RunError
        When the disk is full or the folder may not be written.
    """
    _write(path, (_line(pose.inverse().matrix[:3].ravel().tolist()) for pose in poses.poses))
    if times_path is not None:
        _write(times_path, (_line([time]) for time in poses.times.tolist()))


# -------------------------------------------------------------------------------------------------------- EuRoC


def read_euroc(path: Path) -> TimedPoses:
    """Read a EuRoC trajectory: times in whole nanoseconds, with commas or without.

    With commas it is the data set's ``state_groundtruth_estimate0/data.csv``, position and quaternion ``wxyz``;
    velocity and biases may follow and are not kept. Without commas it is what ORB-SLAM3's ``save_trajectory_euroc``
    writes, position and quaternion ``xyzw``.

    Times become seconds as doubles, whose steps are 0.24 microseconds for times since 1970.

    Raises
    ------
    DataError
        Where the file is missing, damaged or cut off, lines with and without commas are mixed, a time is not whole,
        a quaternion's length is not 1 within 1e-3, or times do not increase; the message names the line.
    """
    rows = number_rows(path, _EUROC, _EUROC_WIDTHS, comma=True)
    scalar_first = _with_commas(path, rows)
    times = np.array([_seconds(row, path) for row in rows])
    values = np.array([row.values for row in rows])
    order = [4, 5, 6, 7] if scalar_first else [7, 4, 5, 6]
    return _timed(times, _from_quaternions(values[:, 1:4], values[:, order], rows, path), rows, path)


def write_euroc(poses: TimedPoses, path: Path) -> None:
    """Write a EuRoC trajectory with commas in one step: whole nanoseconds, position and quaternion ``wxyz``.

    Raises
    ------
    DataError
        Where two times are the same nanosecond.
    RunError
        When the disk is full or the folder may not be written.
    """
    stamps = [round(Fraction(time) * 10**9) for time in poses.times.tolist()]
    for before, after in pairwise(stamps):
        if after <= before:
            raise DataError(
                f"Cannot write {path}: two poses have the same time",
                expected="times at least a nanosecond apart",
                found=f"{before} ns twice",
            )
    lines = [_EUROC_HEADER]
    for stamp, pose in zip(stamps, poses.poses, strict=True):
        inverse = pose.inverse()
        lines.append(f"{stamp}," + _line([*inverse.translation.tolist(), *inverse.quaternion.tolist()], ","))
    _write(path, lines)


def _with_commas(path: Path, rows: Sequence[Row]) -> bool:
    """Return whether the lines have commas. Raises DataError where only some do, or numbers follow without them."""
    for row in rows:
        if row.commas != rows[0].commas or (not row.commas and len(row.words) != _EUROC_WIDTHS[0]):
            raise DataError(
                f"{path}, line {row.line} is of another format",
                expected=_EUROC,
                found=f"{len(row.words)} numbers with{'' if row.commas else 'out'} commas",
            )
    return rows[0].commas


def _seconds(row: Row, path: Path) -> float:
    """Return the first number of a line, whole nanoseconds, as the nearest double of seconds."""
    try:
        # Through a decimal number: the nanoseconds of our days have more digits than a double.
        stamp = Decimal(row.words[0])
        if abs(row.values[0]) < _LATEST * 1e9 and stamp == stamp.to_integral_value():
            return float(stamp.scaleb(-9))
    except ArithmeticError:  # an exponent of its own kind
        pass
    raise DataError(
        f"{path}, line {row.line} has an impossible time",
        expected="whole nanoseconds",
        found=row.words[0][:40],
        todo="Seconds are TUM's format",
    )


# ------------------------------------------------------------------------------------------------------- common


def _timed(times: Array, poses: tuple[RigidTransform, ...], rows: Sequence[Row], path: Path) -> TimedPoses:
    for before, after in pairwise(range(len(rows))):
        if not times[after] > times[before]:
            raise DataError(
                f"{path}, line {rows[after].line} is not later than the line before",
                expected="increasing times",
                found=f"{rows[after].words[0][:40]} after {rows[before].words[0][:40]}",
            )
    return TimedPoses(times, poses)


def _from_quaternions(positions: Array, wxyz: Array, rows: Sequence[Row], path: Path) -> tuple[RigidTransform, ...]:
    check_quaternions(wxyz, lambda i: f"{path}, line {rows[i].line}")
    return _inverted(rotation_from_quaternion(wxyz), positions)


def _inverted(rotations: Array, positions: Array) -> tuple[RigidTransform, ...]:
    # Numbers too large to turn round become infinite, which TimedPoses refuses.
    with np.errstate(over="ignore", invalid="ignore"):
        pairs = zip(rotations, positions, strict=True)
        return tuple(RigidTransform(rotation, position).inverse() for rotation, position in pairs)


def _line(numbers: Iterable[float], separator: str = " ") -> str:
    return separator.join(map(repr, numbers))


def _write(path: Path, lines: Iterable[str]) -> None:
    write_text(path, "\n".join(lines) + "\n")
