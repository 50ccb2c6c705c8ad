"""One round: what the map shows from a pose, matched with the photo, and the pose that follows."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.pnp import solve_pnp
from toolkit.localize.result import Round
from toolkit.localize.settings import PnpSettings
from toolkit.localize.splat_map import MapView
from toolkit.matching.picture_features import PictureFeatures, PictureMatcher


class Clock:
    """Adds up the wall time of parts by their names."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Add the time of what is done within to ``name``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def match_view(
    view: MapView,
    photo: PictureFeatures,
    camera: ColmapCamera,
    matcher: PictureMatcher,
    settings: PnpSettings,
    *,
    all_depths: bool,
    seed: int,
    clock: Clock,
) -> Round:
    """Match a photo with a render, back-project the render's pixels and solve for the photo's pose.

    Parameters
    ----------
    view:
        The render.
    photo, camera:
        Features of the photo, and the camera that took it, of any of COLMAP's models.
    all_depths:
        Back-project every pixel with a depth, as the paper does; else only reliable ones, interpolated.
    """
    with clock.part("features"):
        rendered = matcher.features(view.colour)
    with clock.part("match"):
        matches = matcher.match(photo, rendered)
    with clock.part("pnp"):
        points, good = view.points(matches.second, all_depths=all_depths)
        pixels, points = matches.first[good], points[good]
        found = solve_pnp(pixels, points, camera, settings, seed=seed)
    return Round(view.cam_from_world, found.cam_from_world, pixels, points, found.inside)


def moved_by(before: RigidTransform, after: RigidTransform, depth: float) -> float:
    """Return how far a pose moved, or what it looks at in ``depth``, whichever is more, in scene units."""
    turn = after.rotation @ before.rotation.T
    cosine = np.clip((np.trace(turn) - 1) / 2, -1.0, 1.0)
    return max(float(np.linalg.norm(after.centre - before.centre)), depth * float(np.arccos(cosine)))
