"""How well Gaussian splats lie on the surface: distances to a cloud, displacement in training, errors of depth.

The measures of section 4.2 of Matzke et al. ("Evaluating Gaussian splatting maps for absolute visual localization
of UAVs"), Table 2 and Figure 3, and the two numbers that a pose from rendered depth depends on: bias and spread.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from toolkit.errors import DataError, StageError
from toolkit.geometry.cameras import Camera

Array = NDArray[np.float64]

#: The median absolute deviation times this is the standard deviation of normally distributed errors.
MAD_TO_SIGMA: Final = 1.4826
#: Gaussians above this opacity are told apart: fainter ones hardly show where they are.
OPAQUE: Final = 0.5
_WITHIN: Final = 0.2


def cloud_distances(points: Array, cloud: Array) -> Array:
    """Return the distance (N,) of each of ``points`` (N, 3) to the nearest point of ``cloud`` (M, 3).

    The absolute cloud-to-cloud distance (C2C) of CloudCompare, without a local surface model: it is never smaller
    than the distance to the surface, and no finer than the cloud is dense.

    Raises
    ------
    DataError
        For points that are not (N, 3) or not finite, and for an empty cloud.
    """
    for name, values in (("points", points), ("cloud", cloud)):
        if values.ndim != 2 or values.shape[1] != 3 or not np.isfinite(values).all():
            raise DataError(
                f"Distances cannot be measured: the {name} are no places",
                expected="finite coordinates (N, 3)",
                found=f"shape {values.shape}, {int((~np.isfinite(values)).sum())} numbers not finite",
            )
    if not len(cloud):
        raise DataError("Distances cannot be measured: the cloud is empty", expected="points", found="none")
    distances: Array = cKDTree(cloud).query(points, workers=-1)[0]
    return distances


def distance_summary(distances: Array) -> dict[str, float]:
    """Return median, mean, 90th percentile and number of distances (N,), ready for JSON.

    Raises
    ------
    StageError
        For no distances.
    """
    if not len(distances):
        raise StageError("There is nothing to summarise", expected="distances", found="none")
    return {
        "points": float(len(distances)),
        "median": float(np.median(distances)),
        "mean": float(distances.mean()),
        "p90": float(np.percentile(distances, 90)),
    }


@dataclass(frozen=True, slots=True, eq=False)
class Displacements:
    """How far Gaussians are from where they began.

    Attributes
    ----------
    horizontal:
        (N,) distances in the x-y plane, in scene units.
    vertical:
        (N,) differences of z, upwards positive.
    opaque:
        (N,) which Gaussians have an opacity above :data:`OPAQUE`.
    """

    horizontal: Array
    vertical: Array
    opaque: NDArray[np.bool_]

    def to_dict(self) -> dict[str, Any]:
        """Return medians and 90th percentiles of the lengths, of all Gaussians and of the opaque ones."""
        groups = {"all": np.ones(len(self.opaque), bool), "opaque": self.opaque}
        return {
            name: {
                "gaussians": int(rows.sum()),
                "horizontal": distance_summary(self.horizontal[rows]),
                "vertical": distance_summary(np.abs(self.vertical[rows])),
            }
            for name, rows in groups.items()
            if rows.any()
        }


def displacements(origins: Array, centres: Array, opacities: Array) -> Displacements:
    """Return how far each Gaussian moved, its origin being that of the point it came from.

    Parameters
    ----------
    origins, centres:
        (N, 3) where each began and where it is, z up.
    opacities:
        (N,) of 0 to 1.

    Raises
    ------
    DataError
        For arrays that do not fit together.
    """
    if origins.shape != centres.shape or centres.shape != (len(opacities), 3):
        raise DataError(
            "Origins, centres and opacities do not fit together",
            expected="(N, 3), (N, 3) and (N,)",
            found=f"{origins.shape}, {centres.shape} and {opacities.shape}",
        )
    moved = centres.astype(np.float64) - origins
    return Displacements(np.linalg.norm(moved[:, :2], axis=1), moved[:, 2], opacities > OPAQUE)


def ray_errors(found: NDArray[np.floating], truth: NDArray[np.floating], camera: Camera) -> Array:
    """Return by how much a depth map (H, W) is too deep along the rays (H, W), NaN where one has no depth.

    Parameters
    ----------
    found, truth:
        Camera depths (z) in the same units; 0 and what is not finite are pixels without depth.
    camera:
        Of the maps' size.

    Raises
    ------
    DataError
        For maps that are not of the camera's size.
    """
    size = (camera.height, camera.width)
    if found.shape != size or truth.shape != size:
        raise DataError(
            "Depth maps are not of the camera's size", expected=str(size), found=f"{found.shape} and {truth.shape}"
        )
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    directions = camera.ray(np.stack([column.reshape(-1), row.reshape(-1)], axis=1))[1].reshape(*size, 3)
    known = (found > 0) & (truth > 0) & np.isfinite(found) & np.isfinite(truth)
    with np.errstate(invalid="ignore"):
        return np.where(known, (found.astype(np.float64) - truth) / directions[..., 2], np.nan)


@dataclass(frozen=True, slots=True)
class DepthBias:
    """Bias and spread of errors along rays, in scene units; what is too deep is positive.

    Attributes
    ----------
    bias:
        Median.
    spread:
        Robust standard deviation: 1.4826 times the median absolute deviation from the median.
    std:
        Plain standard deviation, which few pixels at outlines rule.
    within:
        Share of the errors with a size of at most 0.2.
    pixels:
        How many.
    """

    bias: float
    spread: float
    std: float
    within: float
    pixels: int

    def to_dict(self) -> dict[str, float]:
        """Return the measures, ready for JSON."""
        return {name: float(getattr(self, name)) for name in self.__slots__}


def depth_bias(errors: Array) -> DepthBias:
    """Return bias and spread of errors of any shape; NaN are left out.

    Raises
    ------
    StageError
        Where none is a number.
    """
    known = errors[np.isfinite(errors)]
    if not len(known):
        raise StageError("Depth cannot be compared", expected="pixels with a found and a true depth", found="none")
    bias = float(np.median(known))
    return DepthBias(
        bias=bias,
        spread=float(MAD_TO_SIGMA * np.median(np.abs(known - bias))),
        std=float(known.std()),
        within=float((np.abs(known) <= _WITHIN).mean()),
        pixels=len(known),
    )
