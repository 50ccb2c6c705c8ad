"""What every recipe with a digital surface model does in the end: it writes it as a GeoTIFF and measures it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.height_dsm import heights_on, surface_model
from toolkit.errors import StageError
from toolkit.geometry.ground_grid import GroundGrid
from toolkit.metrics.elevation import compare_heights
from toolkit.recipes.base import RecipeContext
from toolkit.scene import Georeference, Scene
from toolkit.scene.dsm_files import read_dsm, write_dsm

#: Below the artifacts folder: the surface model, and its differences from the true one.
DSM_FILE, DIFFERENCE_FILE = "dsm.tif", "dsm_difference.tif"
#: Where data keep their true surface, below the folder of the pictures or beside it.
_TRUTHS = ("truth/dsm.tif", "expected_dsm.tif")


def dsm_artifacts(
    heights: NDArray[np.floating], grid: GroundGrid, scene: Scene, context: RecipeContext
) -> tuple[dict[str, float | None], dict[str, Any]]:
    """Write ``dsm.tif`` into the artifacts, and measure it against the data's own surface model where there is one.

    Parameters
    ----------
    heights, grid:
        (rows, columns) metres up in the scene's world.
    scene:
        With a georeference; its pictures tell where the data lie.

    Returns
    -------
    metrics, report:
        ``dsm.*`` after a registration sideways and in height, in metres and shares; what the entry ``dsm`` of the
        reports takes, or the reason why nothing was measured.

    Raises
    ------
    StageError
        Where the scene has no georeference.
    """
    place = _georeference(scene)
    model = surface_model(heights, grid, place)
    write_dsm(context.artifacts / DSM_FILE, model.heights, model.origin, model.resolution, model.crs)
    report: dict[str, Any] = {"file": DSM_FILE, "crs": model.crs, "resolution": model.resolution}
    path = true_surface_model(scene.image_dir)
    if path is None:
        return {}, {**report, "reason": "the data have no surface model of their own"}
    truth = read_dsm(path)
    on_truth = heights_on(heights, grid, place, truth)
    try:
        errors = compare_heights(on_truth, truth.heights, truth.resolution)
    except StageError as error:
        return {}, {**report, "reason": str(error)}
    write_dsm(context.artifacts / DIFFERENCE_FILE, errors.differences, truth.origin, truth.resolution, truth.crs)
    metrics: dict[str, float | None] = {
        "dsm.mae": errors.mean_absolute,
        "dsm.rmse": errors.root_mean_square,
        "dsm.median_absolute": errors.median_absolute,
        "dsm.spread": errors.spread,
        "dsm.within_1m": errors.completeness,
        "dsm.known": errors.known,
    }
    return metrics, {**report, "truth": path.name, "errors": errors.to_dict(), "difference": DIFFERENCE_FILE}


def true_surface_model(pictures: Path) -> Path | None:
    """Return the data's own surface model, by the folder of the pictures; None where there is none."""
    places = (folder / name for folder in (pictures, pictures.parent) for name in _TRUTHS)
    return next((path for path in places if path.is_file()), None)


def _georeference(scene: Scene) -> Georeference:
    if scene.georeference is None:
        raise StageError(
            "A surface model needs a place on the earth", expected="a scene with a georeference", found="none"
        )
    return scene.georeference
