"""How well an arc is known: its standard deviation from the covariance of the bundle adjustment.

The cameras on an open arc and the lens can bend together and fit the pictures as before: with free intrinsics the
arc of 98 degrees of the blade-inspection paper (section 4.3, Table 1) is known to several degrees only, and the
reprojection error does not show it. The covariance does. It is the inverse of the normal equations of all poses,
points and intrinsics, the points eliminated (Triggs et al. 2000, "Bundle adjustment - a modern synthesis", sections
6 and 9), carried linearly to the arc.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.metrics.circle import fit_circle
from toolkit.poses.normal_equations import NormalEquations, normal_equations
from toolkit.progress import Progress, silent, track
from toolkit.scene import Scene

Array = NDArray[np.float64]

# Step of a finite difference as a part of the radius: far above the rounding of the fit, far below its bend.
_STEP = 1e-4


@dataclass(frozen=True, slots=True)
class ArcSigma:
    """An arc and how well it is known.

    Attributes
    ----------
    arc_degrees:
        Angle from the first to the last camera about the axis of the fitted circle.
    sigma, sigma_fixed:
        Its standard deviation in degrees with the intrinsics among the unknowns, and with intrinsics that are known
        exactly. None where the observations do not determine it. Both are of independent residuals: what these have
        in common (a lens that the model cannot describe, a bent world) comes on top.
    noise:
        Standard deviation of a residual's coordinate in pixels, robust, and corrected for the number of unknowns.
    focal_sigma:
        Relative standard deviation of the worst determined focal length; None where it is not free or open.
    frames, points, observations:
        How many took part.
    """

    arc_degrees: float
    sigma: float | None
    sigma_fixed: float | None
    noise: float
    focal_sigma: float | None
    frames: int
    points: int
    observations: int

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return asdict(self)


def arc_sigma(
    scene: Scene,
    *,
    refine_focal: bool = True,
    refine_distortion: bool = True,
    refine_principal_point: bool = False,
    known: Array | None = None,
    progress: Progress = silent,
) -> ArcSigma:
    """Return the arc of a scene's cameras with its standard deviation.

    Parameters
    ----------
    scene:
        With poses, points and tracks, as a bundle adjustment left them; the registered frames in order along the
        arc.
    refine_focal, refine_distortion, refine_principal_point:
        Which intrinsics that adjustment found.
    known:
        (K, K) inverse covariance of the free intrinsics by what else is known of them (a board, straight edges), in
        the order of the cameras and of their parameters; None for nothing.
    progress:
        Told of the finite differences through the circle's fit; raises to cancel.

    Raises
    ------
    StageError
        For a scene without tracks or with fewer observations than unknowns, and where its cameras make no circle
        (:func:`toolkit.metrics.circle.fit_circle`).
    CapabilityError
        For a camera that is none of COLMAP's.
    """
    centres = scene.centres()
    circle = fit_circle(centres)
    gradient = gradient_of(
        lambda places: fit_circle(places).arc_degrees, centres, step=_STEP * circle.radius, progress=progress
    )
    free = normal_equations(
        scene, focal=refine_focal, distortion=refine_distortion, principal_point=refine_principal_point
    )
    noise = free.noise
    if noise is None:
        raise StageError(
            "There are too few observations to tell how well the arc is known",
            expected=f"more than {int(free.kept.sum()) + 3 * free.points} coordinates, one for each unknown",
            found=f"{2 * free.observations}",
        )
    fixed = free.without_intrinsics()
    if known is not None:
        free = free.with_information(known * noise**2)
    return ArcSigma(
        arc_degrees=circle.arc_degrees,
        sigma=_scaled(free.variance(free.of_centres(gradient)), noise),
        sigma_fixed=_scaled(fixed.variance(fixed.of_centres(gradient)), noise),
        noise=noise,
        focal_sigma=_focal_sigma(scene, free, noise) if refine_focal else None,
        frames=len(centres),
        points=free.points,
        observations=free.observations,
    )


def gradient_of(
    measure: Callable[[Array], float], centres: Array, *, step: float, progress: Progress = silent
) -> Array:
    """Return the derivative (F, 3) of a measure of camera centres (F, 3), by central differences."""
    gradient = np.zeros_like(centres)
    for row in track(range(len(centres)), "arc_sigma", progress):
        for axis in range(3):
            moved = np.zeros_like(centres)
            moved[row, axis] = step
            gradient[row, axis] = (measure(centres + moved) - measure(centres - moved)) / (2.0 * step)
    return gradient


def _scaled(variance: float | None, noise: float) -> float | None:
    return None if variance is None else noise * math.sqrt(variance)


def _focal_sigma(scene: Scene, equations: NormalEquations, noise: float) -> float | None:
    worst = 0.0
    for column, (camera_id, index) in enumerate(equations.intrinsics):
        camera = scene.cameras[camera_id]
        assert isinstance(camera, ColmapCamera)
        if index not in camera.to_pycolmap().focal_length_idxs():
            continue
        sigma = _scaled(equations.variance(equations.of_intrinsic(column)), noise)
        if sigma is None:
            return None
        worst = max(worst, sigma / camera.params[index])
    return worst
