"""How much of a stated box views share: what they do not both see, no pair of them can measure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError, StageError
from toolkit.scene import Frame, Scene

Array = NDArray[np.float64]

#: Points of the grid along the box's two level sides and its height.
GRID = (32, 32, 3)


@dataclass(frozen=True, slots=True, eq=False)
class ViewOverlap:
    """What share of a box's volume views see, told from a grid of its points.

    Attributes
    ----------
    names:
        Of the n frames.
    shared:
        (n, n) share that both of two views see, 0 to 1; on the diagonal what one sees.
    """

    names: tuple[str, ...]
    shared: Array

    def to_dict(self) -> dict[str, Any]:
        """Return all of it, ready for JSON."""
        return {"names": list(self.names), "shared": self.shared.tolist()}


def view_overlap(scene: Scene, names: Sequence[str], box: ArrayLike) -> ViewOverlap:
    """Return how much of a box each pair of frames sees. What hides behind what is not looked at.

    Parameters
    ----------
    names:
        Of frames with poses; cameras of any kind.
    box:
        (2, 3) its lower and upper corner in world coordinates; the height may be the same.

    Raises
    ------
    DataError
        For a box that is none, a frame without pose, and a box that an RPC does not reach in height.
    """
    points = _grid(box)
    seen = np.array([_sees(scene, scene.frame(name), points) for name in names]).reshape(-1, len(points))
    together = seen.astype(np.float32)
    return ViewOverlap(tuple(names), (together @ together.T).astype(np.float64) / len(points))


def without_overlap(overlap: ViewOverlap, least: float, keep: Sequence[str] = ()) -> tuple[str, ...]:
    """Return which views must go, so that any two of those that stay share at least a part of the box.

    One by one that view goes which shares too little with most others; of several the one that sees least.

    Parameters
    ----------
    least:
        Share of the box, 0 to 1, that any two must both see, and each of them itself.
    keep:
        Names of views that must stay.

    Raises
    ------
    StageError
        Where views that must stay share too little, or one of them sees too little.
    """
    place = {name: index for index, name in enumerate(overlap.names)}
    apart = overlap.shared < least
    must = np.zeros(len(place), dtype=bool)
    must[[place[name] for name in keep]] = True
    among = np.argwhere(np.triu(apart & must & must[:, None]))
    if len(among):
        one, other = among[0]
        pair = sorted({overlap.names[one], overlap.names[other]})
        raise StageError(
            f"Views that must be chosen do not overlap: {' and '.join(pair)}",
            expected=f"{100 * least:g} % of the box in both",
            found=f"{100 * overlap.shared[one, other]:.3g} %",
            todo="Include other views, or lower min_overlap",
        )
    stays = np.ones(len(place), dtype=bool)
    while True:
        conflicts = np.where(stays & ~must, (apart & stays).sum(axis=1), 0)
        if not conflicts.any():
            return tuple(name for name, kept in zip(overlap.names, stays, strict=True) if not kept)
        worst = np.flatnonzero(conflicts == conflicts.max())
        stays[worst[np.argmin(np.diag(overlap.shared)[worst])]] = False


def _grid(box: ArrayLike) -> Array:
    """Return the points (P, 3): middles of the cells of a regular division of the box."""
    corners = np.asarray(box, dtype=np.float64)
    if corners.shape != (2, 3) or not np.isfinite(corners).all():
        raise DataError("The box is wrong", expected="finite lower and upper corner (2, 3)", found=repr(box))
    size = corners[1] - corners[0]
    if not (size[:2] > 0).all() or size[2] < 0:
        raise DataError(
            "The box has no ground",
            expected="an upper corner above the lower one in x and y, and not below it in z",
            found=f"{corners[0].tolist()} to {corners[1].tolist()}",
        )
    axes = [low + side * (np.arange(n) + 0.5) / n for low, side, n in zip(corners[0], size, GRID, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _sees(scene: Scene, frame: Frame, points: Array) -> NDArray[np.bool_]:
    """Return (P,) which points lie in the picture."""
    if frame.cam_from_world is None:
        raise DataError(f"Frame '{frame.name}' has no pose", todo="Leave it out")
    camera = scene.camera_of(frame)
    try:
        pixels = camera.project(frame.cam_from_world.apply(points))
    except DataError as error:
        raise DataError(f"The box cannot be projected into '{frame.name}': {error}") from error
    # Comparisons with NaN, of points without image, are false.
    inside = (pixels >= 0) & (pixels <= (camera.width, camera.height))
    return np.asarray(inside.all(axis=1))
