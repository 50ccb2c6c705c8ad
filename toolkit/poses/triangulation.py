"""Options of COLMAP's triangulation under poses that are given."""

from __future__ import annotations

import pycolmap

# COLMAP compares rays by angles; below this rounding and distortion decide.
_LEAST_ANGLE = 0.5
# Enough that wrong observations stand out from those of points that were made of two rays.
_FEW_STEPS = 5


def triangulation_options(
    *,
    degrees: float,
    pixels: float,
    min_angle: float,
    seed: int,
    min_matches: int = 15,
    threads: int = 0,
    adjusted: bool = False,
) -> pycolmap.IncrementalPipelineOptions:
    """Return options for ``pycolmap.triangulate_points``.

    Parameters
    ----------
    degrees:
        By how much a ray may miss a point: the error of the poses; at least half a degree.
    pixels:
        The same in the pictures, for points that are merged, completed and kept.
    min_angle:
        Points whose rays meet under a smaller angle are left out, in degrees.
    seed:
        Of COLMAP's random choices.
    min_matches:
        Pairs with fewer inliers are not used.
    threads:
        0: as many as there are cores.
    adjusted:
        Whether points and poses are adjusted afterwards: then COLMAP refines the points a little only.
    """
    options = pycolmap.IncrementalPipelineOptions(
        min_num_matches=min_matches, num_threads=threads or -1, random_seed=seed
    )
    if adjusted:
        options.ba_global_max_refinements, options.ba_global_max_num_iterations = 1, _FEW_STEPS
    options.mapper.random_seed = seed
    options.mapper.filter_max_reproj_error = pixels
    options.mapper.filter_min_tri_angle = min_angle
    triangulation = options.triangulation
    triangulation.random_seed = seed
    triangulation.min_angle = min_angle
    angle = max(degrees, _LEAST_ANGLE)
    triangulation.create_max_angle_error = triangulation.continue_max_angle_error = angle
    triangulation.re_max_angle_error = angle
    triangulation.merge_max_reproj_error = triangulation.complete_max_reproj_error = pixels
    return options
