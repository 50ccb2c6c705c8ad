"""A flight in order: the last poses predict the next, and what does not fit the prediction is not believed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.localizer import Localizer
from toolkit.localize.query import Query
from toolkit.localize.result import Localization
from toolkit.localize.settings import SequenceSettings
from toolkit.localize.starts import Start
from toolkit.progress import Progress, silent, track

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Fix:
    """A pose that was found, when, and how surely (standard deviations in scene units and degrees)."""

    time: float
    pose: RigidTransform
    position_sigma: float
    rotation_sigma_deg: float


def localize_sequence(
    localizer: Localizer,
    queries: Sequence[Query],
    times: Sequence[float],
    start: Start,
    settings: SequenceSettings,
    *,
    attitudes: Mapping[str, Array] | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> tuple[Localization, ...]:
    """Return the pose of every photo of a flight, each looked for where the ones before it lead.

    The first is looked for from ``start``, and so is every other until one is found. From then on a photo's start
    is what constant velocity and turn rate predict from the last two poses; its standard deviations grow with the
    time since the last one, so that the gate (:class:`~toolkit.localize.settings.JudgeSettings`) opens and the fan
    widens while the drone is lost.

    Parameters
    ----------
    queries, times:
        In order; seconds, rising.
    start:
        Of the first photo.
    attitudes:
        Rotations ``cam_from_world`` (3, 3) by an IMU for some photos, by their names: they replace what the turn
        rate predicts.

    Raises
    ------
    DataError
        Where times are fewer or more than photos, or do not rise.
    """
    clock = np.asarray(times, dtype=np.float64)
    if len(clock) != len(queries) or (np.diff(clock) <= 0).any() or not np.isfinite(clock).all():
        raise DataError(
            "Times do not fit the photos",
            expected=f"{len(queries)} seconds, each larger than the one before",
            found=f"{len(clock)}, the smallest step {np.diff(clock).min(initial=np.inf):g}",
        )
    fixes: list[Fix] = []
    found = []
    for query, time in zip(track(queries, "localize.sequence", progress), clock.tolist(), strict=True):
        guess = predict(query.name, fixes, time, settings) if fixes else start
        told = None if attitudes is None else attitudes.get(query.name)
        if told is not None:
            guess = _turned(guess, np.asarray(told, dtype=np.float64), settings.attitude_sigma)
        done = localizer.localize(query, guess, seed=seed)
        found.append(done)
        if done.cam_from_world is not None:
            position, rotation = done.position_sigma, done.rotation_sigma_deg
            assert position is not None  # a pose that is believed has a covariance
            assert rotation is not None
            fixes = [*fixes[-1:], Fix(time, done.cam_from_world, float(position.max()), float(rotation.max()))]
    return tuple(found)


def predict(name: str, fixes: Sequence[Fix], time: float, settings: SequenceSettings) -> Start:
    """Return where a photo is looked for after one or two poses: at constant velocity and turn rate."""
    from scipy.spatial.transform import Rotation

    last = fixes[-1]
    ahead = time - last.time
    if len(fixes) == 1:
        return Start(
            name,
            last.pose,
            math.hypot(last.position_sigma, settings.speed * ahead),
            math.hypot(last.rotation_sigma_deg, settings.angular_speed * ahead),
        )
    before = fixes[-2]
    step = last.time - before.time
    centre = last.pose.centre + (last.pose.centre - before.pose.centre) * ahead / step
    turn = Rotation.from_matrix(last.pose.rotation @ before.pose.rotation.T).as_rotvec() * ahead / step
    rotation = Rotation.from_rotvec(turn).as_matrix() @ last.pose.rotation
    # Both poses' errors are in the velocity; acceleration adds with the time that it has had, the step's half too.
    own, since = 1 + ahead / step, ahead * (ahead + step) / 2
    return Start(
        name,
        RigidTransform(rotation, -rotation @ centre),
        math.hypot(own * last.position_sigma, settings.acceleration * since),
        math.hypot(own * last.rotation_sigma_deg, settings.angular_acceleration * since),
    )


def _turned(guess: Start, rotation: Array, sigma: float) -> Start:
    pose = RigidTransform(rotation, -rotation @ guess.cam_from_world.centre)
    return Start(guess.name, pose, guess.position_sigma, sigma)
