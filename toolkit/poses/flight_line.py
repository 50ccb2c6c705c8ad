"""Where the camera looked, from the direction of flight: for photos with a position and no attitude.

Most drones fly their lines nose ahead with the camera fixed below. Wind makes them crab and lean, so such an
attitude is a start for the pictures to refine and says so by its standard deviation. At turns there is none.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.attitude import Attitude, cam_from_enu
from toolkit.scene import Scene

Array = NDArray[np.float64]

#: Standard deviations about the camera's axes in degrees: lean of the drone, and crab angle.
TILT_SIGMA, HEADING_SIGMA = 8.0, 12.0
# Courses before and after a photo that differ by more are a turn.
_TURN = math.radians(35.0)
# A course is taken over at least this many standard deviations of a position, from at most so many photos away.
_BASE_SIGMAS, _REACH = 4.0, 4


@dataclass(frozen=True, slots=True)
class FlightLine:
    """A scene with attitudes from the direction of flight.

    Attributes
    ----------
    scene:
        With these attitudes in its priors.
    along:
        Names of the frames that got one.
    turning:
        Names of frames without attitude that got none, because the course changes there or cannot be told.
    warnings:
        A sentence for each of the two, where there are any.
    """

    scene: Scene
    along: tuple[str, ...]
    turning: tuple[str, ...]
    warnings: tuple[str, ...]


def with_flight_line(scene: Scene, *, pitch: float, every: bool, noise: float) -> FlightLine:
    """Give frames with a position the attitude of a camera that looks along the flight.

    Parameters
    ----------
    scene:
        With positions in metres east, north and up. Its order is that of the flight; times, where all have them, go
        before.
    pitch:
        Degrees of the view above the horizon; -90 looks straight down, with the course up in the picture.
    every:
        Whether attitudes that the gimbal gave are replaced.
    noise:
        Standard deviation of horizontal positions in metres, for photos that do not tell it.
    """
    order = _order(scene)
    positions = np.full((len(scene), 3), np.nan)
    for i, frame in enumerate(scene.frames):
        if frame.prior is not None and frame.prior.position is not None:
            positions[i] = frame.prior.position
    courses = np.full(len(scene), np.nan)
    courses[order] = course_angles(positions[order], _BASE_SIGMAS * noise)
    frames = []
    along: list[str] = []
    turning: list[str] = []
    for frame, course in zip(scene.frames, courses, strict=True):
        prior = frame.prior
        if prior is not None and prior.position is not None and (every or prior.rotation is None):
            rotation = sigma = None
            if math.isfinite(course):
                rotation = cam_from_enu(Attitude(math.degrees(course), pitch))
                sigma = np.radians([TILT_SIGMA, HEADING_SIGMA, HEADING_SIGMA])
            (turning if rotation is None else along).append(frame.name)
            frame = dataclasses.replace(
                frame, prior=dataclasses.replace(prior, rotation=rotation, rotation_sigma=sigma)
            )
        frames.append(frame)
    warnings = []
    if along:
        warnings.append(
            f"{len(along)} of {len(scene)} photos got their attitude from the direction of flight, with the camera "
            f"tilted to {pitch:g} degrees: a start that only the pictures can correct"
        )
    if turning:
        warnings.append(
            f"{len(turning)} of {len(scene)} photos were taken in a turn or beside one, where the direction of "
            "flight does not tell the attitude"
        )
    return FlightLine(scene.replace(frames=tuple(frames)), tuple(along), tuple(turning), tuple(warnings))


def course_angles(positions: Array, least: float) -> Array:
    """Return the course at each position (F, 3) in radians clockwise from north, NaN at turns and where unknown.

    Parameters
    ----------
    positions:
        In order of the flight, NaN where there is none.
    least:
        Metres between two positions that tell a course.
    """
    plane = positions[:, :2]
    before, after = (_legs(plane, least, step) for step in (-1, 1))
    found = np.full(len(plane), np.nan)
    for i in range(len(plane)):
        ways = [leg for leg in (before[i], after[i]) if np.isfinite(leg).all()]
        if len(ways) == 2 and _angle(ways[0], ways[1]) > _TURN:
            # The end of a line goes on as the line came, its start as it goes; a wrong position does neither.
            came = i > 0 and np.isfinite(before[i - 1]).all() and _angle(before[i - 1], ways[0]) < _TURN
            goes = i + 1 < len(plane) and np.isfinite(after[i + 1]).all() and _angle(after[i + 1], ways[1]) < _TURN
            ways = [ways[0]] if came and not goes else [ways[1]] if goes and not came else []
        if ways:
            east, north = np.sum([way / np.linalg.norm(way) for way in ways], axis=0)
            found[i] = math.atan2(east, north)
    return found


def _legs(plane: Array, least: float, step: int) -> Array:
    """Return the way flown (F, 2) from (step -1) or to (step 1) the nearest photo that is far enough, else NaN."""
    legs = np.full(plane.shape, np.nan)
    for i in range(len(plane)):
        for j in range(i + step, i + step * (_REACH + 1), step):
            if not 0 <= j < len(plane):
                break
            way = step * (plane[j] - plane[i])
            if np.linalg.norm(way) >= least:
                legs[i] = way
                break
    return legs


def _angle(a: Array, b: Array) -> float:
    return abs(math.atan2(float(a[0] * b[1] - a[1] * b[0]), float(a @ b)))


def _order(scene: Scene) -> list[int]:
    times = [frame.time for frame in scene.frames]
    known = [time for time in times if time is not None]
    if len(known) < len(times):
        return list(range(len(times)))
    return [int(i) for i in np.argsort(known, kind="stable")]
