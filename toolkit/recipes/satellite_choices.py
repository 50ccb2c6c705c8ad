"""What a surface model gains from more views, and from views that spread: the same heights from chosen ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from toolkit.depth.height_dsm import heights_on
from toolkit.depth.height_map import match_heights
from toolkit.depth.height_settings import HeightSettings
from toolkit.errors import StageError
from toolkit.geometry.ground_grid import GroundGrid
from toolkit.metrics.elevation import ElevationErrors, compare_heights
from toolkit.progress import Progress, silent
from toolkit.recipes.satellite_steps import ground_views
from toolkit.scene import Scene
from toolkit.scene.dsm_files import SurfaceModel
from toolkit.views.scene_views import select_from_scene
from toolkit.views.settings import ViewSelectionSettings

#: Ways to choose views, and the settings that say so.
CHOICES = {
    "most spread": {"spread": "most"},
    "least spread": {"spread": "least"},
    "random": {"method": "random"},
}


def errors_by_views(
    scene: Scene,
    box: ArrayLike,
    truth: SurfaceModel,
    counts: Sequence[int],
    settings: HeightSettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, dict[int, ElevationErrors]]:
    """Return by way to choose and by number of views how far the heights that they give are from the truth.

    Parameters
    ----------
    scene:
        Training frames with affine cameras that agree, and a georeference.
    box:
        (2, 3) lower and upper corner of the ground, metres in the scene's world.
    truth:
        The true surface.
    counts:
        Numbers of views, each at least 2. As many as there are gives one result for all ways.
    settings:
        How heights are matched.
    seed:
        Of the search and of the random choice.

    Raises
    ------
    StageError
        Without a georeference, for more views than there are, and as
        :func:`toolkit.depth.height_map.match_heights`.
    """
    if scene.georeference is None:
        raise StageError("A true surface has a place on the earth", expected="a scene with a georeference")
    corners = np.asarray(box, dtype=np.float64)
    grid = GroundGrid.over(corners, settings.resolution)
    heights = (float(corners[0, 2]), float(corners[1, 2]))
    known: dict[frozenset[str], ElevationErrors] = {}
    found: dict[str, dict[int, ElevationErrors]] = {way: {} for way in CHOICES}
    for way, changes in CHOICES.items():
        for count in counts:
            select = ViewSelectionSettings(count=count).replace(changes)
            names = frozenset(select_from_scene(scene, select, seed=seed).names)
            if names not in known:
                views = ground_views(scene, [frame for frame in scene.of_split("train") if frame.name in names])
                made = match_heights(views, grid, heights, settings, seed=seed, progress=progress)
                on_truth = heights_on(made.heights, grid, scene.georeference, truth)
                known[names] = compare_heights(on_truth, truth.heights, truth.resolution)
            found[way][count] = known[names]
    return found
