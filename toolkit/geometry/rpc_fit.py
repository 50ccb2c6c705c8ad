"""Fits: an RPC to a rigorous camera, and affine and perspective cameras to an RPC over a stated volume."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.rpc import Rpc
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.geometry.rpc_perspective import distant_pinhole, pinhole_pixels, pinhole_slopes, turned_rotation
from toolkit.geometry.rpc_terms import TERMS, terms

Array = NDArray[np.float64]

#: Two quotients of cubics, the denominators' first coefficient being 1.
_UNKNOWNS = 2 * len(TERMS) - 1
#: Strengths of regularisation to choose from, as parts of the largest singular value.
_STRENGTHS = 10.0 ** np.arange(-12.0, -0.4, 0.5)
#: Steps of the fit: cubic quotients of satellites stand still after three.
_ROUNDS = 6
#: Samples of a box in east, north and up.
_SAMPLES = (9, 9, 5)
#: How far a perspective camera may be in metres; the nearest is this many times the box's size.
_FARTHEST, _NEAREST_BOXES = 1e7, 10.0
#: Pixels (root mean square) that a change of the optical axis by a tangent of one has to gain.
_ASIDE_PX = 0.1


@dataclass(frozen=True)
class RpcFit:
    """An RPC fitted to pixels and places.

    Attributes
    ----------
    rpc:
        The polynomials.
    rms_px, max_px:
        Root mean square and greatest distance in pixels between the given pixels and those of the RPC.
    """

    rpc: Rpc
    rms_px: float
    max_px: float

    def to_dict(self) -> dict[str, Any]:
        """Return the residuals."""
        return {"rms_px": self.rms_px, "max_px": self.max_px}


@dataclass(frozen=True)
class LocalCamera:
    """A simpler camera that stands for an RPC over a box.

    Attributes
    ----------
    camera:
        The affine or perspective camera.
    cam_from_world:
        Its pose; the world is the RPC camera's metres east, north and up.
    rms_px, max_px:
        Root mean square and greatest distance in pixels from the RPC camera over a grid that fills the box.
    """

    camera: AffineCamera | ColmapCamera
    cam_from_world: RigidTransform
    rms_px: float
    max_px: float

    def to_dict(self) -> dict[str, Any]:
        """Return the residuals, the distance of the camera's origin from the world's in metres, and its kind."""
        return {
            "kind": "affine" if isinstance(self.camera, AffineCamera) else "perspective",
            "rms_px": self.rms_px,
            "max_px": self.max_px,
            "distance_m": float(np.linalg.norm(self.cam_from_world.translation)),
        }


def fit_rpc(pixels: ArrayLike, geodetic: ArrayLike) -> RpcFit:
    """Fit an RPC to where a rigorous camera sees places.

    Each coordinate's 39 coefficients come from Gauss-Newton steps on the distance in pixels, with a regularisation
    (Tao and Hu, Photogrammetric Engineering and Remote Sensing 67(12), 2001) that generalised cross-validation
    doses. Offsets and scales span what is given, and so does the RPC's range of heights.

    Parameters
    ----------
    pixels:
        (N, 2) x and y, +0.5 at the centre of a pixel.
    geodetic:
        (N, 3) latitude and longitude in degrees, height in metres: best on a grid over picture and heights.

    Raises
    ------
    DataError
        For fewer points than unknowns, values that are not finite and points all of one latitude, longitude or
        height.
    """
    uv = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
    ground = np.asarray(geodetic, dtype=np.float64).reshape(-1, 3)
    if len(uv) != len(ground) or len(uv) < _UNKNOWNS:
        raise DataError(
            "Too few points to fit an RPC",
            expected=f"as many pixels as places, at least {_UNKNOWNS}",
            found=f"{len(uv)} pixels and {len(ground)} places",
        )
    if not (np.isfinite(uv).all() and np.isfinite(ground).all()):
        raise DataError("Pixels or places to fit an RPC to are not finite")
    offsets, scales = _span(np.concatenate([uv - 0.5, ground], axis=1))
    names = ("sample", "line", "latitude", "longitude", "height")
    for name, scale in zip(names, scales, strict=True):
        if not scale > 0:
            raise DataError(
                f"An RPC cannot be fitted to points of one {name}",
                expected="points that fill a volume: several heights, and an area at each",
            )
    image = (uv - 0.5 - offsets[:2]) / scales[:2]
    values = terms(((ground - offsets[2:]) / scales[2:])[:, [1, 0, 2]].T).T
    x_num, x_den = _fit_quotient(values, image[:, 0])
    y_num, y_den = _fit_quotient(values, image[:, 1])
    rpc = Rpc(
        line_num=tuple(y_num),
        line_den=tuple(y_den),
        sample_num=tuple(x_num),
        sample_den=tuple(x_den),
        **{f"{name}_offset": float(value) for name, value in zip(names, offsets, strict=True)},
        **{f"{name}_scale": float(value) for name, value in zip(names, scales, strict=True)},
    )
    return RpcFit(rpc, *_distances(rpc.project(ground), uv))


def fit_affine_camera(camera: RpcCamera, box: ArrayLike) -> LocalCamera:
    """Fit an affine camera to an RPC over a box, by linear least squares in pixels.

    Its origin is the box's middle: depths are metres from the plane through it.

    Parameters
    ----------
    camera:
        The RPC camera; the fitted one has its image size.
    box:
        (2, 3) lower and upper corner in metres east, north and up.

    Raises
    ------
    DataError
        For a box that is not one, a picture that is mirrored, and what :meth:`RpcCamera.project` raises.
    """
    points, pixels = _sampled(camera, box)
    middle = points.mean(axis=0)
    # Columns of equal size make the equations well conditioned.
    size = np.ptp(points, axis=0)
    rows = np.linalg.lstsq(np.concatenate([(points - middle) / size, np.ones((len(points), 1))], axis=1), pixels)[
        0
    ].T
    matrix = np.concatenate([rows[:, :3] / size, rows[:, 3:]], axis=1)
    matrix[:, 3] -= matrix[:, :3] @ middle
    affine, cam_from_world = AffineCamera.from_matrix(matrix, camera.width, camera.height, middle)
    _, direction = camera.ray(pixels.mean(axis=0)[None])
    if cam_from_world.rotation[2] @ direction[0] < 0:
        raise DataError(
            "The RPC's picture is mirrored, which no rotated camera shows",
            expected="x to the right and y down as seen from the satellite",
            todo="Flip the picture and its RPC",
        )
    fitted = affine.project(cam_from_world.apply(points))
    return LocalCamera(affine, cam_from_world, *_distances(fitted, pixels))


def fit_perspective_camera(camera: RpcCamera, box: ArrayLike) -> LocalCamera:
    """Fit a pinhole camera to an RPC over a box, by damped least squares in pixels.

    The ten unknowns are those of a camera seen from the box: pixel of its middle, pixels per metre there (2),
    rotation (3), tangents of the angles between optical axis and line of sight (2) and the inverse of the distance.
    All are of moderate size however far the camera is, and the start is the affine camera itself: its skew becomes
    an optical axis aside of the line of sight, so the principal point is usually outside the picture. As the axis
    is hardly determined by what is left, it stays where it is unless going 0.1 aside gains 0.01 px.

    A picture taken line by line is no perspective one along its track: the distance, at most 10,000 km, is what
    fits best, not where the satellite was.

    Arguments and errors are those of :func:`fit_affine_camera`; also :class:`DataError` where no optical axis makes
    up for the skew.
    """
    from scipy.optimize import least_squares

    points, pixels = _sampled(camera, box)
    away = points - points.mean(axis=0)
    size = float(np.abs(away).max())
    affine = fit_affine_camera(camera, box)
    assert isinstance(affine.camera, AffineCamera)
    start, rotation = distant_pinhole(affine.camera, affine.cam_from_world)
    # Units of the unknowns in which a step of one moves the box's far side by about its own width.
    units = np.array([size * start[2], size * start[2], start[2], start[3], *[1.0] * 5, 1.0 / size])
    lower, upper = np.full(10, -np.inf), np.full(10, np.inf)
    lower[2:4] = 0.0
    lower[9], upper[9] = 1.0 / _FARTHEST, 1.0 / (_NEAREST_BOXES * size)
    prior = np.zeros((2, 10))
    prior[[0, 1], [7, 8]] = _ASIDE_PX * np.sqrt(len(away))

    def miss(scaled: Array) -> Array:
        unknowns = scaled * units
        fitted = pinhole_pixels(unknowns, rotation, away)[0]
        return np.concatenate([(fitted - pixels).ravel(), prior @ (unknowns - start)])

    def slopes(scaled: Array) -> Array:
        own = pinhole_slopes(scaled * units, rotation, away).reshape(-1, 10)
        return np.concatenate([own, prior]) * units

    best = least_squares(miss, start / units, slopes, (lower / units, upper / units), x_scale="jac", ftol=1e-6).x
    best = best * units
    turned = turned_rotation(best, rotation)
    x, y, across, down = best[:4]
    tangent, distance = best[7:9], 1.0 / best[9]
    params = (
        across * distance,
        down * distance,
        x - across * distance * tangent[0],
        y - down * distance * tangent[1],
    )
    pinhole = ColmapCamera("PINHOLE", camera.width, camera.height, params)
    translation = distance * np.array([*tangent, 1.0]) - turned @ points.mean(axis=0)
    cam_from_world = RigidTransform(turned, translation)
    return LocalCamera(pinhole, cam_from_world, *_distances(pinhole.project(cam_from_world.apply(points)), pixels))


def _sampled(camera: RpcCamera, box: ArrayLike) -> tuple[Array, Array]:
    """Return points (N, 3) of a grid that fills a box and their pixels (N, 2)."""
    corners = np.asarray(box, dtype=np.float64)
    if corners.shape != (2, 3) or not np.isfinite(corners).all() or not (corners[1] > corners[0]).all():
        raise DataError(
            "Not a box to fit a camera over",
            expected="(2, 3) its lower and its upper corner in metres east, north and up",
            found=str(corners.tolist()),
        )
    steps = [np.linspace(low, high, count) for low, high, count in zip(*corners, _SAMPLES, strict=True)]
    points = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    pixels = camera.project(points)
    if not np.isfinite(pixels).all():
        raise DataError("The RPC camera does not see the whole box", expected="a box in the RPC's volume")
    return points, pixels


def _distances(fitted: Array, pixels: Array) -> tuple[float, float]:
    """Return root mean square and greatest distance between pixels."""
    distance = np.linalg.norm(fitted - pixels, axis=1)
    return float(np.sqrt(np.mean(distance**2))), float(distance.max())


def _span(columns: Array) -> tuple[Array, Array]:
    """Return the middle and half the span of each column."""
    low, high = columns.min(axis=0), columns.max(axis=0)
    return (low + high) / 2, (high - low) / 2


def _fit_quotient(values: Array, image: Array) -> tuple[Array, Array]:
    """Return numerator and denominator (20,) whose quotient over terms (N, 20) is nearest to coordinates (N,)."""
    numerator: Array = np.asarray(np.linalg.lstsq(values, image)[0], dtype=np.float64)
    unknowns = np.append(numerator, np.zeros(len(TERMS) - 1))
    below: Array = np.ones(len(image))
    for _ in range(_ROUNDS):
        quotient = (values @ unknowns[: len(TERMS)]) / below
        # Derivatives by the quotient, not by the given coordinate: its noise would pull the denominator to zero.
        slopes = np.concatenate([values, -quotient[:, None] * values[:, 1:]], axis=1) / below[:, None]
        unknowns = _regularised(slopes, image - quotient + slopes @ unknowns)
        below = 1.0 + values[:, 1:] @ unknowns[len(TERMS) :]
        if below.min() <= 0:
            raise DataError(
                "No RPC fits the points: its denominator changes its sign among them",
                expected="pixels of one camera from a distance",
                todo="Check that pixels and places belong together",
            )
    return unknowns[: len(TERMS)], np.append(1.0, unknowns[len(TERMS) :])


def _regularised(matrix: Array, right: Array) -> Array:
    """Return the solution of ridge regression, its strength chosen by generalised cross-validation.

    Points without noise get next to none; with noise it keeps the denominators from fitting that (Golub, Heath and
    Wahba, Technometrics 21(2), 1979). Of strengths that the validation cannot tell apart (the standard deviation of
    a variance from N numbers is sqrt(2 / N) of it) the largest is taken.
    """
    left, singular, rows = np.linalg.svd(matrix, full_matrices=False)
    along = left.T @ right
    outside = float(np.sum((right - left @ along) ** 2))
    kept = singular**2 / (singular**2 + (singular[0] * _STRENGTHS[:, None]) ** 2)
    squares = outside + (((1.0 - kept) * along) ** 2).sum(axis=1)
    validation = squares / (len(right) - kept.sum(axis=1)) ** 2
    best = int(np.flatnonzero(validation <= validation.min() * (1.0 + np.sqrt(2.0 / len(right))))[-1])
    solution: Array = rows.T @ (kept[best] * along / singular)
    return solution
