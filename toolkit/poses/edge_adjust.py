"""Bundle adjustment with straight edges: what the points leave open in the lens, the edges may hold.

The edges depend on the lens alone. So the adjustment of the points comes first; what it says of the intrinsics, all
poses and points eliminated, is a quadratic about its solution (Triggs et al. 2000, "Bundle adjustment - a modern
synthesis", section 6). The lens is the minimum of that quadratic and of the edges' distances together, and poses
and points are adjusted again with this lens kept. To first order that is the joint adjustment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.poses.adjust import adjust
from toolkit.poses.arc_sigma import ArcSigma, arc_sigma
from toolkit.poses.blade_edges import edge_residuals, edge_spread
from toolkit.poses.normal_equations import normal_equations
from toolkit.progress import Progress, silent
from toolkit.scene import Scene, scene_from_pycolmap

Array = NDArray[np.float64]

_LOSS = 2.0
_STEPS = 100


@dataclass(frozen=True, slots=True, eq=False)
class EdgeAdjustment:
    """A scene before and after its edges took part.

    Attributes
    ----------
    scene:
        Poses, points and the lens by points and edges.
    before, after:
        Arc and standard deviation by the points alone, and by both.
    spread_before, spread_after:
        Robust spread in pixels of the edges' pixels from the images of straight lines.
    edges:
        Number of edges.
    """

    scene: Scene
    before: ArcSigma
    after: ArcSigma
    spread_before: float
    spread_after: float
    edges: int

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "before": self.before.to_dict(),
            "after": self.after.to_dict(),
            "spread_before": self.spread_before,
            "spread_after": self.spread_after,
            "edges": self.edges,
        }


def adjust_with_edges(
    scene: Scene,
    edges: Sequence[Array],
    *,
    pixels_a_sample: float = 10.0,
    refine_principal_point: bool = False,
    progress: Progress = silent,
) -> EdgeAdjustment:
    """Adjust a scene by its points and by straight edges in its pictures.

    Parameters
    ----------
    scene:
        As a bundle adjustment with free focal length and distortion left it; one camera takes all pictures.
    edges:
        Each (N, 2) distorted pixels of something straight (:func:`toolkit.poses.blade_edges.find_edges`), from any
        of the pictures.
    pixels_a_sample:
        So many neighbouring pixels of an edge count as one measurement: their errors are alike, and so is the bend
        of an edge that is not quite straight.
    refine_principal_point:
        Whether the adjustment before had found it.
    progress:
        Raises to cancel.

    Raises
    ------
    StageError
        For a scene with several cameras or without edges, one whose points leave the lens wholly open, or as
        :func:`toolkit.poses.arc_sigma.arc_sigma`.
    """
    from scipy.optimize import least_squares

    used = {frame.camera_id for frame in scene.registered}
    if len(used) != 1 or not len(edges):
        raise StageError(
            "Edges cannot take part in this adjustment",
            expected="one camera, and edges that it saw",
            found=f"{len(used)} cameras and {len(edges)} edges",
        )
    (number,) = used
    camera = scene.cameras[number]
    assert isinstance(camera, ColmapCamera)
    before = arc_sigma(scene, refine_principal_point=refine_principal_point, progress=progress)
    equations = normal_equations(scene, focal=True, distortion=True, principal_point=refine_principal_point)
    root = equations.intrinsics_root()
    if root is None:
        raise StageError(
            "The points leave the lens open", expected="intrinsics that they determine, however loosely"
        )
    places = [place for _, place in equations.intrinsics]
    start = np.array(camera.params)

    def changed(values: Array) -> pycolmap.Camera:
        params = start.copy()
        params[places] = values
        made = camera.to_pycolmap()
        made.params = params.tolist()
        return made

    spread = edge_spread(edge_residuals(changed(start[places]), edges))
    best = start[places]
    scale = spread
    for _ in range(3):
        # Robust against edges that are not straight; the points' part is quadratic.
        def both(values: Array, scale: float = scale) -> Array:
            bent = edge_residuals(changed(values), edges) / max(_LOSS * scale, 1e-6)
            robust = _LOSS * np.sign(bent) * np.sqrt(np.log1p(np.square(bent))) / math.sqrt(pixels_a_sample)
            return np.concatenate([root @ (values - start[places]) / before.noise, robust])

        best = least_squares(both, best, x_scale="jac", max_nfev=_STEPS).x
        scale = edge_spread(edge_residuals(changed(best), edges))
    adjusted = _with_lens(scene, number, ColmapCamera.from_pycolmap(changed(best)))
    after = arc_sigma(
        adjusted,
        refine_principal_point=refine_principal_point,
        known=_edge_information(changed, best, edges, scale, pixels_a_sample),
        progress=progress,
    )
    return EdgeAdjustment(adjusted, before, after, spread, scale, len(edges))


def _with_lens(scene: Scene, number: int, camera: ColmapCamera) -> Scene:
    """Return the scene with poses and points adjusted to a lens that is kept."""
    model = scene.replace(cameras={**scene.cameras, number: camera}).to_pycolmap()
    adjust(
        model,
        refine_focal=False,
        refine_distortion=False,
        refine_principal_point=False,
        max_error=math.inf,
        min_angle=0.0,
    )
    return scene_from_pycolmap(model, scene.image_dir, like=scene)


def _edge_information(
    changed: Any, values: Array, edges: Sequence[Array], spread: float, pixels_a_sample: float
) -> Array:
    """Return the inverse covariance (K, K) of the intrinsics by the edges alone, which may be singular."""
    columns = []
    for column, value in enumerate(values):
        step = np.zeros(len(values))
        step[column] = 1e-5 * max(1.0, abs(value))
        difference = edge_residuals(changed(values + step), edges) - edge_residuals(changed(values - step), edges)
        columns.append(difference / (2.0 * step[column]))
    slope = np.stack(columns, axis=1)
    information: Array = slope.T @ slope / (spread**2 * pixels_a_sample)
    return information
