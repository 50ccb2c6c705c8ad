"""Which matched heights are trusted, and what stands where none is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from toolkit.depth.height_settings import HeightFillSettings
from toolkit.errors import StageError

Image = NDArray[np.float32]


def trusted_heights(heights: Image, confidence: Image, settings: HeightFillSettings) -> Image:
    """Return the heights (rows, columns) with NaN where they are not trusted, by their confidence and company."""
    kept = np.where(confidence >= settings.min_confidence, heights, np.nan).astype(np.float32)
    if settings.min_island > 0:
        kept[~_large_pieces(kept, settings.similar, settings.min_island)] = np.nan
    return kept


def _large_pieces(heights: Image, similar: float, least: int) -> NDArray[np.bool_]:
    """Return which cells belong to connected pieces of similar height with so many cells."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    number = np.arange(heights.size).reshape(heights.shape)
    pairs = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        joined = np.abs(heights[a] - heights[b]) < similar
        pairs.append(np.stack([number[a][joined], number[b][joined]]))
    first, second = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(first), bool), (first, second)), shape=(heights.size, heights.size))
    label = connected_components(graph, directed=False)[1]
    known = np.isfinite(heights)
    return known & (np.bincount(label)[label].reshape(heights.shape) >= least)


def fill_low(heights: Image, percentile: float = 10.0) -> Image:
    """Return heights with every hole filled by a low height of its rim.

    What no two views saw is mostly ground beside a wall, so that the rim's low side is the better guess.

    Raises
    ------
    StageError
        Where no height is known.
    """
    holes = np.isnan(heights)
    if holes.all():
        raise StageError("No height is known", expected="some cells that two views agree on", found="none")
    label, _ = ndimage.label(holes, np.ones((3, 3)))
    filled = heights.copy()
    for number, box in enumerate(ndimage.find_objects(label), start=1):
        grown = tuple(slice(max(0, side.start - 1), side.stop + 1) for side in box)
        inside = label[grown] == number
        rim = ndimage.binary_dilation(inside, np.ones((3, 3))) & ~holes[grown]
        filled[grown][inside] = np.percentile(heights[grown][rim], percentile)
    return filled


def smoothed(heights: Image, side: int) -> Image:
    """Return the known heights (rows, columns) behind a median filter; NaN stays."""
    if side == 1:
        return heights
    holes = np.isnan(heights)
    near = ndimage.distance_transform_edt(holes, return_distances=False, return_indices=True)
    smooth = ndimage.median_filter(heights[tuple(near)], side).astype(np.float32)
    smooth[holes] = np.nan
    return smooth
