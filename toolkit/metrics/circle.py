"""Cameras on a circle: the axis, the radius and the arc of their centres, and how far they are from a circle.

An inspection camera inside an engine sees the blades pass, which is a camera that circles the rotor (paper
blade-inspection-sfm, section 4.3: the arc is what reconstructions are judged by).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError, StageError
from toolkit.geometry.alignment import COLLINEAR
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.scene import Scene

Array = NDArray[np.float64]

# A circle must explain the centres better than a line does: least ratio of what its two further parameters take of
# the squared distances, each, to the variance that is left. A straight path has 12 once in ten thousand.
_BENDS = 12.0
# Arcs known no better than this part of themselves, and shorter ones than so many degrees, get a remark.
_LOOSE, _SHORT = 0.05, 5.0
# Normalised residuals lose their weight from here on in the robust fit.
_CAUCHY = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class CircleFit:
    """The circle nearest to camera centres.

    Attributes
    ----------
    centre:
        (3,) in the units of the centres, as the radius.
    axis:
        (3,) unit normal of the circle's plane; angles grow about it by the right-hand rule.
    radius:
        Of the circle.
    angles:
        (n,) degrees about the axis, 0 at the first centre, unwrapped along the sequence.
    radial, axial:
        (n,) distances of the centres from the circle in its plane (outwards) and along the axis, as parts of the
        radius.
    arc_sigma:
        Standard deviation of the arc in degrees were the distances of the centres from the circle independent of
        each other, which those of a drifting reconstruction are not; None for three centres.
    closure_gap:
        Distance of the last centre from the place where the first one is after the expected turn, as a part of the
        circumference; None where no turn was expected.
    remark:
        What is doubtful, or an empty text.
    """

    centre: Array
    axis: Array
    radius: float
    angles: Array
    radial: Array
    axial: Array
    arc_sigma: float | None
    closure_gap: float | None
    remark: str

    @property
    def arc_degrees(self) -> float:
        """Angle from the first to the last centre, in degrees; above 360 after more than a turn."""
        return float(self.angles[-1] - self.angles[0])

    @property
    def radius_spread(self) -> float:
        """Root mean square of the radial distances, as a part of the radius."""
        return float(np.sqrt(np.mean(self.radial**2)))

    @property
    def out_of_plane_rms(self) -> float:
        """Root mean square of the distances from the plane, as a part of the radius."""
        return float(np.sqrt(np.mean(self.axial**2)))

    def to_dict(self) -> dict[str, Any]:
        """Return the measures and the values of each centre, ready for JSON."""
        return {
            "centres": len(self.angles),
            "centre": self.centre.tolist(),
            "axis": self.axis.tolist(),
            "radius": self.radius,
            "arc_degrees": self.arc_degrees,
            "arc_sigma": self.arc_sigma,
            "radius_spread": self.radius_spread,
            "out_of_plane_rms": self.out_of_plane_rms,
            "closure_gap": self.closure_gap,
            "remark": self.remark,
            "angles": self.angles.tolist(),
            "radial": self.radial.tolist(),
            "axial": self.axial.tolist(),
        }


@dataclass(frozen=True, slots=True, eq=False)
class CircleErrors:
    """Errors of cameras on a circle against true poses, after a Sim(3) alignment of the centres.

    Attributes
    ----------
    names:
        Of the frames with both poses.
    position:
        (n,) distances of the centres as parts of the true radius.
    rotation_deg:
        (n,) angles between orientations in degrees.
    angle_deg:
        (n,) found minus true angle about the axis, each about its own circle, in degrees; their mean is 0, since
        where angles begin is arbitrary.
    arc_deg:
        Found minus true arc in degrees.
    """

    names: tuple[str, ...]
    position: Array
    rotation_deg: Array
    angle_deg: Array
    arc_deg: float

    def to_dict(self) -> dict[str, Any]:
        """Return root mean squares, maxima and the values of each frame, ready for JSON."""
        measures: dict[str, Any] = {"frames": len(self.names), "arc_deg": self.arc_deg}
        for name in ("position", "rotation_deg", "angle_deg"):
            errors = getattr(self, name)
            measures[f"{name}_rms"] = float(np.sqrt(np.mean(errors**2)))
            measures[f"{name}_max"] = float(np.abs(errors).max())
            measures[name] = errors.tolist()
        return measures | {"names": list(self.names)}


def fit_circle(centres: ArrayLike, *, expected_turn: float | None = None, robust: bool = False) -> CircleFit:
    """Fit the circle with the least sum of squared distances to camera centres.

    The distance to a circle in space: radial in its plane, and along its axis (geometric fit, by iteration from the
    algebraic one).

    Parameters
    ----------
    centres:
        (n, 3) in order of capture, at least three; neighbours less than half a turn apart.
    expected_turn:
        True angle in degrees from the first to the last centre where it is known (360 for footage that ends where
        it began), for the closure gap; None for an open arc.
    robust:
        Whether single centres far from the circle lose their pull (Cauchy's loss).

    Raises
    ------
    DataError
        For arrays of another shape, NaN or infinity.
    StageError
        For fewer than three centres, and for centres that lie on a line within their scatter.
    """
    points = np.asarray(centres, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise DataError("Cannot fit a circle", expected="finite centres (n, 3)", found=f"an array {points.shape}")
    if len(points) < 3:
        raise StageError("Too few cameras for a circle", expected="at least 3 with a pose", found=f"{len(points)}")
    middle = points.mean(axis=0)
    _, size, basis = np.linalg.svd(points - middle, full_matrices=False)
    if size[1] <= COLLINEAR * size[0]:
        raise _straight("a second singular value of " + f"{size[1] / max(size[0], 1e-300):.1e} of the first")
    unit = float(size[0]) / math.sqrt(len(points))
    local = (points - middle) @ basis.T / unit
    values, covariance, noise = _refined(local, _algebraic(local[:, :2]), robust)
    if covariance is not None:
        explained = np.sum((size[1:] / unit) ** 2) - np.sum(_distances(values, local) ** 2)
        if explained < 2 * _BENDS * noise**2:
            raise _straight(f"a scatter of {noise * unit:.3g} about an arc {np.ptp(local[:, 1]) * unit:.3g} deep")
    angles, sign = _angles(values, local)
    normal = _normal(values[3:5])
    offset = local - values[:3]
    axial = offset @ normal / values[5]
    radial = np.linalg.norm(offset - np.outer(offset @ normal, normal), axis=1) / values[5] - 1.0
    sigma = None if covariance is None else _arc_sigma(values, local, covariance, noise)
    # The rows of the basis may be a reflection; angles are measured in the world's own handedness.
    axis = sign * float(np.linalg.det(basis)) * (normal @ basis)
    fit_centre, radius = middle + unit * (values[:3] @ basis), unit * float(values[5])
    return CircleFit(
        centre=fit_centre,
        axis=axis,
        radius=radius,
        angles=angles,
        radial=radial,
        axial=sign * float(np.linalg.det(basis)) * axial,
        arc_sigma=sigma,
        closure_gap=None if expected_turn is None else _gap(points, fit_centre, axis, radius, expected_turn),
        remark=_remark(float(angles[-1]), sigma),
    )


def circle_errors(found: Scene, truth: Scene) -> CircleErrors:
    """Compare cameras on a circle with true poses, frames matched by name.

    Raises
    ------
    StageError
        Where fewer than three frames have both poses, or they lie on a line.
    """
    errors = trajectory_errors(found, truth, "sim3")
    mine = fit_circle(found.centres(found.frame(name) for name in errors.names))
    true = fit_circle(truth.centres(truth.frame(name) for name in errors.names))
    difference = mine.angles - true.angles
    return CircleErrors(
        errors.names,
        errors.position / true.radius,
        errors.rotation_deg,
        difference - difference.mean(),
        mine.arc_degrees - true.arc_degrees,
    )


def _straight(found: str) -> StageError:
    return StageError(
        "The camera centres lie on a line, not on a circle",
        expected="an arc that bends by more than the scatter of the centres",
        found=found,
        todo="Use a longer segment",
    )


def _algebraic(plane: Array) -> Array:
    """Return x, y and radius of the circle with the least algebraic distance to points (n, 2)."""
    design = np.column_stack([2 * plane, np.ones(len(plane))])
    x, y, rest = np.linalg.lstsq(design, np.sum(plane**2, axis=1), rcond=None)[0]
    return np.array([x, y, math.sqrt(max(rest + x * x + y * y, 1e-300))])


def _normal(tilt: Array) -> Array:
    normal = np.array([tilt[0], tilt[1], 1.0])
    return normal / np.linalg.norm(normal)


def _distances(values: Array, local: Array) -> Array:
    """Return radial, then axial distances (2n,) of points from a circle (centre 3, tilt 2, radius 1)."""
    offset, normal = local - values[:3], _normal(values[3:5])
    axial = offset @ normal
    radial = np.linalg.norm(offset - np.outer(axial, normal), axis=1) - values[5]
    return np.concatenate([radial, axial])


def _refined(local: Array, start: Array, robust: bool) -> tuple[Array, Array | None, float]:
    """Return the circle, its covariance (None for three points, which fit exactly) and a distance's scatter."""
    from scipy.optimize import least_squares

    values = np.array([start[0], start[1], 0.0, 0.0, 0.0, start[2]])
    for loss in ("linear", "cauchy", "cauchy", "cauchy") if robust else ("linear",):
        residuals = _distances(values, local)
        scale = max(_CAUCHY * 1.4826 * float(np.median(np.abs(residuals))), 1e-12)
        found = least_squares(_distances, values, args=(local,), loss=loss, f_scale=scale, x_scale="jac")
        values = found.x
    freedom = 2 * len(local) - 6
    if freedom <= 0:
        return values, None, 0.0
    residuals = _distances(values, local)
    if robust:
        noise = 1.4826 * float(np.median(np.abs(residuals)))
    else:
        noise = math.sqrt(float(residuals @ residuals) / freedom)
    return values, noise**2 * np.linalg.pinv(found.jac.T @ found.jac), noise


def across(axis: Array) -> Array:
    """Return two unit vectors (2, 3) that make a right-handed frame with ``axis`` as its third."""
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = np.cross(helper, axis)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first)])


def _angles(values: Array, local: Array) -> tuple[Array, float]:
    """Return unwrapped angles in degrees that end above where they began, and the sign of the normal for it."""
    flat = (local - values[:3]) @ across(_normal(values[3:5])).T
    angles = np.degrees(np.unwrap(np.arctan2(flat[:, 1], flat[:, 0])))
    angles -= angles[0]
    sign = -1.0 if angles[-1] < 0 else 1.0
    return sign * angles, sign


def _arc_sigma(values: Array, local: Array, covariance: Array, noise: float) -> float:
    """Return the arc's standard deviation in degrees: of the circle, and of the two ends along it."""
    step = 1e-6
    gradient = np.array(
        [
            (_angles(values + delta, local)[0][-1] - _angles(values - delta, local)[0][-1]) / (2 * step)
            for delta in step * np.eye(6)
        ]
    )
    ends = 2.0 * math.degrees(noise / float(values[5])) ** 2
    return math.sqrt(max(float(gradient @ covariance @ gradient), 0.0) + ends)


def _gap(points: Array, centre: Array, axis: Array, radius: float, expected_turn: float) -> float:
    """Return the distance of the last point from the first one turned, as a part of the circumference."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(math.radians(expected_turn) * axis)
    place = centre + turn.apply(points[0] - centre)
    return float(np.linalg.norm(points[-1] - place)) / (2 * math.pi * radius)


def _remark(arc: float, sigma: float | None) -> str:
    if sigma is None:
        return "three centres fit a circle exactly: how well it is known cannot be told"
    if sigma > _LOOSE * arc or arc < _SHORT:
        return f"an arc of {arc:.2f} degrees is known to +- {sigma:.2f} degrees only"
    return ""
