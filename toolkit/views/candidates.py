"""What view selection is given, checked: unit directions, and which of them may and must be chosen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError, StageError

Array = NDArray[np.float64]

#: How far from 1 the length of a unit vector may be.
_UNIT = 1e-6


def checked_directions(directions: ArrayLike) -> Array:
    """Return directions as (n, 3) float64. Raises :class:`DataError` where they are not finite unit vectors."""
    unit = np.asarray(directions, dtype=np.float64)
    if unit.ndim != 2 or unit.shape[1] != 3:
        raise DataError("View directions have a wrong shape", expected="(n, 3)", found=str(unit.shape))
    finite = np.isfinite(unit).all(axis=1)
    if not finite.all():
        raise DataError(
            "View directions are not finite",
            expected="unit vectors",
            found=f"{int((~finite).sum())} with NaN or infinity, the first at {int(np.argmin(finite))}",
        )
    length = np.linalg.norm(unit, axis=1)
    off = np.abs(length - 1) > _UNIT
    if off.any():
        first = int(np.argmax(off))
        raise DataError(
            "View directions are not of length 1",
            expected="unit vectors",
            found=f"length {length[first]:.6g} at {first}",
            todo="Divide each by its length",
        )
    return unit


def usable_views(n: int, k: int, include: Sequence[int], exclude: Sequence[int]) -> NDArray[np.bool_]:
    """Return (n,) which of n views may be chosen.

    Raises
    ------
    DataError
        For indices that are none, stand twice, or are both to include and to exclude.
    StageError
        Where k is not positive, there are fewer views than k, or more must be included.
    """
    for name, given in (("include", include), ("exclude", exclude)):
        wrong = [index for index in given if not 0 <= index < n]
        if wrong or len(set(given)) != len(given):
            raise DataError(
                f"Indices of views to {name} are wrong",
                expected=f"different numbers from 0 to {n - 1}",
                found=str(wrong or list(given)),
            )
    both = sorted(set(include) & set(exclude))
    if both:
        raise DataError("Views are both to include and to exclude", found=str(both))
    if k < 1:
        raise StageError("No views are asked for", expected="k of 1 or more", found=str(k))
    if len(include) > k:
        raise StageError(
            "More views must be included than are chosen",
            expected=f"at most {k}",
            found=str(len(include)),
            todo="Raise count, or include fewer",
        )
    usable = np.ones(n, dtype=bool)
    usable[list(exclude)] = False
    if int(usable.sum()) < k:
        raise StageError(
            f"There are fewer views than the {k} to choose",
            expected=f"at least {k} views",
            found=f"{n} views, {len(exclude)} of them excluded" if exclude else f"{n} views",
            todo="Lower count" + (", or exclude fewer" if exclude else ""),
        )
    return usable
