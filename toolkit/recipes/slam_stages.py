"""The stages of a flight's video in SLAM: visual words, tracking, and poses for the frames that are pictures."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from toolkit import capture, poses
from toolkit.capture.frames import PictureSettings, video_frames
from toolkit.files import disk_errors, read_json, write_json
from toolkit.optional import require
from toolkit.poses.slam.merge import MergeSettings
from toolkit.poses.slam.orb_pnp import OrbPnp, OrbPnpSettings
from toolkit.poses.slam.orbslam3 import OrbSlam3, OrbSlam3Settings
from toolkit.poses.slam.place import Placing
from toolkit.poses.slam.result import SlamBackend
from toolkit.poses.slam.result_files import read_result, write_result
from toolkit.poses.slam.segments import choose_segment
from toolkit.poses.slam.vocabulary import VocabularySettings, train_vocabulary
from toolkit.poses.slam.vocabulary_file import check_vocabulary
from toolkit.recipes import flight_video
from toolkit.recipes.base import RecipeContext, RecipeInput
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.flight_video import Film, scene_by_video
from toolkit.recipes.steps import SCENE
from toolkit.scene.folder import write_scene
from toolkit.settings import Group, Integer, Settings, Text
from toolkit.workspace import file_fingerprint

#: Folder of all segments in what stage slam keeps.
SEGMENTS = "segments"
# The times of the video's frames, beside them.
_TIMES = "times.json"
_VOCABULARY = "words.txt"
_WORK = "slam"


class VideoSettings(Settings):
    """What SLAM is given: the video's frames, and for ORB-SLAM3 its visual words."""

    pictures = Group(PictureSettings(), doc="How the video's frames are written for SLAM")
    vocabulary = Text(
        "",
        doc="File of visual words for ORB-SLAM3 (toolkit vocabulary); empty: trained from the flight's own frames.",
    )
    words = Group(VocabularySettings(), doc="Training of the visual words, where no file is given")
    word_frames = Integer(
        200, bounds=(1, 100_000), unit="frames", doc="Most frames of the video that words are trained from, evenly."
    )


@dataclass(frozen=True)
class Tracker:
    """A SLAM backend and everything that its result depends on.

    Attributes
    ----------
    backend:
        Ready to track.
    settings:
        Its own.
    inputs:
        What else its result depends on.
    before:
        Stages that were needed for it.
    """

    backend: SlamBackend
    settings: Settings
    inputs: Mapping[str, str] = field(default_factory=dict)
    before: tuple[CachedStage, ...] = ()


def orbslam3_tracker(film: Film, slam: OrbSlam3Settings, words: VideoSettings, context: RecipeContext) -> Tracker:
    """Return ORB-SLAM3, with visual words that are trained where no file is given.

    Raises
    ------
    MissingDependencyError
        Without pyorbslam3.
    DataError
        For a vocabulary that is missing or damaged.
    """
    require("pyorbslam3")
    path = Path(words.vocabulary)
    before: tuple[CachedStage, ...] = ()
    if words.vocabulary:
        check_vocabulary(path)
    else:
        trained = _vocabulary_stage(film, words, context)
        path, before = trained.folder / _VOCABULARY, (trained,)
    return Tracker(OrbSlam3(path, slam), slam, {"vocabulary": file_fingerprint(path)}, before)


def orb_pnp_tracker(slam: OrbPnpSettings) -> Tracker:
    """Return the SLAM of our own."""
    return Tracker(OrbPnp(slam), slam)


def _vocabulary_stage(film: Film, settings: VideoSettings, context: RecipeContext) -> CachedStage:
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


def track_stage(
    data: RecipeInput, film: Film, tracker: Tracker, pictures: PictureSettings, context: RecipeContext
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
            frames = video_frames(film.path, Path(decoded) / "frames", pictures, progress=context.progress)
            decoding = time.perf_counter() - start
            result = tracker.backend.track(
                [frames.folder / name for name in frames.names],
                frames.times,
                film.camera,
                seed=context.seed,
                progress=context.progress,
                work_dir=work,
            )
        if not any(work.iterdir()):
            work.rmdir()
        # Raises where there is no segment: that is not kept, because another run may find some.
        choose_segment(result)
        write_result(result, folder / SEGMENTS)
        write_json(folder / _TIMES, frames.times.tolist())
        return {**result.to_dict(), "decoding_seconds": decoding}

    return cached_stage(
        context,
        "slam",
        inputs={
            "capture": data.fingerprint,
            "video": file_fingerprint(film.path),
            "backend": tracker.backend.name,
            "pictures": pictures.to_dict(),
            **tracker.inputs,
        },
        settings=tracker.settings,
        code=(capture, poses),
        build=poses_into,
    )


def place_stage(
    data: RecipeInput, tracked: CachedStage, how: Placing, merge: MergeSettings, context: RecipeContext
) -> CachedStage:
    """Return the stage that gives the pictures the poses of the segments that are chosen."""

    def scene_into(folder: Path) -> dict[str, Any]:
        placed = scene_by_video(
            data.scene,
            read_result(tracked.folder / SEGMENTS),
            how,
            np.array(read_json(tracked.folder / _TIMES)),
            settings=merge,
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
        settings=merge,
        code=(poses, flight_video),
        build=scene_into,
    )


def slam_metrics(tracked: CachedStage, placed: CachedStage) -> dict[str, float | None]:
    """Return what SLAM found as measures."""
    report, chosen = tracked.report, placed.report["chosen"]
    return {
        "slam.segments": float(len(report["segments"])),
        "slam.keyframes": float(sum(report["segments"][i]["keyframes"] for i in chosen)),
        "slam.tracked": float(placed.report["images_tracked"]),
        "slam.frame_ms": report["frame_ms_median"],
    }
