"""PatchMatch stereo with slanted windows for one picture and its source views, coarse to fine, on all cores."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.patchmatch_cost import WORST
from toolkit.depth.patchmatch_kernels import cost_planes, enlarged_planes, random_planes, search_colour
from toolkit.depth.stereo_settings import PatchMatchSettings
from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.compiled import launching
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene.pictures import area_resize

Array = NDArray[np.float64]
Image = NDArray[np.float32]

# The smallest size of a picture still has so many rows and columns.
_LEAST_SIDE = 24
_MORE_ROUNDS = 2  # at the smallest size, which starts at random
_PIXELS, _TURN = 4.0, 0.6  # first changes of a plane, in pixels and radians; each round halves them


@dataclass(frozen=True, slots=True)
class StereoView:
    """A picture with its camera, as stereo sees it.

    Attributes
    ----------
    grey:
        (height, width) float32 brightness, 0 to 1; NaN where a mask leaves the picture out.
    camera:
        PINHOLE or SIMPLE_PINHOLE, of the picture's size.
    cam_from_world:
        Pose.
    depth:
        (height, width) float32 what is known of its depth, 0 where nothing is; or None.
    """

    grey: Image
    camera: ColmapCamera
    cam_from_world: RigidTransform
    depth: Image | None = None

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        for values in (self.grey, self.depth):
            if values is not None and values.shape != size:
                raise DataError(
                    "A picture is not of its camera's size", expected=str(size), found=str(values.shape)
                )

    def smaller(self, factor: int) -> StereoView:
        """Return the view with a picture ``factor`` times smaller and no depth."""
        height, width = max(1, round(self.grey.shape[0] / factor)), max(1, round(self.grey.shape[1] / factor))
        # A pixel of which a part is masked is masked.
        return StereoView(
            area_resize(self.grey, width, height), self.camera.scaled(width, height), self.cam_from_world
        )


@dataclass(frozen=True, slots=True)
class PlaneMaps:
    """A plane at every pixel.

    Attributes
    ----------
    depth:
        (height, width) float32 z in scene units.
    normals:
        (height, width, 3) float32 in the camera's frame, facing it.
    cost:
        (height, width) float32: 1 - correlation, up to 2; infinite where masked.
    texture:
        (height, width) float32 weighted standard deviation of a window's brightness.
    """

    depth: Image
    normals: Image
    cost: Image
    texture: Image

    @property
    def confidence(self) -> Image:
        """(height, width) 1 where windows agree, 0 where they do not or nothing is known."""
        confidence: Image = np.clip(1 - self.cost, 0, 1).astype(np.float32)
        return confidence


def patch_match(
    reference: StereoView,
    sources: Sequence[StereoView],
    depth_range: tuple[float, float],
    settings: PatchMatchSettings,
    *,
    seed: int = 0,
    start: PlaneMaps | None = None,
) -> PlaneMaps:
    """Return the plane at each pixel that looks most alike in the source views.

    Parameters
    ----------
    sources:
        At least one. With ``start`` their depth, where known, counts by ``settings.geometric_weight``.
    depth_range:
        Nearest and farthest z.
    seed:
        Of all random choices: the same seed gives the same planes whatever the number of threads.
    start:
        Planes to begin with: they are refined at full size only, less boldly.
    """
    if not sources:
        raise DataError("There is no view to compare a picture with", expected="one source view or more")
    if start is not None:
        begun = dataclasses.replace(
            start, depth=start.depth.copy(), normals=start.normals.copy(), cost=start.cost.copy()
        )
        return _searched(reference, sources, begun, depth_range, settings, 1, settings.iterations - 1, seed, True)
    planes: PlaneMaps | None = None
    small: StereoView | None = None
    for level in reversed(range(_levels(reference, settings.levels))):
        scaled = reference if level == 0 else reference.smaller(2**level)
        views = sources if level == 0 else [source.smaller(2**level) for source in sources]
        made = _blank(scaled)
        with launching():
            if planes is None or small is None:
                random_planes(made.depth, made.normals, pinhole_of(scaled), *depth_range, seed)
            else:
                enlarged_planes(
                    planes.depth,
                    planes.normals,
                    pinhole_of(small),
                    made.depth,
                    made.normals,
                    pinhole_of(scaled),
                    *depth_range,
                )
        rounds = settings.iterations + (_MORE_ROUNDS if planes is None else 0)
        first = 0 if planes is None else 1
        planes = _searched(
            scaled, views, made, depth_range, settings, first, rounds, seed + 7919 * (level + 1), False
        )
        small = scaled
    assert planes is not None
    return planes


def _searched(
    reference: StereoView,
    sources: Sequence[StereoView],
    planes: PlaneMaps,
    depth_range: tuple[float, float],
    settings: PatchMatchSettings,
    first: int,
    rounds: int,
    seed: int,
    geometric: bool,
) -> PlaneMaps:
    """Return planes after ``rounds`` over all pixels; the arrays of ``planes`` are used up."""
    pinhole, views = pinhole_of(reference), pack_views(reference, sources)
    best = min(settings.best, len(sources))
    weight = settings.geometric_weight if geometric else 0.0
    window = (settings.radius, settings.step, 1 / (2 * settings.sigma_colour**2), best, weight)
    baselines = [
        np.linalg.norm(source.cam_from_world.centre - reference.cam_from_world.centre) for source in sources
    ]
    pixel_depth = 1 / max(float(np.mean(baselines)) * pinhole[0], 1e-12)
    state = (planes.depth, planes.normals, planes.cost)
    with launching():
        cost_planes(reference.grey, *state, planes.texture, pinhole, views, *window)
        for number in range(rounds):
            left = 0.5 ** (first + number)
            for colour in (0, 1):
                search_colour(
                    colour,
                    reference.grey,
                    *state,
                    pinhole,
                    views,
                    *window,
                    *depth_range,
                    pixel_depth,
                    _PIXELS * left,
                    _TURN * left,
                    seed + 104729 * (number + 1) + colour,
                )
        if geometric:  # confidence is that of the pictures alone
            cost_planes(reference.grey, *state, planes.texture, pinhole, views, *window[:-1], 0.0)
    return planes


def _levels(view: StereoView, wanted: int) -> int:
    side = min(view.grey.shape)
    return max(1, min(wanted, 1 + int(np.log2(max(side / _LEAST_SIDE, 1)))))


def _blank(view: StereoView) -> PlaneMaps:
    shape = view.grey.shape
    return PlaneMaps(
        np.zeros(shape, np.float32),
        np.zeros((*shape, 3), np.float32),
        np.full(shape, WORST, np.float32),
        np.zeros(shape, np.float32),
    )


def pinhole_of(view: StereoView) -> tuple[float, float, float, float]:
    """Return focal lengths and principal point of a view in pixels."""
    matrix = view.camera.intrinsics
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])


def relations(reference: StereoView, source: StereoView) -> tuple[Array, Array]:
    """Return how pixels go to the source view and back: (12,) each, A row by row and b.

    A pixel x (homogeneous) of depth d has its image at ``d A x + b``, whose third coordinate is the depth there.
    """
    there = source.cam_from_world @ reference.cam_from_world.inverse()
    return _relation(reference, source, there), _relation(source, reference, there.inverse())


def _relation(start: StereoView, end: StereoView, end_from_start: RigidTransform) -> Array:
    matrix = end.camera.intrinsics
    rotation = matrix @ end_from_start.rotation @ np.linalg.inv(start.camera.intrinsics)
    return np.concatenate([rotation.ravel(), matrix @ end_from_start.translation])


def pack_views(reference: StereoView, sources: Sequence[StereoView]) -> tuple[Any, ...]:
    """Return the views as the kernels take them: brightness, depths, layout, forward, backward."""
    sizes = [source.grey.size for source in sources]
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64)
    layout = np.array([(at, *source.grey.shape) for at, source in zip(starts, sources, strict=True)], np.int64)
    brightness = np.concatenate([source.grey.ravel() for source in sources]).astype(np.float32)
    if any(source.depth is not None for source in sources):
        known = [np.zeros(s.grey.shape, np.float32) if s.depth is None else s.depth for s in sources]
        depths = np.concatenate([values.ravel() for values in known]).astype(np.float32)
    else:
        depths = np.zeros(1, np.float32)
    forward, backward = zip(*(relations(reference, source) for source in sources), strict=True)
    return brightness, depths, layout, np.array(forward), np.array(backward)
