"""Values between readings: linear for numbers, by the shortest turn for attitudes, nothing across gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from toolkit.geometry.attitude import Attitude, attitude_of, cam_from_enu

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Brackets:
    """Between which readings times lie.

    Attributes
    ----------
    before, after:
        (N,) indices of readings; equal where one reading alone counts.
    share:
        (N,) weight of ``after``, 0 to 1.
    usable:
        (N,) whether a value can be given.
    """

    before: NDArray[np.int64]
    after: NDArray[np.int64]
    share: Array
    usable: NDArray[np.bool_]


def brackets(known: Array, times: Array, max_gap: float) -> Brackets:
    """Find the readings around each time.

    A time between readings that are more than ``max_gap`` apart has no value. The first and the last reading hold
    for half the median distance of readings, at most half of ``max_gap``, before and after them.

    Parameters
    ----------
    known:
        (K,) times of the readings, strictly increasing.
    times:
        (N,) seconds, in any order.
    max_gap:
        Seconds.
    """
    if not len(known):
        zeros = np.zeros(len(times), dtype=np.int64)
        return Brackets(zeros, zeros, np.zeros(len(times)), np.zeros(len(times), dtype=bool))
    place = np.searchsorted(known, times)
    before = np.clip(place - 1, 0, len(known) - 1)
    after = np.clip(place, 0, len(known) - 1)
    before = np.where(known[after] == times, after, before)
    span = known[after] - known[before]
    share = np.divide(times - known[before], span, out=np.zeros(len(times)), where=span > 0)
    hold = min(float(np.median(np.diff(known))), max_gap) / 2 if len(known) > 1 else 0.0
    outside = np.maximum(known[0] - times, times - known[-1])
    usable = np.where(span > 0, span <= max_gap, outside <= hold)
    return Brackets(before, after, share, usable)


def linear(known: Array, values: Array, times: Array, max_gap: float) -> Array:
    """Return values (N, C) at ``times`` (N,) of readings (K, C); rows of readings that are not finite do not count.

    What has no value is NaN.
    """
    sound = np.isfinite(values).all(axis=1)
    found = np.full((len(times), values.shape[1]), np.nan)
    if sound.any():
        rows, place = values[sound], brackets(known[sound], times, max_gap)
        mixed = rows[place.before] + place.share[:, None] * (rows[place.after] - rows[place.before])
        found[place.usable] = mixed[place.usable]
    return found


def shortest_turn(known: Array, angles: Array, times: Array, max_gap: float) -> Array:
    """Return yaw, pitch and roll (N, 3) in degrees at ``times`` (N,) of readings (K, 3).

    Spherical linear interpolation (Shoemake, "Animating rotation with quaternion curves", SIGGRAPH 1985). Rows of
    readings that are not finite do not count. What has no value is NaN.
    """
    sound = np.isfinite(angles).all(axis=1)
    found = np.full((len(times), 3), np.nan)
    if not sound.any():
        return found
    rows, place = angles[sound], brackets(known[sound], times, max_gap)
    for i in np.flatnonzero(place.usable):
        first, second, share = rows[place.before[i]], rows[place.after[i]], place.share[i]
        if share in (0.0, 1.0):  # the reading itself, to the bit
            found[i] = second if share else first
            continue
        start = cam_from_enu(Attitude(*first.tolist()))
        turn = Rotation.from_matrix(cam_from_enu(Attitude(*second.tolist())) @ start.T).as_rotvec()
        middle = attitude_of(Rotation.from_rotvec(share * turn).as_matrix() @ start)
        found[i] = middle.yaw, middle.pitch, middle.roll
    return found
