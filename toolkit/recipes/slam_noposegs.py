"""ORBSLAM-NoposeGS of the drone paper (A-3DGS, section 3.2.1), and the same with a SLAM of our own.

SLAM runs over all frames of the flight's video. The pictures of the scene are frames of that video, so they get
their poses out of SLAM's trajectory by their times, and every method sees the same pictures. Points are
triangulated under these poses, and training refines them.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from toolkit import matching, poses
from toolkit.capture.frames import PictureSettings
from toolkit.files import disk_errors
from toolkit.metrics.lpips import Lpips
from toolkit.poses.slam.merge import MergeSettings
from toolkit.poses.slam.orb_pnp import OrbPnpSettings
from toolkit.poses.slam.orbslam3 import OrbSlam3Settings
from toolkit.poses.slam.points import SlamPointSettings, slam_points
from toolkit.poses.slam.result_files import frames_file
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.flight_video import Film, film_of
from toolkit.recipes.slam_stages import (
    SEGMENTS,
    Tracker,
    VideoSettings,
    orb_pnp_tracker,
    orbslam3_tracker,
    place_stage,
    slam_metrics,
    track_stage,
)
from toolkit.recipes.steps import SCENE, PosedStages, sfm_metrics, train_and_measure
from toolkit.scene.folder import read_scene, write_scene
from toolkit.settings import Choice, Group, Settings
from toolkit.splat.pose_presets import pose_preset_settings

TRAJECTORIES = "slam_trajectories"
"""Among the artifacts: a file for each segment that was taken, with the poses of all its frames by their times in
the video, in the segment's own world."""


class SlamNoposegsSettings(Settings):
    """What both recipes have in common."""

    segment = Choice(
        "largest",
        choices=("largest", "last", "merge"),
        doc="Where tracking was lost there are several segments, each in a world of its own. largest: the one with "
        "most frames is taken; last: the last one, as in A-3DGS (section 5.4); merge: all that GPS can place, "
        "joined in metres (its section 7).",
    )
    merge = Group(MergeSettings(), doc="How GPS joins the segments (segment=merge)")
    pictures = Group(PictureSettings(), doc="How the video's frames are written for SLAM")
    points = Group(SlamPointSettings(), doc="Points under the poses")
    train = Group(pose_preset_settings("poses-short"), doc="Gaussian splats and refined poses")


class OrbslamNoposegsSettings(SlamNoposegsSettings, VideoSettings):
    """Settings of every stage of ORBSLAM-NoposeGS."""

    slam = Group(OrbSlam3Settings(), doc="ORB-SLAM3")


class OrbPnpNoposegsSettings(SlamNoposegsSettings):
    """Settings of every stage of ORB-PnP-NoposeGS."""

    slam = Group(OrbPnpSettings(), doc="SLAM")


def run_orbslam3(data: RecipeInput, settings: OrbslamNoposegsSettings, context: RecipeContext) -> RecipeResult:
    """Track the video with ORB-SLAM3, triangulate points, then train a splat that refines the poses."""
    lpips = Lpips()
    film = film_of(data)
    tracker = orbslam3_tracker(film, settings.slam, settings, context)
    return train_and_measure(
        data, _slam_stages(data, film, tracker, settings, context), settings.train, context, lpips
    )


def run_orb_pnp(data: RecipeInput, settings: OrbPnpNoposegsSettings, context: RecipeContext) -> RecipeResult:
    """Track the video with the SLAM of our own, triangulate points, then train a splat that refines the poses."""
    lpips = Lpips()
    posed = _slam_stages(data, film_of(data), orb_pnp_tracker(settings.slam), settings, context)
    return train_and_measure(data, posed, settings.train, context, lpips)


def _slam_stages(
    data: RecipeInput, film: Film, tracker: Tracker, settings: SlamNoposegsSettings, context: RecipeContext
) -> PosedStages:
    """Return the stages up to points under SLAM's poses, and copy the trajectory to the artifacts."""
    tracked = track_stage(data, film, tracker, settings.pictures, context)
    placed = place_stage(data, tracked, settings.segment, settings.merge, context)
    trajectories = context.artifacts / TRAJECTORIES
    with disk_errors(context.artifacts, "writing"):
        trajectories.mkdir(exist_ok=True)
        for number in placed.report["chosen"]:
            shutil.copyfile(tracked.folder / SEGMENTS / frames_file(number), trajectories / frames_file(number))
    pointed = _points_stage(placed, settings.points, context)
    metrics = {
        **sfm_metrics(read_scene(pointed.folder / SCENE), pointed.report),
        **slam_metrics(tracked, placed),
    }
    return PosedStages((*tracker.before, tracked, placed, pointed), metrics)


def _points_stage(placed: CachedStage, settings: SlamPointSettings, context: RecipeContext) -> CachedStage:
    def points_into(folder: Path) -> dict[str, Any]:
        scene = slam_points(
            read_scene(placed.folder / SCENE),
            settings,
            seed=context.seed,
            progress=context.progress,
            work_dir=folder / "work",
        )
        write_scene(scene, folder / SCENE)
        assert scene.points is not None  # slam_points raises where there are none
        assert scene.points.error is not None
        return {"points": len(scene.points), "mean_reprojection_error": float(scene.points.error.mean())}

    return cached_stage(
        context,
        "points",
        inputs={"place": placed.output.key},
        settings=settings,
        code=(matching, poses),
        build=points_into,
    )


_NEEDS = (
    "Needs a video (video.mp4 beside scene.json) of which the pictures are frames, and known intrinsics: they are "
    "not refined. Training starts with short settings; the paper's own are the preset orbslam-noposegs. Poses have "
    "neither scale nor place, unless segments are merged by GPS (segment=merge)."
)

ORBSLAM = Recipe(
    name="orbslam-noposegs",
    title="ORBSLAM-NoposeGS",
    paper="a-3dgs",
    description=(
        "Poses from ORB-SLAM3 over all frames of the video, points triangulated under them, undistorted photos, 3D "
        "Gaussian splatting that refines the poses as NoposeGS does. Needs the package pyorbslam3 (GPL 3.0); "
        f"visual words are trained from the flight where no vocabulary is given, and timed apart. {_NEEDS}"
    ),
    settings_type=OrbslamNoposegsSettings,
    run=run_orbslam3,
)

ORB_PNP = Recipe(
    name="orb-pnp-noposegs",
    title="ORB-PnP-NoposeGS",
    paper="",
    description=(
        "As ORBSLAM-NoposeGS with a simpler SLAM of our own in place of ORB-SLAM3: ORB features, PnP against a "
        f"local map, local adjustment, no loop closing. {_NEEDS}"
    ),
    settings_type=OrbPnpNoposegsSettings,
    run=run_orb_pnp,
)
