"""Selections that do not look at the information matrix, to compare with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.views.greedy import Task

Array = NDArray[np.float64]

#: Most views of which every one is compared with every other.
MOST_COMPARED = 10_000


def random_views(task: Task, seed: int) -> list[int]:
    """Return the views that must be included, and others drawn at random, each set as likely as any other."""
    left = np.flatnonzero(task.open(task.include))
    drawn = np.random.default_rng(seed).choice(left, task.count - len(task.include), replace=False)
    return [*task.include, *drawn.tolist()]


def farthest_views(task: Task) -> list[int]:
    """Return farthest-point samples: each pick is the view whose angle to the nearest chosen one is largest.

    The first is the view farthest from the mean direction. For least spread everything is turned round: the view
    nearest the mean direction, then the one whose angle to the farthest chosen one is smallest. Cost O(n k).
    """
    directions, most = task.views.directions, task.sign > 0
    chosen = list(task.include)
    # Cosine to the nearest chosen view (largest), for least spread to the farthest (smallest).
    worst = np.maximum if most else np.minimum
    cosine = directions @ directions[task.usable].mean(axis=0)
    if chosen:
        cosine = worst.reduce(directions @ directions[chosen].T, axis=1)
    while len(chosen) < task.count:
        pick = int(np.argmax(np.where(task.open(chosen), -task.sign * cosine, -np.inf)))
        along = directions @ directions[pick]
        cosine = worst(cosine, along) if chosen else along
        chosen.append(pick)
    return chosen


def covered_directions(directions: Array, angle_deg: float) -> NDArray[np.bool_]:
    """Return (n, n) which views lie within an angle of which.

    Raises
    ------
    StageError
        For more views than :data:`MOST_COMPARED`.
    """
    if len(directions) > MOST_COMPARED:
        raise StageError(
            "Coverage compares every view with every other",
            expected=f"at most {MOST_COMPARED} views",
            found=str(len(directions)),
            todo="Choose by another method, or thin the views first",
        )
    near: NDArray[np.bool_] = directions @ directions.T >= np.cos(np.radians(angle_deg)) - 1e-12
    return near


def covering_views(task: Task, covers: NDArray[np.bool_]) -> list[int]:
    """Return greedy maximum coverage: each pick covers the most that no pick before it covers.

    Where no view is left that covers anything new, all counts as uncovered again. For least spread each pick covers
    the least that is new.

    Parameters
    ----------
    covers:
        (n, m) which views cover which things.
    """
    chosen = list(task.include)
    new = ~covers[chosen].any(axis=0)
    gain = covers[:, new].sum(axis=1)
    while len(chosen) < task.count:
        left = task.open(chosen)
        if not gain[left].any():
            new, gain = np.ones_like(new), covers.sum(axis=1)
        pick = int(np.argmax(np.where(left, task.sign * gain, -np.inf)))
        chosen.append(pick)
        gain = gain - covers[:, new & covers[pick]].sum(axis=1)
        new &= ~covers[pick]
    return chosen
