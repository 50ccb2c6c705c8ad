"""Structure under sensor poses: points triangulated from matches, all adjusted with GPS as prior, no mapper."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.files import disk_errors
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.matching.colmap_job import run_colmap
from toolkit.matching.database import copy_database, require_same_frames
from toolkit.poses.adjust import AdjustmentReport
from toolkit.poses.sensor_biases import SensorBiases, estimate_biases
from toolkit.poses.sensor_heading import with_heading_taken
from toolkit.poses.sensor_outcome import drop_unsupported, require_positions, residuals, settle_line
from toolkit.poses.sensor_pixels import PixelCheck, check_pixels
from toolkit.poses.sensor_refine import Refinement, SensorSfmSettings
from toolkit.poses.sensors import SensorPoses, sensor_poses, some
from toolkit.poses.sfm_failure import check_matches
from toolkit.poses.square_pixels import with_models_of, with_one_focal
from toolkit.progress import Progress, silent
from toolkit.scene import Scene, scene_from_pycolmap

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SensorSfmResult:
    """Poses from sensors, refined by the pictures.

    Attributes
    ----------
    scene:
        The scene with refined poses, cameras, points and tracks, in the sensors' east-north-up frame.
    sensors:
        The poses before the refinement, with turns put in.
    pixels:
        What the pictures said of the sensors.
    placed_by_points:
        Names of frames without position or attitude that the points gave a pose.
    placed_by_start:
        Names of such frames that began with a pose from elsewhere.
    not_placed:
        Why frames have no pose, by their names.
    rounds:
        What each adjustment did.
    biases:
        Constant errors of the sensors, from the refined poses and the readings as they came.
    position_residual, rotation_residual:
        By frame name, how far the refined pose is from the sensors', in metres and degrees.
    mean_track_length, mean_reprojection_error:
        Observations per point; pixels.
    warnings:
        Of all parts, a sentence each.
    seconds:
        Wall time by part.
    """

    scene: Scene
    sensors: SensorPoses
    pixels: PixelCheck
    placed_by_points: tuple[str, ...]
    placed_by_start: tuple[str, ...]
    not_placed: Mapping[str, str]
    rounds: tuple[AdjustmentReport, ...]
    biases: SensorBiases
    position_residual: Mapping[str, float]
    rotation_residual: Mapping[str, float]
    mean_track_length: float
    mean_reprojection_error: float
    warnings: tuple[str, ...]
    seconds: Mapping[str, float]

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "images": len(self.scene),
            "registered": len(self.scene.registered),
            "placed_by_points": list(self.placed_by_points),
            "placed_by_start": list(self.placed_by_start),
            "not_placed": dict(self.not_placed),
            "points": 0 if self.scene.points is None else len(self.scene.points),
            "mean_track_length": self.mean_track_length,
            "mean_reprojection_error": self.mean_reprojection_error,
            "position_residual_m": dict(self.position_residual),
            "rotation_residual_deg": dict(self.rotation_residual),
            "warnings": list(self.warnings),
            "sensors": self.sensors.to_dict(),
            "pixels": self.pixels.to_dict(),
            "rounds": [report.to_dict() for report in self.rounds],
            "biases": self.biases.to_dict(),
            "seconds": dict(self.seconds),
        }


def sensor_sfm(
    scene: Scene,
    database_path: Path,
    settings: SensorSfmSettings,
    *,
    start_poses: Mapping[str, RigidTransform] | None = None,
    seed: int = 0,
    progress: Progress = silent,
    work_dir: Path,
) -> SensorSfmResult:
    """Take poses from GPS and gimbal and refine them by matched pictures, without an incremental mapper.

    Points are triangulated under the sensors' poses with thresholds as loose as these poses are wrong, poses and
    points are adjusted with the GPS positions as robust priors, and both again with tighter thresholds. So the
    result stays in the sensors' metric frame.

    Parameters
    ----------
    scene:
        With priors (position and rotation) in a georeferenced frame, whose features are in the database.
    database_path:
        With features and verified matches. It is only read.
    settings:
        As declared.
    start_poses:
        By frame name, poses in the scene's own frame from which the rounds begin in place of the sensors': what
        SLAM found, joined with GPS. Readings stay what they are: positions hold the result, and all show the
        sensors' errors.
    seed:
        Of every random choice.
    progress:
        Told of each round; raises to cancel.
    work_dir:
        Folder for files that are needed meanwhile and removed at the end.

    Raises
    ------
    DataError
        For a database that is missing, damaged or of another scene.
    StageError
        Where sensors or matches do not suffice; the message says what is missing.
    """
    require_same_frames(database_path, scene)
    check_matches(database_path, settings.min_matches)
    start = time.perf_counter()
    # What is odd in the readings is told once, by the first look.
    sensors = sensor_poses(scene, settings)
    with disk_errors(work_dir, "writing"):
        work_dir.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=work_dir, prefix=".sensors.", suffix=".tmp") as temporary:
        # COLMAP changes a database by opening it; this one may belong to another stage.
        copy = Path(temporary) / "matches.db"
        copy_database(database_path, copy)
        pixels = check_pixels(sensors.scene, copy, progress=progress)
        if settings.correct_turns and pixels.turns:
            turned = sensor_poses(scene, settings, turns=pixels.turns)
            sensors = dataclasses.replace(turned, warnings=sensors.warnings)
        sensors = dataclasses.replace(sensors, scene=_with_heading_taken(sensors.scene, pixels.heading))
        checked = time.perf_counter()
        contradicted = pixels.contradicted if settings.distrust else {}
        started = _with_start_cameras(sensors.scene, copy)
        trusted = with_one_focal(started, copy) if settings.square_pixels else started
        trusted = _without_readings(trusted, contradicted)
        trusted = _without_guesses(trusted, sensors.from_flight_line)
        trusted = _with_poses(trusted, start_poses or {})
        _require_two(trusted, contradicted, pixels)
        turns = pixels.turns if settings.correct_turns else {}
        job = Refinement(trusted, copy, settings, seed, turns)
        model = run_colmap(job.run, job.event, progress, copy)
    refined = time.perf_counter()
    turned_about_line = settle_line(model, job.scene, guessed=sensors.from_flight_line)
    unusable = {
        **dict.fromkeys(sensors.no_attitude, "no gimbal attitude"),
        **dict.fromkeys(sensors.in_turn, "taken in a turn, where the flight does not tell the attitude"),
        **dict.fromkeys(sensors.no_position, "no GPS position"),
        **{name: f"the pictures contradict its {reading}" for name, reading in contradicted.items()},
    }
    by_start = [name for name in unusable if name in (start_poses or {})]
    for name in by_start:
        unusable.pop(name)
    not_placed = drop_unsupported(model, sensors.scene, unusable, job.others, settings.min_points)
    found = with_models_of(scene_from_pycolmap(model, scene.image_dir, like=sensors.scene), started)
    if len(found.registered) < 2:
        raise StageError(
            "The pictures do not support the sensors' poses",
            expected=f"frames that see at least {settings.min_points} points",
            found="; ".join(f"{name}: {why}" for name, why in list(not_placed.items())[:3]),
            todo="Look at the warnings of the readings, raise first_error, or use colmap-3dgs",
        )
    position, rotation = residuals(found)
    require_positions(found, position)
    read = _without_guesses(_without_readings(found, contradicted, keep_pose=True), sensors.from_flight_line)
    biases = estimate_biases(read, turns=turns)
    return SensorSfmResult(
        scene=found,
        sensors=sensors,
        pixels=pixels,
        placed_by_points=tuple(name for name in job.others.placed if name not in not_placed),
        placed_by_start=tuple(name for name in by_start if name not in not_placed),
        not_placed=not_placed,
        rounds=tuple(job.reports),
        biases=biases,
        position_residual=position,
        rotation_residual=rotation,
        mean_track_length=float(model.compute_mean_track_length()),
        mean_reprojection_error=float(model.compute_mean_reprojection_error()),
        warnings=(
            *sensors.warnings,
            *pixels.warnings,
            *turned_about_line,
            *_focal_warning(job.reports[-1]),
            *_lost(not_placed, unusable),
        ),
        seconds={"check": checked - start, "refine": refined - checked},
    )


def _with_start_cameras(scene: Scene, database_path: Path) -> Scene:
    """Return the scene with the cameras that the features were extracted with: their model may be another."""
    with closing(pycolmap.Database.open(database_path)) as database:
        cameras = {int(c.camera_id): ColmapCamera.from_pycolmap(c) for c in database.read_all_cameras()}
    return scene.replace(cameras={**scene.cameras, **cameras})


def _with_heading_taken(scene: Scene, degrees: float) -> Scene:
    """Return the scene with poses turned about the vertical; the readings stay as they came."""
    frames = (
        frame
        if frame.cam_from_world is None
        else dataclasses.replace(frame, cam_from_world=with_heading_taken(frame.cam_from_world, degrees))
        for frame in scene.frames
    )
    return scene.replace(frames=tuple(frames))


def _with_poses(scene: Scene, poses: Mapping[str, RigidTransform]) -> Scene:
    """Return the scene with these poses in place of its own; readings stay."""
    frames = (
        dataclasses.replace(frame, cam_from_world=poses.get(frame.name, frame.cam_from_world))
        for frame in scene.frames
    )
    return scene.replace(frames=tuple(frames))


def _require_two(scene: Scene, contradicted: Mapping[str, str], pixels: PixelCheck) -> None:
    if len(scene.registered) >= 2:
        return
    said = "; ".join((*pixels.warnings, *(f"{name}: its {what}" for name, what in list(contradicted.items())[:3])))
    raise StageError(
        "The pictures contradict the readings of nearly all photos",
        expected="at least 2 photos whose position and attitude agree with their matches",
        found=f"{len(scene.registered)}; {said}",
        todo="Check times, positions and angles, set distrust to no to use them as they are, or use colmap-3dgs",
    )


def _without_readings(scene: Scene, names: Iterable[str], *, keep_pose: bool = False) -> Scene:
    """Return the scene without prior for some frames, and without their poses unless these are kept."""
    dropped = set(names)
    frames = (
        dataclasses.replace(frame, cam_from_world=frame.cam_from_world if keep_pose else None, prior=None)
        if frame.name in dropped
        else frame
        for frame in scene.frames
    )
    return scene.replace(frames=tuple(frames))


def _without_guesses(scene: Scene, names: Iterable[str]) -> Scene:
    """Return the scene without the attitudes that no sensor told in its priors: they show no sensor's errors."""
    guessed = set(names)
    return scene.replace(
        frames=tuple(
            dataclasses.replace(frame, prior=dataclasses.replace(frame.prior, rotation=None, rotation_sigma=None))
            if frame.name in guessed and frame.prior is not None
            else frame
            for frame in scene.frames
        )
    )


def _focal_warning(last: AdjustmentReport) -> Sequence[str]:
    if last.focal != "not determined":
        return ()
    sigma = "" if last.focal_sigma is None else f" (to {100 * last.focal_sigma:.0f} % only)"
    return (
        f"the pictures do not determine the focal length{sigma}: it was kept, and heights of the ground are as "
        "wrong as it is; tilted photos or another flying height would tell",
    )


def _lost(not_placed: Mapping[str, str], unusable: Mapping[str, str]) -> Sequence[str]:
    lost = [name for name in not_placed if name not in unusable]
    return [f"{len(lost)} photos lost their pose because they see too few points: {some(lost)}"] if lost else []
