"""How far a depth map is from the true one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, StageError


@dataclass(frozen=True, slots=True)
class DepthErrors:
    """How far a depth map is from the true one, over the pixels that both know.

    Attributes
    ----------
    mean, median, rms:
        Of the absolute errors, in the truth's units.
    relative:
        Mean absolute error over true depth (AbsRel of Eigen et al., 2014, section 4).
    within:
        Share of the pixels whose depth is within a factor of 1.25 of the truth (delta_1 of the same).
    coverage:
        Share of the pixels with a true depth for which one was found.
    pixels:
        How many were compared.
    """

    mean: float
    median: float
    rms: float
    relative: float
    within: float
    coverage: float
    pixels: int

    def to_dict(self) -> dict[str, float]:
        """Return the measures, ready for JSON."""
        return {name: getattr(self, name) for name in self.__slots__}


def depth_errors(found: NDArray[np.floating], truth: NDArray[np.floating]) -> DepthErrors:
    """Compare depth maps (H, W); 0 and what is not finite are pixels without depth.

    Raises
    ------
    DataError
        For maps of different sizes.
    StageError
        Where no pixel has both.
    """
    if found.shape != truth.shape:
        raise DataError("Depth maps differ in size", expected=str(truth.shape), found=str(found.shape))
    known = np.isfinite(truth) & (truth > 0)
    both = known & np.isfinite(found) & (found > 0)
    if not both.any():
        raise StageError(
            "Depth cannot be compared",
            expected="pixels with a found and a true depth",
            found=f"{int(known.sum())} with a true one, none of them found",
        )
    ours, theirs = found[both].astype(np.float64), truth[both].astype(np.float64)
    error = np.abs(ours - theirs)
    return DepthErrors(
        mean=float(error.mean()),
        median=float(np.median(error)),
        rms=float(np.sqrt(np.mean(error**2))),
        relative=float(np.mean(error / theirs)),
        within=float(np.mean(np.maximum(ours / theirs, theirs / ours) < 1.25)),
        coverage=float(both.sum() / known.sum()),
        pixels=int(both.sum()),
    )
