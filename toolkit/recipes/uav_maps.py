"""Maps of disks for localising drones: the paper's three, and the photos and queries localised in each.

The paper (uav-splat-localization, section 4.2) trains one map from sparse points, one from dense points, and one
from dense points whose centres learn at a hundredth of the rate, with depth distortion weighted 1. The third ran
out of memory there; here all have the same cap, and the dense cloud is thinned before.
"""

from __future__ import annotations

import time

from toolkit.localize.settings import LocalizeSettings, OneShotSettings
from toolkit.metrics.lpips import Lpips
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult, StageTime
from toolkit.recipes.map_split import with_map_split
from toolkit.recipes.map_steps import MapSettings, map_stages
from toolkit.recipes.measure import measure_test_renders
from toolkit.recipes.uav_localize import ScenarioSettings, localize_stages, matchers
from toolkit.scene.folder import SCENE_FILE
from toolkit.settings import Choice, Group
from toolkit.splat.depth_settings import DepthLossSettings
from toolkit.splat.train_settings import TrainSettings


class UavMapSettings(MapSettings):
    """Settings of every stage from photos to a map and to the poses of queries in it."""

    split = Choice(
        "file",
        choices=("file", "capture"),
        doc="file: split.csv of the capture's folder says which photos make the map and which are queries, where "
        "it is there; capture: test frames are the queries.",
    )
    camera = Choice(
        "auto",
        choices=("auto", "keep", "refine"),
        doc="keep: intrinsics stay as the capture has them (the paper's were calibrated); refine: structure from "
        "motion finds them as sfm says; auto: kept where a scene.json tells them, found for mere photos. Views "
        "straight down from one height hardly tell focal length from depth.",
    )
    scenarios = Group(ScenarioSettings(), doc="From which start poses photos are localised")
    one_shot = Group(OneShotSettings(), doc="The paper's localisation: one render")
    ours = Group(LocalizeSettings(), doc="Ours: renders until the pose stands still")


class DenseMapSettings(UavMapSettings):
    """The same, started from the dense cloud."""

    start = Choice("dense", choices=("sparse", "dense"), doc=MapSettings.param["start"].doc)


def _held_centres() -> TrainSettings:
    """Return the paper's third training: position rates divided by 100, distortion weight 1 (section 4.2)."""
    usual = TrainSettings(kind="2d")
    return usual.replace(
        {
            "lr_means": usual.lr_means / 100,
            "lr_means_final": usual.lr_means_final / 100,
            "distortion_weight": 1.0,
        }
    )


def _still_disks() -> TrainSettings:
    """Return ours: centres at a tenth of the usual rate, distortion weight 1."""
    usual = TrainSettings(kind="2d")
    return usual.replace(
        {"lr_means": usual.lr_means / 10, "lr_means_final": usual.lr_means_final / 10, "distortion_weight": 1.0}
    )


class HeldMapSettings(DenseMapSettings):
    """The same, whose depth is held to stereo's."""

    train = Group(_still_disks(), doc="Gaussian splats, in units in which the scene fills -1 to 1")
    depth_loss = Group(
        DepthLossSettings(kind="absolute", weight=0.5, final_weight=0.0),
        doc="How much their depth is held to stereo's, where weight is not 0",
    )


class DensePositionMapSettings(DenseMapSettings):
    """The same, with centres that hardly move."""

    train = Group(_held_centres(), doc="Gaussian splats, in units in which the scene fills -1 to 1")


def run(data: RecipeInput, settings: UavMapSettings, context: RecipeContext) -> RecipeResult:
    """Build a map of the training frames, measure it, and localise the training and test frames in it."""
    # Imported only now: whoever reads settings does without PyTorch.
    from toolkit.splat.evaluate import render_test_views

    lpips = Lpips()
    data = with_map_split(data, settings.split)
    known = matchers(settings.scenarios, settings.one_shot, settings.ours, context.device)
    built = map_stages(data, with_camera(settings, data), context, reliable=settings.ours.reliable)
    start = time.perf_counter()
    views, image_metrics, image_report = measure_test_renders(
        render_test_views(built.gaussians, built.flat_scene, settings.train, device=context.device),
        len(built.flat_scene.of_split("test")),
        context.artifacts,
        lpips,
        context.progress,
    )
    measured = StageTime("measure", time.perf_counter() - start)
    stages, metrics, reports = localize_stages(
        built, settings.scenarios, settings.one_shot, settings.ours, known, context, reference=data.reference
    )
    return RecipeResult(
        scene=built.scene,
        gaussians=built.gaussians,
        times=(*(stage.time for stage in built.stages), measured, *(stage.time for stage in stages)),
        metrics={**image_metrics, **built.metrics, **metrics},
        reports={
            **built.reports,
            "images": image_report,
            **{stage.time.name: _short(stage.report) for stage in stages},
            **reports,
        },
        test_views=views,
    )


def with_camera(settings: UavMapSettings, data: RecipeInput) -> UavMapSettings:
    """Return the settings with which the camera is refined or kept, as ``camera`` says."""
    told = (data.scene.image_dir.parent / SCENE_FILE).is_file()
    if settings.camera == "refine" or (settings.camera == "auto" and not told):
        return settings
    kept = ("refine_focal", "refine_distortion", "refine_principal_point")
    return settings.replace({f"sfm.{name}": False for name in kept})


def _short(report: dict[str, object]) -> dict[str, object]:
    """Return what a stage reports without its queries, which are in files of their own."""
    return {name: value for name, value in report.items() if name != "queries"}


def _recipe(name: str, title: str, what: str, settings_type: type[UavMapSettings]) -> Recipe:
    return Recipe(
        name=name,
        title=title,
        paper="uav-splat-localization",
        description=(
            "Structure from motion of the map photos (split train) with their GPS as prior, queries (split test) "
            f"placed in it for the truth only, stereo and a dense cloud, {what}; its depth measured; then every "
            "photo localised by the paper's one shot and by ours, from the paper's start poses. Needs overlapping "
            "photos with positions, of which some are queries."
        ),
        settings_type=settings_type,
        run=run,
    )


SPARSE = _recipe("2dgs-sparse", "2DGS map, sparse start", "disks started from the sparse points", UavMapSettings)
DENSE = _recipe("2dgs-dense", "2DGS map, dense start", "disks started from the dense cloud", DenseMapSettings)
DENSE_POS = _recipe(
    "2dgs-dense-pos",
    "2DGS map, dense start, held centres",
    "disks started from the dense cloud, centres learned at a hundredth of the rate, depth distortion weighted 1",
    DensePositionMapSettings,
)
HELD = _recipe(
    "2dgs-held",
    "2DGS map, held to stereo",
    "disks started from the dense cloud, their depth held to stereo's, depth distortion weighted 1 (ours)",
    HeldMapSettings,
)
