"""Blades of an engine from one video: every pair, neighbours, a closed circle (blade-inspection-sfm, 4.2, 4.3)."""

from __future__ import annotations

import time
from typing import Any

from toolkit.matching.feature_choice import FeatureSettings
from toolkit.matching.pairs import PairSettings
from toolkit.matching.wrong_pairs import WrongPairSettings
from toolkit.poses.circular_settings import CircularSettings
from toolkit.poses.sfm import SfmSettings
from toolkit.progress import ProgressEvent
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult, StageTime
from toolkit.recipes.blades_stages import (
    LensSettings,
    MaskSettings,
    Matched,
    find_poses,
    masked_capture,
    match_frames,
    on_a_circle,
    start_capture,
)
from toolkit.recipes.cached import CachedStage
from toolkit.recipes.circle_metrics import circle_metrics
from toolkit.recipes.steps import SCENE, sfm_metrics
from toolkit.scene.folder import read_scene
from toolkit.settings import Boolean, Group, Settings

#: Frames ahead that each frame is matched with (section 4.1).
WINDOW = 15


def faint_features() -> FeatureSettings:
    """Return settings of features for surfaces with little texture."""
    return FeatureSettings().replace({"sift.peak_threshold": 0.003})


def small_step_sfm() -> SfmSettings:
    """Return settings of structure from motion for frames a small turn apart that show few features."""
    return SfmSettings(
        init_min_angle=2.0,
        init_min_inliers=40,
        min_inliers=12,
        # SIMPLE_RADIAL's focal length falls to a twentieth of the width; the mapper would begin for ever again.
        least_focal=0.01,
        # A borescope's axis is pixels off the middle, by which an open arc of 98 degrees bends by four.
        principal_point_sigma=0.002,
    )


class BladesExhaustiveSettings(Settings):
    """Every frame is matched with every other one, as structure from motion does unless told."""

    masks = Group(MaskSettings(), doc="What does not turn with the blades")
    lens = Group(LensSettings(), doc="What is known of the lens")
    features = Group(faint_features(), doc="Features and how they are matched")
    pairs = Group(PairSettings(method="exhaustive"), doc="Which frames are matched with which")
    check_pairs = Boolean(False, doc="Drop pairs that contradict the sequence before poses are found.")
    wrong = Group(WrongPairSettings(), doc="Which pairs contradict it, with check_pairs")
    sfm = Group(small_step_sfm(), doc="Incremental structure from motion")


class BladesSequentialSettings(BladesExhaustiveSettings):
    """Every frame is matched with those that follow it (section 4.2)."""

    pairs = Group(
        PairSettings(method="sequential", overlap=WINDOW, quadratic=False),
        doc="Which frames are matched with which",
    )


class BladesCircularSettings(BladesSequentialSettings):
    """Sequential, the last frames with the first, and all cameras on one circle."""

    pairs = Group(
        PairSettings(method="sequential", overlap=WINDOW, quadratic=False, closed=True),
        doc="Which frames are matched with which; closed where the footage is one turn",
    )
    circle = Group(CircularSettings(), doc="Adjustment of cameras that circle one axis")


def run(data: RecipeInput, settings: BladesExhaustiveSettings, context: RecipeContext) -> RecipeResult:
    """Find the poses of frames around an axis by structure from motion, and measure the arc that they make."""
    stages, _, _ = _sfm(data, settings, context)
    return _result(data, stages, {}, context)


def run_circular(data: RecipeInput, settings: BladesCircularSettings, context: RecipeContext) -> RecipeResult:
    """Find poses, then adjust all cameras on one circle about one axis."""
    stages, matched, posed = _sfm(data, settings, context)
    closed = on_a_circle(matched, posed, settings.circle, context)
    before, _ = circle_metrics(read_scene(posed.folder / SCENE), data.reference)
    metrics: dict[str, float | None] = {
        "circle.arc_sigma_deg": closed.report["arc_sigma"],
        "circle.orientation_sigma_deg": closed.report["orientation_sigma"],
        "circle.seam_gap": closed.report["closure_gap"],
        **{f"before.{name}": value for name, value in before.items() if name.startswith("circle.")},
    }
    return _result(data, (*stages, closed), metrics, context)


def _sfm(
    data: RecipeInput, settings: BladesExhaustiveSettings, context: RecipeContext
) -> tuple[tuple[CachedStage, ...], Matched, CachedStage]:
    """Return all stages, and of them what was matched and the poses."""
    wrong = settings.wrong if settings.check_pairs else None
    masked, masks = masked_capture(data, settings.masks, context)
    start = start_capture(masked, settings.lens)
    matched = match_frames(start, settings.features, settings.pairs, wrong, context)
    posed = find_poses(matched, settings.lens, settings.sfm, settings.features, settings.pairs, context)
    return (*masks, *matched.stages, posed), matched, posed


def _result(
    data: RecipeInput,
    stages: tuple[CachedStage, ...],
    more: dict[str, float | None],
    context: RecipeContext,
) -> RecipeResult:
    start = time.perf_counter()
    scene = read_scene(stages[-1].folder / SCENE)
    by_name = {stage.time.name: stage for stage in stages}
    sfm = by_name["sfm"].report
    for warning in sfm["warnings"]:
        context.progress(ProgressEvent("sfm", 1, 1, warning))
    measured, reports = circle_metrics(scene, data.reference)
    if "circle" not in by_name:  # the adjustment on the circle has a sigma of its own
        measured["circle.arc_sigma_deg"] = sfm["arc"]["sigma"]
    metrics: dict[str, float | None] = {**sfm_metrics(scene, sfm), **measured, **more}
    if "pairs" in by_name:
        metrics["pairs.dropped"] = float(by_name["pairs"].report["dropped"])
    lens = sfm["first_pass"]["sfm"]["cameras"] if "first_pass" in sfm else sfm["cameras"]
    if len(lens) == 1:
        width = next(iter(data.scene.cameras.values())).width
        metrics["lens.focal_widths"] = lens[0]["after"][0] / width
    # Undistorting leaves frames without a pose behind.
    metrics["sfm.images"] = float(len(data.scene))
    metrics["pairs.verified"] = float(by_name["matches"].report["pairs_verified"])
    return RecipeResult(
        scene=scene,
        gaussians=None,
        times=(*(stage.time for stage in stages), StageTime("measure", time.perf_counter() - start)),
        metrics=metrics,
        reports={**{name: stage.report for name, stage in by_name.items()}, **reports},
    )


def _recipe(name: str, title: str, description: str, settings_type: type[Settings], work: Any) -> Recipe:
    return Recipe(name, title, "blade-inspection-sfm", description, settings_type, work)


EXHAUSTIVE = _recipe(
    "blades-exhaustive",
    "Blades, every frame with every other one",
    "Structure from motion of a video that circles look-alike blades, with exhaustive pairs: the baseline that "
    "folds distinct blades onto each other. check_pairs drops pairs that contradict the sequence. Gives poses, "
    "points and the arc with its standard deviation, no splat.",
    BladesExhaustiveSettings,
    run,
)
SEQUENTIAL = _recipe(
    "blades-sequential",
    "Blades, neighbouring frames",
    "Structure from motion in which each frame is matched with the 15 that follow (the paper's window): keep the "
    "window below half a blade. The lens is found with the poses, or first (two-step: undistorted pictures, then a "
    "fixed PINHOLE), or known. Gives poses, points and the arc with its standard deviation, no splat.",
    BladesSequentialSettings,
    run,
)
CIRCULAR = _recipe(
    "blades-circular",
    "Blades on a closed circle",
    "Neighbouring frames, the last ones with the first, then an adjustment in which all cameras turn about one "
    "axis at one radius, with slack for shake: what the paper asks for and does not have. Say what is known: "
    "circle.full_turn for footage of one whole turn; pairs.closed where its end meets its beginning. No splat.",
    BladesCircularSettings,
    run_circular,
)
