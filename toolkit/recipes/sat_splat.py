"""Satellite splatting: Gaussians under affine cameras, begun on matched heights, and their surface model."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.height_fill import fill_low
from toolkit.depth.height_map import HeightMap
from toolkit.depth.height_settings import HeightSettings
from toolkit.errors import CapabilityError, StageError
from toolkit.metrics.lpips import Lpips
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult, StageTime
from toolkit.recipes.satellite_measure import dsm_artifacts
from toolkit.recipes.satellite_steps import SatelliteSettings, heights_stage, read_heights, satellite_stages
from toolkit.recipes.steps import SCENE, PosedStages, train_flat
from toolkit.scene import Frame, Points, Scene
from toolkit.scene.folder import read_scene
from toolkit.scene.pictures import load_picture
from toolkit.settings import Group, Integer, Settings
from toolkit.splat.train_settings import TrainSettings


def _disks() -> TrainSettings:
    # Suns differ from picture to picture, and so does the air; colours do not depend on the direction.
    return TrainSettings(kind="2d", sh_degree=0, exposure=True)


class SatSplatSettings(Settings):
    """Settings of every stage."""

    cameras = Group(SatelliteSettings(), doc="Cameras that agree")
    heights = Group(HeightSettings(), doc="Heights matched over the ground, on which Gaussians begin")
    max_points = Integer(60_000, bounds=(4, 10_000_000), doc="Most Gaussians to begin with.")
    train = Group(_disks(), doc="Gaussian splats, with a change of colours for each picture")


def run(data: RecipeInput, settings: SatSplatSettings, context: RecipeContext) -> RecipeResult:
    """Correct the RPCs, match heights, train a splat on affine cameras, and measure its renders and its heights."""
    # Imported only now: whoever reads settings does without PyTorch.
    from toolkit.splat.elevation import splat_heights

    lpips = Lpips()
    _require_cpu(settings, context)
    found = satellite_stages(data, settings.cameras, context)
    heights = heights_stage(found, settings.heights, context)
    made = read_heights(heights, found.box)
    local = read_scene(found.local.folder / SCENE)
    scene = local.replace(points=_start(made, local, settings.max_points, context.seed))
    posed = PosedStages((*found.stages, heights), found.metrics())
    result = train_flat(
        RecipeInput(data.scene, None, data.fingerprint),
        posed,
        scene,
        scene,
        settings.train,
        context,
        lpips,
        training_views=True,
    )
    assert result.gaussians is not None
    start = time.perf_counter()
    drawn = splat_heights(result.gaussians, made.grid, settings.train, device=context.device)
    fills = settings.heights.keep.fill == "low"
    if fills:  # what has no height then lies where too few views overlap
        drawn[np.isnan(made.heights)] = np.nan
    holes = np.isnan(drawn)
    metrics: dict[str, float | None] = {}
    report: dict[str, Any] = {"reason": "the splat is nowhere opaque from above"}
    if not holes.all():
        whole = np.where(np.isnan(made.heights), np.nan, fill_low(drawn)) if fills else drawn
        metrics, report = dsm_artifacts(whole, made.grid, data.scene, context)
    measured = StageTime("measure heights", time.perf_counter() - start)
    return dataclasses.replace(
        result,
        times=(*result.times, measured),
        metrics={**result.metrics, "heights.filled": float(fills * holes.mean()), **metrics},
        reports={**result.reports, "dsm": report},
    )


def _require_cpu(settings: SatSplatSettings, context: RecipeContext) -> None:
    """Refuse, before the work of minutes, what the training would refuse."""
    if context.device != "cpu" or settings.train.backend == "cuda":
        raise CapabilityError(
            "Affine cameras are drawn on the CPU alone",
            expected="device cpu, and train.backend cpu",
            found=f"device {context.device}, train.backend {settings.train.backend}",
        )


def _start(made: HeightMap, scene: Scene, most: int, seed: int) -> Points:
    """Return points on the heights that were found, chosen by chance, coloured by the picture nearest to above."""
    rows, columns = np.nonzero(np.isfinite(made.heights) & ~made.filled)
    if not len(rows):
        raise StageError("No height was found", expected="cells on which views agree", found="filled ones")
    if len(rows) > most:
        chosen = np.sort(np.random.default_rng(seed).choice(len(rows), most, replace=False))
        rows, columns = rows[chosen], columns[chosen]
    xyz = np.column_stack([made.grid.places()[rows, columns], made.heights[rows, columns]])
    return Points(xyz, _seen_from_above(xyz, scene))


def _seen_from_above(xyz: NDArray[np.float64], scene: Scene) -> NDArray[np.uint8]:
    def leaning(frame: Frame) -> float:
        assert frame.cam_from_world is not None
        return float(frame.cam_from_world.rotation[2, 2])  # -1: straight down

    colours = np.full((len(xyz), 3), 128, np.uint8)
    # Those from straight above last, so that theirs stay.
    for frame in sorted(scene.of_split("train"), key=leaning, reverse=True):
        assert frame.cam_from_world is not None
        picture = load_picture(scene.image_path(frame))
        pixels = scene.camera_of(frame).project(frame.cam_from_world.apply(xyz))
        inside = ((pixels >= 0) & (pixels < picture.shape[1::-1])).all(axis=1)
        column, row = pixels[inside].astype(int).T
        colours[inside] = picture[row, column]
    return colours


RECIPE = Recipe(
    name="sat-splat",
    title="Satellite splatting",
    paper="satellite-3d",
    description=(
        "Satellite pictures with RPCs: tie points correct the RPCs, affine cameras are fitted, Gaussians begin on "
        "heights matched over the ground and are trained with a change of colours for each picture. Every view "
        "takes part. Leaves a splat and the surface model that it shows from above, as GeoTIFF."
    ),
    settings_type=SatSplatSettings,
    run=run,
)
