"""ORBSLAM-NoposeGS of the drone paper (A-3DGS, section 3.2.1), and the same with a SLAM of our own.

SLAM runs over all frames of the flight's video. The pictures of the scene are frames of that video, so they get
their poses out of SLAM's trajectory by their times, and every method sees the same pictures. Points are
triangulated under these poses, and training refines them.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from toolkit import capture, matching, poses
from toolkit.capture.frames import PictureSettings, video_frames
from toolkit.files import disk_errors, read_json, write_json
from toolkit.metrics.lpips import Lpips
from toolkit.optional import require
from toolkit.poses.slam.merge import MergeSettings
from toolkit.poses.slam.orb_pnp import OrbPnp, OrbPnpSettings
from toolkit.poses.slam.orbslam3 import OrbSlam3, OrbSlam3Settings
from toolkit.poses.slam.place import Placing
from toolkit.poses.slam.points import SlamPointSettings, slam_points
from toolkit.poses.slam.result import SlamBackend
from toolkit.poses.slam.result_files import frames_file, read_result, write_result
from toolkit.poses.slam.segments import choose_segment
from toolkit.poses.slam.vocabulary import VocabularySettings, train_vocabulary
from toolkit.poses.slam.vocabulary_file import check_vocabulary
from toolkit.recipes import flight_video
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.flight_video import Film, film_of, scene_by_video
from toolkit.recipes.steps import SCENE, PosedStages, sfm_metrics, train_and_measure
from toolkit.scene.folder import read_scene, write_scene
from toolkit.settings import Choice, Group, Integer, Settings, Text
from toolkit.splat.pose_presets import pose_preset_settings
from toolkit.workspace import file_fingerprint

TRAJECTORIES = "slam_trajectories"
"""Among the artifacts: a file for each segment that was taken, with the poses of all its frames by their times in
the video, in the segment's own world."""

# What stage slam keeps: all segments, and the times of the video's frames.
_SEGMENTS = "segments"
_TIMES = "times.json"
_VOCABULARY = "words.txt"
_WORK = "slam"


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


class OrbslamNoposegsSettings(SlamNoposegsSettings):
    """Settings of every stage of ORBSLAM-NoposeGS."""

    slam = Group(OrbSlam3Settings(), doc="ORB-SLAM3")
    vocabulary = Text(
        "",
        doc="File of visual words for ORB-SLAM3 (toolkit vocabulary); empty: trained from the flight's own frames.",
    )
    words = Group(VocabularySettings(), doc="Training of the visual words, where no file is given")
    word_frames = Integer(
        200, bounds=(1, 100_000), unit="frames", doc="Most frames of the video that words are trained from, evenly."
    )


class OrbPnpNoposegsSettings(SlamNoposegsSettings):
    """Settings of every stage of ORB-PnP-NoposeGS."""

    slam = Group(OrbPnpSettings(), doc="SLAM")


def run_orbslam3(data: RecipeInput, settings: OrbslamNoposegsSettings, context: RecipeContext) -> RecipeResult:
    """Track the video with ORB-SLAM3, triangulate points, then train a splat that refines the poses."""
    lpips = Lpips()
    film = film_of(data)
    require("pyorbslam3")
    words = Path(settings.vocabulary)
    before: tuple[CachedStage, ...] = ()
    if settings.vocabulary:
        check_vocabulary(words)
    else:
        trained = _vocabulary_stage(film, settings, context)
        words, before = trained.folder / _VOCABULARY, (trained,)
    backend = OrbSlam3(words, settings.slam)
    stages, metrics = _slam_stages(
        data, film, backend, settings, settings.slam, {"vocabulary": file_fingerprint(words)}, context
    )
    return train_and_measure(data, PosedStages((*before, *stages), metrics), settings.train, context, lpips)


def run_orb_pnp(data: RecipeInput, settings: OrbPnpNoposegsSettings, context: RecipeContext) -> RecipeResult:
    """Track the video with the SLAM of our own, triangulate points, then train a splat that refines the poses."""
    lpips = Lpips()
    film = film_of(data)
    stages, metrics = _slam_stages(data, film, OrbPnp(settings.slam), settings, settings.slam, {}, context)
    return train_and_measure(data, PosedStages(stages, metrics), settings.train, context, lpips)


def _vocabulary_stage(film: Film, settings: OrbslamNoposegsSettings, context: RecipeContext) -> CachedStage:
    """Return the stage that trains visual words from frames of the video."""
    numbers = np.unique(np.linspace(0, film.frames - 1, min(settings.word_frames, film.frames)).round().astype(int))

    def words_into(folder: Path) -> dict[str, Any]:
        with tempfile.TemporaryDirectory(dir=folder) as decoded:
            frames = video_frames(
                film.path, Path(decoded) / "frames", settings.pictures, numbers=numbers, progress=context.progress
            )
            report = train_vocabulary(
                [frames.folder / name for name in frames.names],
                folder / _VOCABULARY,
                settings.words,
                seed=context.seed,
                progress=context.progress,
            )
        return report.to_dict()

    return cached_stage(
        context,
        "vocabulary",
        inputs={
            "video": file_fingerprint(film.path),
            "frames": numbers.tolist(),
            "pictures": settings.pictures.to_dict(),
        },
        settings=settings.words,
        code=(capture, poses),
        build=words_into,
    )


def _slam_stages(
    data: RecipeInput,
    film: Film,
    backend: SlamBackend,
    settings: SlamNoposegsSettings,
    own: Settings,
    inputs: Mapping[str, str],
    context: RecipeContext,
) -> tuple[tuple[CachedStage, CachedStage, CachedStage], dict[str, float | None]]:
    """Return the stages slam, place and points with their measures, and copy the trajectory to the artifacts.

    ``own`` are the backend's settings, ``inputs`` what else its result depends on.
    """
    tracked = _track_stage(data, film, backend, settings, own, inputs, context)
    placed = _place_stage(data, tracked, settings, context)
    trajectories = context.artifacts / TRAJECTORIES
    with disk_errors(context.artifacts, "writing"):
        trajectories.mkdir(exist_ok=True)
        for number in placed.report["chosen"]:
            shutil.copyfile(tracked.folder / _SEGMENTS / frames_file(number), trajectories / frames_file(number))
    pointed = _points_stage(placed, settings.points, context)
    report = tracked.report
    metrics: dict[str, float | None] = {
        **sfm_metrics(read_scene(pointed.folder / SCENE), pointed.report),
        "slam.segments": float(len(report["segments"])),
        "slam.keyframes": float(sum(report["segments"][i]["keyframes"] for i in placed.report["chosen"])),
        "slam.tracked": float(placed.report["images_tracked"]),
        "slam.frame_ms": report["frame_ms_median"],
    }
    return (tracked, placed, pointed), metrics


def _track_stage(
    data: RecipeInput,
    film: Film,
    backend: SlamBackend,
    settings: SlamNoposegsSettings,
    own: Settings,
    inputs: Mapping[str, str],
    context: RecipeContext,
) -> CachedStage:
    """Return the stage that tracks the video; it keeps all segments, so that each choice of them finds it done."""
    work = context.artifacts / _WORK

    def poses_into(folder: Path) -> dict[str, Any]:
        # Among the artifacts, so that the log of a backend that crashed is still there.
        with disk_errors(work, "preparing"):
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir(parents=True)
        start = time.perf_counter()
        with tempfile.TemporaryDirectory(dir=folder) as decoded:
            frames = video_frames(film.path, Path(decoded) / "frames", settings.pictures, progress=context.progress)
            decoding = time.perf_counter() - start
            pictures = [frames.folder / name for name in frames.names]
            result = backend.track(
                pictures, frames.times, film.camera, seed=context.seed, progress=context.progress, work_dir=work
            )
        if not any(work.iterdir()):
            work.rmdir()
        # Raises where there is no segment: that is not kept, because another run may find some.
        choose_segment(result)
        write_result(result, folder / _SEGMENTS)
        write_json(folder / _TIMES, frames.times.tolist())
        return {**result.to_dict(), "decoding_seconds": decoding}

    return cached_stage(
        context,
        "slam",
        inputs={
            "capture": data.fingerprint,
            "video": file_fingerprint(film.path),
            "backend": backend.name,
            "pictures": settings.pictures.to_dict(),
            **inputs,
        },
        settings=own,
        code=(capture, poses),
        build=poses_into,
    )


def _place_stage(
    data: RecipeInput, tracked: CachedStage, settings: SlamNoposegsSettings, context: RecipeContext
) -> CachedStage:
    """Return the stage that gives the pictures the poses of the segments that are chosen."""
    how: Placing = settings.segment

    def scene_into(folder: Path) -> dict[str, Any]:
        placed = scene_by_video(
            data.scene,
            read_result(tracked.folder / _SEGMENTS),
            how,
            np.array(read_json(tracked.folder / _TIMES)),
            settings=settings.merge,
            seed=context.seed,
            progress=context.progress,
        )
        write_scene(placed.scene, folder / SCENE)
        return {
            "chosen": list(placed.segments),
            "merged": placed.merged,
            "images": len(placed.scene),
            "images_tracked": len(placed.scene.registered),
        }

    return cached_stage(
        context,
        "place",
        inputs={"slam": tracked.output.key, "segment": how},
        settings=settings.merge,
        code=(poses, flight_video),
        build=scene_into,
    )


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
