"""ORB features of a picture, spread over it, with what the lens does to each of them (Rublee et al., ICCV 2011)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.optional import require
from toolkit.scene.pictures import load_picture

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SCALE_FACTOR = 1.2
"""Size ratio of one pyramid level to the next."""
LEVELS = 8
"""Levels of the pyramid."""
_BORDER = 19  # pixels of a level, within which the descriptor's pattern may leave the picture
_CELL = 32  # pixels; features are shared out among cells of this size
_SURPLUS = 2  # features found for each one that is kept
_WIDEST = np.tan(np.radians(75.0))  # farther off the axis a ray is of no use on an image plane


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints of one picture.

    Attributes
    ----------
    pixels:
        (N, 2) positions in the picture, pixel centres at +0.5.
    plane:
        (N, 2) the same without distortion, on the plane at depth one before the camera.
    sigma:
        (N,) standard deviation of ``plane``: one pixel of the pyramid level, on that plane.
    octave:
        (N,) pyramid level.
    descriptors:
        (N, 32) bytes.
    """

    pixels: Array
    plane: Array
    sigma: Array
    octave: Indices
    descriptors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.pixels)

    @cached_property
    def tree(self) -> cKDTree:
        """For searches around a pixel."""
        return cKDTree(self.pixels)


class OrbExtractor:
    """Finds ORB features in pictures of one camera.

    Parameters
    ----------
    camera:
        Its distortion is taken out of the keypoints.
    count:
        Most features of a picture.
    threshold:
        Grey levels by which FAST wants a corner to differ from its surroundings.

    Raises
    ------
    MissingDependencyError
        Without OpenCV.
    """

    def __init__(self, camera: ColmapCamera, count: int, threshold: int) -> None:
        self._cv2 = require("cv2")
        self._camera, self._count = camera, count
        self._orb: Any = self._cv2.ORB_create(
            nfeatures=_SURPLUS * count,
            scaleFactor=SCALE_FACTOR,
            nlevels=LEVELS,
            edgeThreshold=_BORDER,
            fastThreshold=threshold,
        )

    def __call__(self, grey: NDArray[np.uint8]) -> Features:
        """Return the features of a picture (H, W), the strongest of each part of it first."""
        keypoints, descriptors = self._orb.detectAndCompute(grey, None)
        if not keypoints:
            return Features(
                np.zeros((0, 2)),
                np.zeros((0, 2)),
                np.zeros(0),
                np.zeros(0, np.int64),
                np.zeros((0, 32), np.uint8),
            )
        table = np.array([(*point.pt, point.octave, point.response) for point in keypoints])
        kept = self._spread(table[:, :2], table[:, 3])
        octave = table[kept, 2].astype(np.int64)
        # OpenCV puts pixel centres at whole numbers, and multiplies the position in a level by its scale: the
        # half pixel that is missing is one of the level.
        pixels = table[kept, :2] + 0.5 * (SCALE_FACTOR**octave)[:, None]
        plane, stretch = self._to_plane(pixels)
        usable = np.flatnonzero(np.isfinite(stretch) & (np.abs(plane) < _WIDEST).all(axis=1))
        return Features(
            pixels[usable],
            plane[usable],
            (stretch * SCALE_FACTOR**octave)[usable],
            octave[usable],
            np.ascontiguousarray(descriptors[kept[usable]]),
        )

    def _spread(self, positions: Array, strength: Array) -> Indices:
        """Return the features to keep: from each cell its strongest, then its second, until there are enough."""
        columns = self._camera.width // _CELL + 1
        cell = (positions[:, 1] // _CELL).astype(np.int64) * columns + (positions[:, 0] // _CELL).astype(np.int64)
        by_cell = np.lexsort((-strength, cell))
        sorted_cells = cell[by_cell]
        rank = np.empty(len(cell), dtype=np.int64)
        rank[by_cell] = np.arange(len(cell)) - np.searchsorted(sorted_cells, sorted_cells)
        return np.lexsort((-strength, rank))[: self._count]

    def _to_plane(self, pixels: Array) -> tuple[Array, Array]:
        """Return positions (N, 2) on the plane at depth one and the size (N,) of a pixel there."""
        plane = self._on_plane(pixels)
        if self._camera.is_pinhole:
            return plane, np.full(len(plane), 1.0 / self._camera.to_pycolmap().mean_focal_length())
        right = self._on_plane(pixels + np.array([1.0, 0.0])) - plane
        down = self._on_plane(pixels + np.array([0.0, 1.0])) - plane
        area = np.abs(right[:, 0] * down[:, 1] - right[:, 1] * down[:, 0])
        return plane, np.sqrt(area)

    def _on_plane(self, pixels: Array) -> Array:
        directions = self._camera.ray(pixels)[1]
        plane: Array = directions[:, :2] / directions[:, 2:]
        return plane


def read_grey(path: Path, camera: ColmapCamera) -> NDArray[np.uint8]:
    """Return a picture as grey levels (H, W), as it is stored.

    Raises
    ------
    DataError
        Where it is missing, damaged or not of the camera's size.
    """
    colour = load_picture(path)
    if colour.shape[:2] != (camera.height, camera.width):
        raise DataError(
            f"Picture {path} does not fit the camera",
            expected=f"{camera.width}x{camera.height} pixels",
            found=f"{colour.shape[1]}x{colour.shape[0]}",
            todo="Give the camera of these pictures, or scale it with ColmapCamera.scaled",
        )
    cv2 = require("cv2")
    grey: NDArray[np.uint8] = cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)
    return grey
