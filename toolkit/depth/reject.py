"""Which pixels of a depth map are rejected before fusion, each for its first reason, and how many."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray
from scipy import ndimage

from toolkit.depth.patchmatch import PlaneMaps, StereoView, pinhole_of, relations
from toolkit.depth.patchmatch_cost import miss_in_view
from toolkit.depth.stereo_settings import RejectSettings
from toolkit.geometry.compiled import launching, parallel_kernel

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
_AnyArray = np.ndarray[Any, Any]


@parallel_kernel
def _count_views(
    depth: _AnyArray,
    other: _AnyArray,  # (N,) float32 depth of one view, row by row
    height: int,
    width: int,
    forward: _AnyArray,
    backward: _AnyArray,
    pixels: float,
    relative: float,
    counts: _AnyArray,  # (H, W) uint8, counted up where the view confirms
) -> None:
    for row in prange(depth.shape[0]):
        for column in range(depth.shape[1]):
            if depth[row, column] > 0.0:
                miss, off = miss_in_view(
                    column + 0.5, row + 0.5, depth[row, column], forward, backward, other, 0, height, width
                )
                if 0.0 <= miss <= pixels and off <= relative:
                    counts[row, column] += np.uint8(1)


def confirmed_by(
    depth: Image, reference: StereoView, sources: Sequence[StereoView], settings: RejectSettings
) -> NDArray[np.uint8]:
    """Return by how many sources each pixel's depth (height, width) is confirmed.

    A source confirms a pixel whose point, projected into it and back by its own depth there, returns within
    ``settings.max_pixels``, and whose depth there differs by at most ``settings.max_depth`` percent (the
    forward-backward check of Schoenberger et al. 2016, ECCV, section 4).

    Parameters
    ----------
    sources:
        With their depth; those without confirm nothing.
    """
    counts = np.zeros(depth.shape, np.uint8)
    for source in sources:
        if source.depth is None:
            continue
        forward, backward = relations(reference, source)
        with launching():
            _count_views(
                np.ascontiguousarray(depth, np.float32),
                np.ascontiguousarray(source.depth.ravel(), np.float32),
                *source.depth.shape,
                forward,
                backward,
                settings.max_pixels,
                settings.max_depth / 100,
                counts,
            )
    return counts


def rejected_pixels(
    planes: PlaneMaps, reference: StereoView, sources: Sequence[StereoView], settings: RejectSettings
) -> tuple[Mask, dict[str, int]]:
    """Return which pixels (height, width) are kept, and how many were rejected for which reason.

    Reasons are asked in this order, and a pixel counts for the first that holds: ``masked`` (or too near to it),
    ``border``, ``texture``, ``confidence``, ``edge``, ``views``, ``island``. ``kept`` counts those that are left.

    Parameters
    ----------
    sources:
        With their depth before anything was rejected from it.
    """
    known = planes.depth > 0
    masked = np.isnan(reference.grey)
    if settings.mask_margin and masked.any():
        masked = ndimage.binary_dilation(masked, iterations=settings.mask_margin)
    unsure = planes.confidence < settings.min_confidence
    least = min(settings.min_views, len(sources))
    reasons: list[tuple[str, Mask]] = [
        ("masked", masked),
        ("border", border_pixels(known.shape, settings.border)),
        ("texture", ~known | (planes.texture < settings.min_texture)),
        ("confidence", unsure),
        ("edge", depth_edges(planes, reference, ~unsure, settings.edge / 100)),
        ("views", confirmed_by(planes.depth, reference, sources, settings) < least),
    ]
    kept = np.ones(known.shape, bool)
    counts: dict[str, int] = {}
    for name, holds in reasons:
        counts[name] = int((kept & holds).sum())
        kept &= ~holds
    small = small_islands(kept, settings.min_island)
    counts["island"] = int(small.sum())
    kept &= ~small
    counts["kept"] = int(kept.sum())
    return kept, counts


def border_pixels(shape: tuple[int, ...], border: int) -> Mask:
    """Return which pixels of a picture (height, width) are less than ``border`` pixels from its border."""
    near = np.ones(shape, bool)
    if 2 * border < min(shape):
        near[border : shape[0] - border, border : shape[1] - border] = False
    return near


def depth_edges(planes: PlaneMaps, reference: StereoView, trusted: Mask, step: float) -> Mask:
    """Return which pixels (height, width) lie at a step of depth.

    There the depth of one of four neighbours is off the pixel's own plane by more than ``step`` (relative), so that
    slanted surfaces have no steps. Only ``trusted`` neighbours count. Nothing is an edge where ``step`` is 0.
    """
    height, width = planes.depth.shape
    found = np.zeros((height, width), bool)
    if step <= 0:
        return found
    fx, fy, cx, cy = pinhole_of(reference)
    rows, columns = np.indices((height, width))
    rays = np.stack([(columns + 0.5 - cx) / fx, (rows + 0.5 - cy) / fy, np.ones((height, width))], axis=2)
    distance = planes.depth * (planes.normals * rays).sum(axis=2)
    for down, right in ((0, 1), (1, 0)):
        here = np.s_[: height - down, : width - right]
        there = np.s_[down:, right:]
        for mine, other in ((here, there), (there, here)):
            along = (planes.normals[mine] * rays[other]).sum(axis=2)
            with np.errstate(divide="ignore", invalid="ignore"):
                expected = distance[mine] / along
                off = np.abs(planes.depth[other] / expected - 1)
            found[mine] |= trusted[other] & (planes.depth[other] > 0) & ~(off <= step)
    return found


def small_islands(kept: Mask, least: int) -> Mask:
    """Return which kept pixels (height, width) belong to fewer than ``least`` that hang together (4 neighbours)."""
    if least <= 1:
        return np.zeros_like(kept)
    labels, _ = ndimage.label(kept)
    small: Mask = kept & (np.bincount(labels.ravel())[labels] < least)
    return small
