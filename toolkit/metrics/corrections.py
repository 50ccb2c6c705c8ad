"""How far corrections of RPCs are from the true ones, up to the shift of the ground that tie points leave open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import StageError
from toolkit.geometry.rpc_camera import RpcCamera

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class CorrectionErrors:
    """Shifts of pictures beside the true ones.

    Attributes
    ----------
    found:
        (C, 2) pixels right and down, with the ground moved back.
    true:
        (C, 2) pixels.
    shift:
        (3,) metres east, north and up by which the ground was off.
    """

    found: Array
    true: Array
    shift: Array

    @property
    def distances(self) -> Array:
        """(C,) pixels between found and true."""
        distances: Array = np.linalg.norm(self.found - self.true, axis=1)
        return distances

    def to_dict(self) -> dict[str, Any]:
        """Return the shift, and the mean and the largest distance."""
        off = self.distances
        return {"shift_m": self.shift.tolist(), "mean_px": float(off.mean()), "max_px": float(off.max())}


def compare_corrections(cameras: Sequence[RpcCamera], true: ArrayLike) -> CorrectionErrors:
    """Compare the shifts of corrected cameras with true ones.

    A shift of the whole ground changes each picture by its derivatives at the origin times that shift; the one that
    brings both nearest together (least squares) is taken off. Linear parts of the corrections are not looked at.

    Parameters
    ----------
    cameras:
        As corrected.
    true:
        (C, 6) true corrections, as :attr:`RpcCamera.correction`.

    Raises
    ------
    StageError
        For another number of corrections, or too few pictures to tell a shift of the ground from their own.
    """
    known = np.asarray(true, dtype=np.float64)
    if known.shape != (len(cameras), 6) or len(cameras) < 2:
        raise StageError(
            "Corrections cannot be compared",
            expected="6 numbers for each of at least 2 cameras",
            found=f"{known.shape} for {len(cameras)} cameras",
        )
    shifts = known[:, [0, 3]]
    found = np.array([camera.correction for camera in cameras])[:, [0, 3]]
    slopes = np.concatenate([camera.jacobian(np.zeros((1, 3)))[0] for camera in cameras])
    moved, _, _, _ = np.linalg.lstsq(slopes, (shifts - found).ravel(), rcond=None)
    return CorrectionErrors(found + (slopes @ moved).reshape(-1, 2), shifts, moved)
