"""Camera poses straight from what sensors said: GPS position and gimbal attitude, in metres east, north and up."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.flight_line import with_flight_line
from toolkit.scene import Frame, PosePrior, Scene
from toolkit.settings import Choice, Number, Settings

Array = NDArray[np.float64]

# A position is a jump when it is this many typical steps, and this many standard deviations, from its neighbours.
_JUMP_STEPS, _JUMP_SIGMAS = 10.0, 10.0
_FASTEST = 100.0
_STANDING_SHARE = 0.3


class SensorPoseSettings(Settings):
    """How far sensors are trusted."""

    horizontal_sigma = Number(
        1.0,
        bounds=(0.001, 100.0),
        unit="m",
        doc="Standard deviation of GPS east and north, for photos that do not tell it.",
    )
    vertical_sigma = Number(
        1.5,
        bounds=(0.001, 1000.0),
        unit="m",
        doc="Standard deviation of the GPS height, for photos that do not tell it.",
    )
    angle_sigma = Number(
        2.0,
        bounds=(0.01, 90.0),
        unit="degrees",
        doc="Standard deviation of the gimbal's attitude about each axis, for photos that do not tell it.",
    )
    attitude = Choice(
        "gimbal",
        choices=("gimbal", "flight-line", "auto"),
        doc="Where cameras looked: what the gimbal said; along the line of flight, tilted by assumed_pitch; or "
        "that for photos whose gimbal said nothing.",
    )
    assumed_pitch = Number(
        -90.0,
        bounds=(-90.0, 30.0),
        unit="degrees",
        doc="Attitude from the flight line: tilt of the camera above the horizon; -90 looks straight down.",
    )


@dataclass(frozen=True, slots=True)
class SensorPoses:
    """Poses as sensors give them.

    Attributes
    ----------
    scene:
        The scene with a pose for every frame that has a position and an attitude, and complete priors (with
        standard deviations) for these. It has no points.
    no_position, no_attitude:
        Names of frames that lack one and so have no pose.
    warnings:
        What looks odd in the readings, a sentence each.
    from_flight_line:
        Names of frames whose attitude was taken from the direction of flight.
    in_turn:
        Names of those in ``no_attitude`` for which it was to be taken from there, and the flight does not tell it.
    """

    scene: Scene
    no_position: tuple[str, ...]
    no_attitude: tuple[str, ...]
    warnings: tuple[str, ...]
    from_flight_line: tuple[str, ...] = ()
    in_turn: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the counts and warnings, ready for JSON."""
        return {
            "images": len(self.scene),
            "placed": len(self.scene.registered),
            "no_position": list(self.no_position),
            "no_attitude": list(self.no_attitude),
            "warnings": list(self.warnings),
            "from_flight_line": list(self.from_flight_line),
            "in_turn": list(self.in_turn),
        }


def sensor_poses(
    scene: Scene, settings: SensorPoseSettings, *, turns: Mapping[str, float] | None = None
) -> SensorPoses:
    """Place the camera of each frame where its sensors say it was.

    Parameters
    ----------
    scene:
        With priors in metres east, north and up (a georeferenced scene).
    settings:
        What is assumed of readings that do not tell their accuracy.
    turns:
        By frame name, degrees by which the stored picture is turned clockwise against the camera: the pose gets
        the turn (:func:`toolkit.poses.sensor_pixels.check_pixels` finds them).

    Raises
    ------
    StageError
        Where the scene is not georeferenced, or fewer than two frames have both a position and an attitude.
    """
    if scene.georeference is None:
        raise StageError(
            "The photos do not say where they were taken",
            expected="GPS positions in EXIF, or a georeferenced scene.json",
            found=f"{len(scene)} frames without georeference",
            todo="Use colmap-3dgs, which needs no positions",
        )
    line = None
    if settings.attitude != "gimbal":
        line = with_flight_line(
            scene,
            pitch=settings.assumed_pitch,
            every=settings.attitude == "flight-line",
            noise=settings.horizontal_sigma,
        )
        scene = line.scene
    frames = tuple(_placed(frame, settings, (turns or {}).get(frame.name, 0.0)) for frame in scene.frames)
    no_position = tuple(f.name for f in frames if f.prior is None or f.prior.position is None)
    no_attitude = tuple(f.name for f in frames if f.prior is None or f.prior.rotation is None)
    placed = sum(frame.cam_from_world is not None for frame in frames)
    if placed < 2:
        raise StageError(
            "Too few photos say both where the camera was and where it looked",
            expected="GPS (EXIF) and gimbal angles (XMP, as DJI writes them) in at least 2 photos",
            found=f"{len(frames) - len(no_position)} with a position, {len(frames) - len(no_attitude)} with an "
            f"attitude, {placed} with both",
            todo="Use colmap-3dgs, which needs neither, or set attitude to auto if the camera was fixed below a "
            "drone that flew nose ahead",
        )
    made = scene.replace(frames=frames, points=None)
    in_turn = () if line is None else line.turning
    odd = _odd_readings(made, no_position, [name for name in no_attitude if name not in in_turn])
    if line is None:
        return SensorPoses(made, no_position, no_attitude, odd)
    return SensorPoses(made, no_position, no_attitude, (*odd, *line.warnings), line.along, in_turn)


def turned(rotation: Array, degrees: float) -> Array:
    """Return ``cam_from_world`` (3, 3) of a picture that is turned clockwise by ``degrees`` after it was taken."""
    angle = math.radians(degrees)
    about_view = np.array(
        [[math.cos(angle), -math.sin(angle), 0.0], [math.sin(angle), math.cos(angle), 0.0], [0.0, 0.0, 1.0]]
    )
    result: Array = about_view @ rotation
    return result


def _placed(frame: Frame, settings: SensorPoseSettings, turn: float) -> Frame:
    prior = frame.prior
    if prior is None:
        return dataclasses.replace(frame, cam_from_world=None)
    horizontal, vertical = settings.horizontal_sigma, settings.vertical_sigma
    if prior.position is not None and prior.position_sigma is None:
        prior = dataclasses.replace(prior, position_sigma=np.array([horizontal, horizontal, vertical]))
    if prior.rotation is not None:
        sigma = np.full(3, math.radians(settings.angle_sigma))
        prior = dataclasses.replace(
            prior,
            rotation=turned(prior.rotation, turn),
            rotation_sigma=sigma if prior.rotation_sigma is None else prior.rotation_sigma,
        )
    return dataclasses.replace(frame, prior=prior, cam_from_world=_pose(prior))


def _pose(prior: PosePrior) -> RigidTransform | None:
    if prior.position is None or prior.rotation is None:
        return None
    return RigidTransform(prior.rotation, -prior.rotation @ prior.position)


def _odd_readings(scene: Scene, no_position: Sequence[str], no_attitude: Sequence[str]) -> tuple[str, ...]:
    """Return what neighbours in the order of capture say about each other."""
    warnings = []
    for names, what in ((no_position, "GPS position"), (no_attitude, "gimbal attitude")):
        if names:
            warnings.append(f"{len(names)} of {len(scene)} frames have no {what}: {some(names)}")
    frames = [frame for frame in scene.frames if frame.cam_from_world is not None]
    positions = scene.centres(frames)
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    standing = [frames[i + 1].name for i in np.flatnonzero(steps == 0.0)]
    if len(frames) > 3 and len(standing) > _STANDING_SHARE * len(steps):
        warnings.append(
            f"{len(standing)} of {len(frames)} frames have exactly the position of the one before: the receiver "
            f"wrote old readings, or the drone hovered: {some(standing)}"
        )
    warnings += _jumps(frames, positions, steps)
    times = np.array([np.nan if frame.time is None else frame.time for frame in frames])
    elapsed = np.diff(times)
    timed = np.isfinite(elapsed) & (elapsed > 0)
    speed = np.where(timed, steps / np.where(timed, elapsed, 1.0), 0.0)
    if (speed > _FASTEST).any():
        i = int(np.argmax(speed))
        warnings.append(
            f"{frames[i].name} and {frames[i + 1].name} are {steps[i]:.0f} m and {elapsed[i]:g} s apart, "
            f"{speed[i]:.0f} m/s: positions or capture times are wrong"
        )
    return tuple(warnings)


def _jumps(frames: Sequence[Frame], positions: Array, steps: Array) -> list[str]:
    """Name frames that lie far from both of their neighbours, which lie near each other."""
    if len(frames) < 5:
        return []
    typical = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    found = []
    for i in range(1, len(frames) - 1):
        before, after = positions[i - 1], positions[i + 1]
        away = float(min(np.linalg.norm(positions[i] - before), np.linalg.norm(positions[i] - after)))
        prior = frames[i].prior
        sigma = None if prior is None else prior.position_sigma
        limit = max(_JUMP_STEPS * typical, 0.0 if sigma is None else _JUMP_SIGMAS * float(np.max(sigma)))
        if away > max(limit, _JUMP_STEPS * float(np.linalg.norm(after - before))):
            found.append(f"{frames[i].name} ({away:.0f} m)")
    if not found:
        return []
    return [
        f"{len(found)} of {len(frames)} positions are far from those before and after, where neighbours are "
        f"{typical:.1f} m apart: {some(found)}"
    ]


def some(names: Sequence[str]) -> str:
    """Return the first names of a list as text."""
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
