"""A digital surface model from satellite pictures by matching over the ground: no network, no splat."""

from __future__ import annotations

import time

from toolkit.depth.height_settings import HeightSettings
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult, StageTime
from toolkit.recipes.satellite_measure import dsm_artifacts
from toolkit.recipes.satellite_steps import SatelliteSettings, heights_stage, read_heights, satellite_stages
from toolkit.recipes.steps import SCENE
from toolkit.scene.folder import read_scene
from toolkit.settings import Group, Settings


class SatHeightsSettings(Settings):
    """Settings of every stage."""

    cameras = Group(SatelliteSettings(), doc="Cameras that agree")
    heights = Group(HeightSettings(), doc="Heights matched over the ground")


def run(data: RecipeInput, settings: SatHeightsSettings, context: RecipeContext) -> RecipeResult:
    """Correct the RPCs, match heights over the ground, write and measure the surface model."""
    found = satellite_stages(data, settings.cameras, context)
    heights = heights_stage(found, settings.heights, context)
    made = read_heights(heights, found.box)
    start = time.perf_counter()
    metrics, report = dsm_artifacts(made.heights, made.grid, data.scene, context)
    stages = (*found.stages, heights)
    return RecipeResult(
        scene=read_scene(found.refined.folder / SCENE),
        gaussians=None,
        times=(*(stage.time for stage in stages), StageTime("measure", time.perf_counter() - start)),
        metrics={
            **found.metrics(),
            "heights.filled": heights.report["filled"],
            **metrics,
        },
        reports={**{stage.time.name: stage.report for stage in stages}, "dsm": report},
    )


RECIPE = Recipe(
    name="sat-heights",
    title="Heights over the ground",
    paper="satellite-3d",
    description=(
        "Satellite pictures with RPCs: tie points correct the RPCs, and for each cell of the ground the height is "
        "searched at which all views look alike. Leaves a digital surface model as GeoTIFF. No network, no splat."
    ),
    settings_type=SatHeightsSettings,
    run=run,
)
