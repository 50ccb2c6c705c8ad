"""Measures ORB-SLAM3 and our own ``orb-pnp`` against the truth: a drive of KITTI, two filmed flights, a lost track.

``TOOLKIT_DATA=<folder> python tests/benchmarks/slam.py [--runs 5] [--flights DIR] [--work DIR]`` prints tables:
medians of all runs, with their range. ORB-SLAM3 gets the frames in real time (``--pace 1``); its visual words are
trained from each video's own frames. The flights are those of ``toolkit sample orbit-video|spiral-video``, made
where they are missing. In ``spiral-lost`` the middle third of the spiral's frames is black.

``--work`` keeps what is done, times included, and does not do it again as long as the code is the same: in
``trajectories/<sequence>/<backend>/run-<n>`` two TUM files for each segment, in ``logs`` what ORB-SLAM3 said, in
``slam.md`` the tables. Without ``TOOLKIT_DATA`` the drive is left out. Measure on a machine that has nothing else
to do: beside other work ORB-SLAM3 loses frames.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from slam_tables import MEASURES, SEQUENCE_HEAD, WORDS_HEAD, Measured, cells, length, markdown, measured

from toolkit import capture, poses
from toolkit.capture.frames import PictureSettings, video_frames
from toolkit.errors import DataError, MissingDependencyError, StageError
from toolkit.files import read_json, write_text
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.poses.slam.merge import MergeSettings
from toolkit.poses.slam.orb_pnp import OrbPnp, OrbPnpSettings
from toolkit.poses.slam.orbslam3 import OrbSlam3, OrbSlam3Settings
from toolkit.poses.slam.place import Placing
from toolkit.poses.slam.result import SlamBackend, SlamResult
from toolkit.poses.slam.result_files import read_result, write_result
from toolkit.poses.slam.vocabulary import VocabularySettings, train_vocabulary
from toolkit.progress import Progress, TqdmProgress
from toolkit.recipes.base import RecipeContext
from toolkit.recipes.cached import cached_stage
from toolkit.recipes.flight_video import scene_by_video
from toolkit.recipes.slam_noposegs import OrbslamNoposegsSettings
from toolkit.runs.machine import describe_machine
from toolkit.samples.drone_flights import FLIGHTS, make_drone_flight
from toolkit.scene import Scene
from toolkit.scene.trajectory_files import read_tum
from toolkit.settings import Settings
from toolkit.workspace import Workspace, file_fingerprint

SEQUENCES = ("kitti-03", "orbit", "spiral", "spiral-lost")
CHOICES: tuple[Placing, ...] = ("largest", "last", "merge")
# What may befall a run without ending the measurement: ORB-SLAM3 crashed or is not installed.
FAILURES = (StageError, MissingDependencyError)


@dataclass(frozen=True)
class Filmed:
    """A video with each frame's true pose, those in ``dark`` shown black; ``scene``: pictures of it with GPS."""

    name: str
    video: Path
    camera: ColmapCamera
    truth: tuple[RigidTransform, ...]
    scene: Scene | None = None
    dark: range = range(0)


def drive(data: Path) -> Filmed:
    """Return KITTI's drive."""
    folder = data / "video_kitti_03"
    known = read_json(folder / "intrinsics.json")
    intrinsics = tuple(float(known[name]) for name in ("fx", "fy", "cx", "cy"))
    camera = ColmapCamera(known["model"], known["width"], known["height"], intrinsics)
    return Filmed(SEQUENCES[0], folder / "video.mp4", camera, read_tum(folder / "groundtruth_tum.txt").poses)


def flight(name: str, folder: Path, progress: Progress) -> Filmed:
    """Return a filmed flight, made where it is missing."""
    made = make_drone_flight(folder / f"{name}-0", FLIGHTS[name](), seed=0, progress=progress)
    camera = made.scene.camera_of(made.scene.frames[0])
    assert isinstance(camera, ColmapCamera)
    return Filmed(name, made.video, camera, read_tum(made.reference).poses, made.scene)


def with_lost_middle(filmed: Filmed) -> Filmed:
    """Return the flight with its middle third in the dark."""
    count = len(filmed.truth)
    return replace(filmed, name=f"{filmed.name}-lost", dark=range(count // 3, 2 * count // 3))


def shown_frames(sequence: Filmed, context: RecipeContext) -> tuple[list[Path], list[Path], NDArray[np.float64]]:
    """Return the frames as SLAM sees them, the same as filmed, and their times."""

    def frames_into(folder: Path) -> dict[str, list[object]]:
        frames = video_frames(sequence.video, folder / "frames", PictureSettings(), progress=context.progress)
        return {"names": list(frames.names), "times": frames.times.tolist()}

    decoded = cached_stage(
        replace(context, seed=0),
        "frames",
        inputs={"video": file_fingerprint(sequence.video)},
        settings=PictureSettings(),
        code=(capture,),
        build=frames_into,
    )
    filmed = [decoded.folder / "frames" / name for name in decoded.report["names"]]
    if len(filmed) != len(sequence.truth):
        raise DataError(
            f"The truth of {sequence.name} does not fit its video",
            expected=f"{len(filmed)} poses, one for each frame",
            found=str(len(sequence.truth)),
        )
    black = context.artifacts / f"black_{sequence.camera.width}x{sequence.camera.height}.png"
    Image.new("RGB", (sequence.camera.width, sequence.camera.height)).save(black)
    shown = [black if i in sequence.dark else path for i, path in enumerate(filmed)]
    return shown, filmed, np.array(decoded.report["times"])


def visual_words(sequence: Filmed, filmed: Sequence[Path], context: RecipeContext) -> tuple[Path, dict[str, float]]:
    """Return ORB-SLAM3's vocabulary with the report of its training, as the recipe trains it."""
    most = OrbslamNoposegsSettings().word_frames
    numbers = np.unique(np.linspace(0, len(filmed) - 1, min(most, len(filmed))).round().astype(int))

    def words_into(folder: Path) -> dict[str, float]:
        pictures = [filmed[number] for number in numbers]
        report = train_vocabulary(
            pictures, folder / "words.txt", VocabularySettings(), seed=0, progress=context.progress
        )
        return report.to_dict()

    trained = cached_stage(
        replace(context, seed=0),
        "vocabulary",
        inputs={"video": file_fingerprint(sequence.video), "frames": numbers.tolist()},
        settings=VocabularySettings(),
        code=(capture, poses),
        build=words_into,
    )
    return trained.folder / "words.txt", trained.report


def tracked(
    sequence: Filmed,
    backend: SlamBackend,
    settings: Settings,
    inputs: dict[str, str],
    frames: tuple[Sequence[Path], NDArray[np.float64]],
    context: RecipeContext,
) -> SlamResult:
    """Return one run's result; its number is the context's seed. Its trajectories are left in the work folder."""
    run = f"run-{context.seed}"

    def result_into(folder: Path) -> dict[str, object]:
        logs = context.artifacts / "logs" / sequence.name / backend.name / run
        shutil.rmtree(logs, ignore_errors=True)
        logs.mkdir(parents=True)
        pictures, times = frames
        result = backend.track(
            pictures, times, sequence.camera, seed=context.seed, progress=context.progress, work_dir=logs
        )
        write_result(result, folder / "result")
        return result.to_dict()

    kept = cached_stage(
        context,
        "slam",
        inputs={
            "video": file_fingerprint(sequence.video),
            "dark": list(sequence.dark),
            "backend": backend.name,
            **inputs,
        },
        settings=settings,
        code=(capture, poses),
        build=result_into,
    )
    target = context.artifacts / "trajectories" / sequence.name / backend.name / run
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(kept.folder / "result", target)
    return read_result(target)


def placed_cells(sequence: Filmed, result: SlamResult, times: NDArray[np.float64]) -> list[str]:
    """Return for largest, last and merge how far the posed pictures are off, and how many these are."""
    assert sequence.scene is not None
    texts = []
    for how in CHOICES:
        try:
            placed = scene_by_video(
                sequence.scene.without_poses(), result, how, times, settings=MergeSettings()
            ).scene
            errors = [trajectory_errors(placed, sequence.scene, "sim3")]
            errors += [trajectory_errors(placed, sequence.scene, "none")] if how == "merge" else []
        except (StageError, DataError) as error:
            texts.append(f"none: {str(error).split('; ')[0]}")
            continue
        off = ", as placed ".join(f"{each.ate:.3f}" for each in errors)
        texts.append(f"{off} ({len(placed.registered)} of {len(placed)} pictures)")
    return texts


class Report:
    """Rows of the tables as they come."""

    def __init__(self, title: str) -> None:
        self._title = title
        self.sequences: list[list[str]] = []
        self.runs: list[list[str]] = []
        self.lost: list[list[str]] = []

    def __str__(self) -> str:
        tables = (
            markdown([*SEQUENCE_HEAD, *WORDS_HEAD], self.sequences),
            markdown(["sequence", "backend", "runs", *(title for title, _ in MEASURES)], self.runs),
            markdown(
                ["sequence", "backend", "run", "frames of each segment", *(f"{how}: ATE (m)" for how in CHOICES)],
                self.lost,
            ),
        )
        return "\n".join([self._title + "\n", *filter(None, tables)])


def measure(sequence: Filmed, runs: int, pace: float, context: RecipeContext, report: Report) -> None:
    """Run both backends on a sequence and add to the report."""
    shown, filmed, times = shown_frames(sequence, context)
    words, trained = visual_words(sequence, filmed, context)
    whole = [
        str(len(filmed)),
        f"{sequence.camera.width} x {sequence.camera.height}",
        f"{length(sequence.truth):.1f}",
    ]
    counts = [f"{trained[name]:.0f}" for name in ("pictures", "descriptors", "words")]
    report.sequences.append([sequence.name, *whole, *counts, f"{trained['seconds']:.1f}"])
    real_time, plain = OrbSlam3Settings(pace=pace), OrbPnpSettings()
    backends: list[tuple[SlamBackend, Settings, dict[str, str], int]] = [
        (OrbSlam3(words, real_time), real_time, {"vocabulary": file_fingerprint(words)}, runs),
        (OrbPnp(plain), plain, {}, 1),  # repeatable
    ]
    for backend, settings, inputs, times_run in backends:
        done: list[Measured] = []
        failed: list[str] = []
        for run in range(times_run):
            print(f"{sequence.name}, {backend.name}, run {run + 1} of {times_run}", file=sys.stderr)
            try:
                result = tracked(sequence, backend, settings, inputs, (shown, times), replace(context, seed=run))
            except FAILURES as error:
                failed.append(str(error))
                print(f"  failed: {error}", file=sys.stderr)
                continue
            done.append(measured(result, sequence.truth))
            print(f"  {done[-1]}", *(f"  {note}" for note in result.notes), sep="\n", file=sys.stderr)
            if sequence.dark:
                sizes = " + ".join(str(len(segment.frames)) for segment in result.segments) or "none"
                placed = placed_cells(sequence, result, times)
                report.lost.append([sequence.name, backend.name, str(run + 1), sizes, *placed])
        count = f"{len(done)}" + (f" of {times_run}, else: {failed[0].split('; ')[0]}" if failed else "")
        report.runs.append([sequence.name, backend.name, count, *cells(done)])


def sequences(names: Sequence[str], flights: Path, progress: Progress) -> list[Filmed]:
    """Return the sequences of these names; the drive only where ``TOOLKIT_DATA`` is set."""
    data = os.environ.get("TOOLKIT_DATA")
    chosen = [drive(Path(data))] if data and SEQUENCES[0] in names else []
    if SEQUENCES[0] in names and not data:
        print("TOOLKIT_DATA is not set: it names the folder with the real drive, which was not measured.")
    for name in FLIGHTS:
        lost = f"{name}-lost"
        if name in names or lost in names:
            filmed = flight(name, flights, progress)
            chosen += [filmed] if name in names else []
            chosen += [with_lost_middle(filmed)] if lost in names else []
    return chosen


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument(
        "--runs", type=int, default=5, help="of ORB-SLAM3 on each sequence; orb-pnp is repeatable [5]"
    )
    parser.add_argument("--pace", type=float, default=1.0, help="of ORB-SLAM3's frames; 1 is real time [1]")
    parser.add_argument("--work", type=Path, default=Path("runs/bench-slam"), help="keeps what is done")
    parser.add_argument("--flights", type=Path, help="folder of orbit-0 and spiral-0 [WORK/flights]")
    parser.add_argument("--sequences", nargs="+", choices=SEQUENCES, default=SEQUENCES, help="which ones [all]")
    arguments = parser.parse_args()
    work = arguments.work
    work.mkdir(parents=True, exist_ok=True)
    machine = describe_machine("cpu")
    bar = TqdmProgress()
    context = RecipeContext(Workspace(work / "workspace"), work, work, 0, "cpu", bar)
    title = (
        f"ORB-SLAM3 at pace {arguments.pace:g}, {arguments.runs} runs; median (range). {machine['cpu']}, "
        f"{machine['cores']} cores, load {os.getloadavg()[0]:.1f} at the start. Errors and path are those of the "
        "segment with most frames, after Sim(3). The time of a frame is the time in the call that takes it: "
        "ORB-SLAM3 builds its map in other threads meanwhile, orb-pnp in the call. Tracked frames have a pose that "
        "can be read: of ORB-SLAM3's maps but the largest, keyframes only."
    )
    report = Report(title)
    try:
        for sequence in sequences(arguments.sequences, arguments.flights or work / "flights", bar):
            measure(sequence, arguments.runs, arguments.pace, context, report)
            write_text(work / "slam.md", str(report))
    finally:
        bar.close()
    print(report)
    print(f"Trajectories are in {work / 'trajectories'}.", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
