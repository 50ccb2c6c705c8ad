"""What is known of cameras on a circle beside their pictures: small slacks, a known turn, a smooth speed."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from toolkit.errors import StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.poses.circular_model import LOOSE, Ring, Unknowns, rotation_vectors
from toolkit.poses.circular_settings import CircularSettings
from toolkit.poses.circular_solver import Constraints

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# The first frame's angle is where angles begin; nothing else holds the ring from turning as a whole.
_ANCHOR = 1e-7


def turn_coefficients(settings: CircularSettings, index: Index) -> Array:
    """Return coefficients (F,) of the frames' angles whose sum is the known turn.

    Parameters
    ----------
    settings:
        With ``full_turn``.
    index:
        (F,) which of the scene's frames are on the ring.

    Raises
    ------
    StageError
        Where a frame that the turn is told by has no pose, or they are the same.
    """
    coefficients = np.zeros(len(index))
    coefficients[_row(settings.turn_first, index)] -= 1.0
    if settings.turn_last >= 0:
        coefficients[_row(settings.turn_last, index)] += 1.0
        if not coefficients.any():
            raise StageError("The known turn begins and ends with the same frame", found=str(settings.turn_first))
        return coefficients
    if index[-1] - index[-2] != 1 or index[1] - index[0] != 1:
        raise StageError(
            "The step after the last frame is not known",
            expected="poses of the first two and of the last two frames",
            todo="Name the frame that ends the turn with turn_last",
        )
    # One step after the last frame.
    coefficients[-1] += 1.0
    coefficients[-1] += 0.5
    coefficients[-2] -= 0.5
    coefficients[1] += 0.5
    coefficients[0] -= 0.5
    return coefficients


def _row(frame: int, index: Index) -> int:
    found = np.flatnonzero(index == frame)
    if not len(found):
        raise StageError(
            f"The known turn is told by frame {frame}, which has no pose",
            expected=f"one of the {len(index)} registered frames, counted from 0",
            todo="Choose turn_first and turn_last among them",
        )
    return int(found[0])


def ring_constraints(
    settings: CircularSettings,
    index: Index,
    models: tuple[ColmapCamera, ...] = (),
    *,
    slack: float = 1.0,
    step_spread: float = 0.0,
) -> Constraints:
    """Return the residuals of the ring in standard deviations, with their derivatives.

    Parameters
    ----------
    settings:
        As declared.
    index:
        (F,) which of the scene's frames are on the ring: steps over frames without pose are longer.
    models:
        (C,) the cameras before, whose principal points are known within their standard deviation.
    slack:
        Factor of the declared slacks.
    step_spread:
        Standard deviation of the steps in radians: the error of a step after the last frame that none measures.
    """
    turn = turn_coefficients(settings, index) if settings.full_turn else None
    turn_sigma = math.hypot(math.radians(settings.turn_sigma), step_spread if settings.turn_last < 0 else 0.0)
    factor = math.sqrt(settings.weight) / slack
    sigma = np.array(
        [settings.radial_slack / 100, settings.axial_slack / 100, *3 * [math.radians(settings.orientation_slack)]]
    )
    count = len(index)
    # Second differences per frame number, so that gaps in the sequence are no jumps of speed.
    gap = np.diff(index).astype(np.float64)

    def rows(ring: Ring, unknowns: Unknowns) -> tuple[Array, csr_array]:
        wide = unknowns.of_frame
        size = count * wide + unknowns.others
        values = [np.array([ring.angle[0] / _ANCHOR])]
        entries = [(np.zeros(1, dtype=int), np.zeros(1, dtype=int), np.array([1.0 / _ANCHOR]))]
        at = 1
        if turn is not None:
            scale = 1.0 / turn_sigma
            values.append(np.array([scale * (turn @ ring.angle - math.radians(settings.turn_angle))]))
            held = np.flatnonzero(turn)
            entries.append((np.full(len(held), at), wide * held, scale * turn[held]))
            at += 1
        if settings.smoothness > 0 and count > 2:
            scale = 1.0 / math.radians(settings.smoothness)
            values.append(scale * np.diff(np.diff(ring.angle) / gap))
            row = at + np.arange(count - 2)
            column = wide * np.arange(count - 2)
            entries.append((row, column, scale / gap[:-1]))
            entries.append((row, column + wide, -scale / gap[:-1] - scale / gap[1:]))
            entries.append((row, column + 2 * wide, scale / gap[1:]))
            at += count - 2
        if wide == LOOSE:
            offsets = np.column_stack([ring.radial, ring.axial, rotation_vectors(ring.tilt)]) / sigma * factor
            values.append(offsets.ravel())
            column = (wide * np.arange(count)[:, None] + np.arange(1, LOOSE)).ravel()
            # A turn's derivative by a further small turn is the identity to first order in the turn itself.
            entries.append((at + np.arange(5 * count), column, np.tile(factor / sigma, count)))
            at += 5 * count
        told = _principal_points(models, ring.models, unknowns, settings.principal_point_sigma / 100)
        if told is not None:
            values.append(told[0])
            entries.append((at + np.arange(len(told[0])), count * wide + told[1], told[2]))
            at += len(told[0])
        row, column, entry = (np.concatenate(part) for part in zip(*entries, strict=True))
        return np.concatenate(values), csr_array((entry, (row, column)), shape=(at, size))

    return rows


def _principal_points(
    before: tuple[ColmapCamera, ...], now: tuple[ColmapCamera, ...], unknowns: Unknowns, sigma: float
) -> tuple[Array, Index, Array] | None:
    """Return residuals of free principal points, their columns among mounts and cameras, and their derivatives."""
    rows = []
    at = 3 * len(now)
    for old, new, free in zip(before, now, unknowns.free, strict=False):
        scale = 1.0 / (sigma * max(old.width, old.height))
        for i in old.to_pycolmap().principal_point_idxs():
            if i in free:
                rows.append((scale * (new.params[i] - old.params[i]), at + free.index(i), scale))
        at += len(free)
    if not rows:
        return None
    values, columns, scales = zip(*rows, strict=True)
    return np.array(values), np.array(columns, dtype=np.int64), np.array(scales)
