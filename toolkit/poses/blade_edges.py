"""Straight edges as a measure of distortion: the plumb-line method, alone and joined with a bundle adjustment.

Blade-inspection-sfm suggests that the straight edges of blades assist the calibration (section 5). An edge that is
straight in the world lies, seen by a central camera, in one plane through the camera's centre: the rays of its
pixels are perpendicular to one direction (Brown 1971, "Close-range camera calibration", in terms of rays, so that
wide views need no picture plane). Which edges are straight only the user knows; that they are parallel is not used,
since the edges of a rotor's blades are not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.errors import DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.settings import Integer, Number, Settings

Array = NDArray[np.float64]


class EdgeSettings(Settings):
    """Finding of long edges."""

    low = Number(40.0, bounds=(0.0, 2000.0), doc="Canny's lower threshold of the gradient of grey values 0 to 255.")
    high = Number(120.0, bounds=(0.0, 2000.0), doc="Its upper threshold.")
    blur = Number(1.0, bounds=(0.0, 20.0), unit="px", doc="Standard deviation of the smoothing before.")
    min_length = Integer(60, bounds=(10, 100000), unit="px", doc="Shorter pieces are not used.")
    max_bend = Number(
        0.15,
        bounds=(0.0, 0.5),
        doc="Pieces that leave their chord by more than this part of its length are no straight edges.",
    )
    direction = Number(
        90.0,
        bounds=(-180.0, 180.0),
        unit="degrees",
        doc="Direction of the edges in the picture: 0 along its rows, 90 along its columns.",
    )
    spread = Number(
        90.0,
        bounds=(0.0, 90.0),
        unit="degrees",
        doc="Edges whose chord is farther from that direction are not used (blade tips and the hub are arcs); 90: "
        "all are.",
    )
    tolerance = Number(
        0.7, bounds=(0.05, 10.0), unit="px", doc="A piece ends where it leaves the parabola through it by more."
    )


@dataclass(frozen=True, slots=True, eq=False)
class EdgeFit:
    """A lens by which edges are straight.

    Attributes
    ----------
    camera:
        With the distortion that was found.
    edges:
        Number of edges.
    before, after:
        Robust spread of the pixels' distances from the image of their straight edge, in pixels.
    sigma:
        Standard deviation of each free parameter, in the order of ``parameters``; None where the edges do not
        determine them.
    parameters:
        Places of the free parameters in the camera's.
    converged:
        Whether the search ended by itself.
    """

    camera: ColmapCamera
    edges: int
    before: float
    after: float
    sigma: tuple[float, ...] | None
    parameters: tuple[int, ...]
    converged: bool

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "model": self.camera.model,
            "params": list(self.camera.params),
            "edges": self.edges,
            "before": self.before,
            "after": self.after,
            "sigma": None if self.sigma is None else list(self.sigma),
            "parameters": list(self.parameters),
            "converged": self.converged,
        }


def find_edges(
    picture: NDArray[np.uint8], settings: EdgeSettings, *, mask: NDArray[np.bool_] | None = None
) -> list[Array]:
    """Return long smooth edges, each (N, 2) pixels in order along it, to a part of a pixel.

    Canny's edges are followed, cut where they branch or turn, and moved along the gradient to its maximum.

    Parameters
    ----------
    picture:
        (H, W, 3) or (H, W), as it was taken: distorted.
    settings:
        As declared.
    mask:
        (H, W), False where no edges are wanted (what does not turn).

    Raises
    ------
    DataError
        For a picture or a mask of another shape.
    """
    import cv2

    if picture.ndim not in (2, 3) or (mask is not None and mask.shape != picture.shape[:2]):
        raise DataError(
            "Cannot look for edges",
            expected="a picture (H, W, 3) or (H, W), and a mask (H, W)",
            found=f"{picture.shape} and {None if mask is None else mask.shape}",
        )
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) if picture.ndim == 3 else picture
    if settings.blur > 0:
        grey = cv2.GaussianBlur(grey, (0, 0), settings.blur)
    across = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3)
    down = cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=3)
    # Thresholds are of grey values a pixel; Sobel's kernel sums to eight of them.
    found = cv2.Canny(
        (across * 2).astype(np.int16),
        (down * 2).astype(np.int16),
        2 * settings.low,
        2 * settings.high,
        L2gradient=True,
    )
    edges = found > 0
    if mask is not None:
        edges &= mask
    strength = np.hypot(across, down)
    pieces = []
    for chain in _chains(edges):
        line = _refined(chain, across, down, strength)
        pieces += _smooth_pieces(line, settings)
    return pieces


def straighten(edges: Sequence[Array], camera: ColmapCamera) -> EdgeFit:
    """Find the distortion by which most edges are straight, with focal length and principal point kept.

    Edges that stay bent, by more than 3 times the median of all, are left out and the rest is fitted again.

    Straight lines stay straight where all tangents of the angles from the axis are stretched by one factor, so they
    tell no focal length: with a wrong one the rays are those of the stretched view.

    Parameters
    ----------
    edges:
        Each (N, 2) pixels of something straight, N at least 8.
    camera:
        To start from; of a model with distortion.

    Raises
    ------
    StageError
        For no edges that are long enough, and a model without distortion.
    """
    from scipy.optimize import least_squares

    known = camera.to_pycolmap()
    free = list(known.extra_params_idxs())
    used = [np.asarray(edge, dtype=np.float64) for edge in edges if len(edge) >= _LEAST_POINTS]
    if not free or not used:
        raise StageError(
            "Straight edges cannot tell the distortion",
            expected=f"a camera model with distortion, and edges of {_LEAST_POINTS} points",
            found=f"{camera.model} and {len(used)} edges",
        )
    start = np.array(camera.params)

    def changed(values: Array) -> pycolmap.Camera:
        params = start.copy()
        params[free] = values
        made = camera.to_pycolmap()
        made.params = params.tolist()
        return made

    def bent(values: Array) -> Array:
        return edge_residuals(changed(values), used)

    first = start[free]
    before = edge_spread(bent(first))
    scale = max(_LOSS * before, 1e-3)
    for _ in range(_REWEIGHTS):
        found = least_squares(bent, first, loss="cauchy", f_scale=scale, x_scale="jac", max_nfev=_STEPS)
        first = found.x
        used = straight_ones(changed(first), used)
        scale = max(_LOSS * edge_spread(bent(first)), 1e-3)
    after = edge_spread(bent(first))
    return EdgeFit(
        camera=ColmapCamera.from_pycolmap(changed(first)),
        edges=len(used),
        before=before,
        after=after,
        sigma=_sigma(found.jac, after),
        parameters=tuple(int(place) for place in free),
        converged=bool(found.status > 0),
    )


def edge_residuals(camera: pycolmap.Camera, edges: Sequence[Array]) -> Array:
    """Return the distances in pixels (M,) of all pixels of edges from the images of their straight edges.

    To first order: the distance of the ray from the edge's plane over its change from pixel to pixel (Sampson). The
    plane of each edge is the best one for the lens at hand, so no parameters stand for it.
    """
    pixels = np.concatenate(list(edges))
    rays = _directions(camera, pixels)
    right = (_directions(camera, pixels + np.array([_PIXEL, 0.0])) - rays) / _PIXEL
    below = (_directions(camera, pixels + np.array([0.0, _PIXEL])) - rays) / _PIXEL
    ends = np.cumsum([len(edge) for edge in edges])
    found = np.zeros(len(pixels))
    for start, end in zip(np.concatenate([[0], ends[:-1]]), ends, strict=True):
        here = slice(int(start), int(end))
        normal = np.linalg.svd(rays[here], full_matrices=False)[2][2]
        slope = np.hypot(right[here] @ normal, below[here] @ normal)
        found[here] = (rays[here] @ normal) / np.maximum(slope, 1e-12)
    return np.clip(np.nan_to_num(found, nan=_WORST, posinf=_WORST, neginf=-_WORST), -_WORST, _WORST)


def straight_ones(camera: pycolmap.Camera, edges: Sequence[Array]) -> list[Array]:
    """Return the edges whose distance from a straight one (RMS) is at most 3 times the median of all edges'."""
    bend = np.array([math.sqrt(float(np.mean(np.square(edge_residuals(camera, [edge]))))) for edge in edges])
    return [edge for edge, own in zip(edges, bend, strict=True) if own <= _BENT * np.median(bend)]


def edge_spread(residuals: Array) -> float:
    """Return the robust standard deviation of the distances, 1.4826 times their median length."""
    return 1.4826 * float(np.median(np.abs(residuals)))


def _directions(camera: pycolmap.Camera, pixels: Array) -> Array:
    plane = np.asarray(camera.cam_from_img(pixels)).reshape(-1, 2)
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    unit: Array = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return np.nan_to_num(unit)


def _sigma(jacobian: Array, noise: float) -> tuple[float, ...] | None:
    """Return standard deviations of the parameters for independent pixels; None where they are not determined."""
    normal = jacobian.T @ jacobian
    scale = np.sqrt(np.diagonal(normal))
    if not (scale > 0).all() or np.linalg.cond(normal / np.outer(scale, scale)) > _SINGULAR:
        return None
    variance = np.diagonal(np.linalg.inv(normal / np.outer(scale, scale))) / scale**2
    return tuple(float(value) for value in noise * np.sqrt(variance))


def _chains(edges: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """Return the paths (N, 2) of row and column between ends and branches of thin edges."""
    import cv2

    thin = edges.astype(np.uint8)
    neighbours = cv2.filter2D(thin, cv2.CV_8U, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT) - thin
    thin[(neighbours > 2) & (thin > 0)] = 0
    left = {(int(row), int(column)) for row, column in zip(*np.nonzero(thin), strict=True)}
    found = []
    while left:
        path = [left.pop()]
        for end in (0, -1):
            while (step := _next(path[end], left)) is not None:
                left.remove(step)
                path.insert(0, step) if end == 0 else path.append(step)
        found.append(np.array(path, dtype=np.int64))
    return found


def _next(place: tuple[int, int], left: set[tuple[int, int]]) -> tuple[int, int] | None:
    row, column = place
    for down, right in ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        if (row + down, column + right) in left:
            return row + down, column + right
    return None


def _refined(chain: NDArray[np.int64], across: Any, down: Any, strength: Any) -> Array:
    """Return pixels (N, 2), x and y, at the maximum of the gradient's strength along its direction."""
    import cv2

    row, column = chain.T
    direction = np.stack([across[row, column], down[row, column]], axis=1).astype(np.float64)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    places = [chain[:, ::-1] + side * direction for side in (-1.0, 0.0, 1.0)]
    before, here, after = (
        cv2.remap(strength, place[:, :1].astype(np.float32), place[:, 1:].astype(np.float32), cv2.INTER_LINEAR)[
            :, 0
        ].astype(np.float64)
        for place in places
    )
    # The vertex of the parabola through three samples of the gradient.
    bend = before - 2.0 * here + after
    shift = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)
    # Index i of a pixel is its centre, which lies at i + 0.5.
    return chain[:, ::-1] + 0.5 + np.clip(shift, -1.0, 1.0)[:, None] * direction


def _smooth_pieces(line: Array, settings: EdgeSettings) -> list[Array]:
    """Return the parts of a path that are long and nearly parabolas: the images of straight edges are."""
    waiting, found = [line], []
    while waiting:
        piece = waiting.pop()
        if len(piece) < max(settings.min_length // 2, _LEAST_POINTS):
            continue
        chord = piece[-1] - piece[0]
        length = float(np.linalg.norm(chord))
        if length < 1e-6:
            waiting += [piece[: len(piece) // 2], piece[len(piece) // 2 :]]
            continue
        along = (piece - piece[0]) @ chord / length
        off = (piece - piece[0]) @ np.array([-chord[1], chord[0]]) / length
        miss = np.abs(off - np.polyval(np.polyfit(along / length, off, 2), along / length))
        worst = int(np.argmax(miss))
        if miss[worst] > settings.tolerance:
            cut = min(max(worst, _LEAST_POINTS), len(piece) - _LEAST_POINTS)
            waiting += [piece[:cut], piece[cut:]]
        elif (
            length >= settings.min_length
            and np.abs(off).max() <= settings.max_bend * length
            and abs(np.sin(np.arctan2(chord[1], chord[0]) - math.radians(settings.direction)))
            <= math.sin(math.radians(settings.spread))
        ):
            found.append(piece)
    return found


# An edge needs more points than its line has parameters, by far.
_LEAST_POINTS = 8
# Step of a finite difference across a pixel.
_PIXEL = 1e-3
# Distance in pixels of what has no ray.
_WORST = 100.0
# Edges that bend by so many times the median of all are not straight.
_BENT = 3.0
# Residuals beyond so many standard deviations lose their weight.
_LOSS = 2.0
_REWEIGHTS = 3
_STEPS = 100
# Condition of the normal equations above which the parameters are not determined.
_SINGULAR = 1e12
