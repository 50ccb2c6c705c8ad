"""Which of COLMAP's camera models describes a lens, by observations that took no part in the fit.

Blade-inspection-sfm, section 4.3: SIMPLE_RADIAL and RADIAL cannot describe a borescope's lens, OPENCV_FISHEYE can.
The paper compares the arcs that come out with the one that it knows. Where nobody knows the arc, models are judged
by withheld observations and by BIC here. Neither says how well an open arc is known
(:mod:`toolkit.poses.arc_sigma` does): models that fit equally well may disagree about it by many degrees.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from toolkit.errors import SettingsError, StageError
from toolkit.files import disk_errors
from toolkit.matching.database import copy_database, require_same_frames
from toolkit.poses.camera_choice import Score, choose
from toolkit.poses.camera_comparison import ModelComparison, ModelFit
from toolkit.poses.camera_fits import JudgedFit, fit_all, used_cameras, within
from toolkit.poses.camera_judge import Judged, explained, free_intrinsics
from toolkit.poses.camera_start import plain_cameras, with_cameras, write_cameras
from toolkit.poses.held_out import MatchedTracks, hold_out, matched_tracks, withhold
from toolkit.poses.sfm import SfmSettings, incremental_sfm
from toolkit.poses.sfm_result import SfmResult
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene import Scene
from toolkit.settings import Boolean, Group, Integer, Number, Settings, Text

#: Models that are compared unless told otherwise, simple ones first.
MODELS = (
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "OPENCV_FISHEYE",
    "FOV",
    "SIMPLE_DIVISION",
    "DIVISION",
)
_NO_LENS = ("INVALID", "EQUIRECTANGULAR")


class CameraModelSettings(Settings):
    """Comparison of camera models."""

    models = Text(", ".join(MODELS), doc="COLMAP's names of the models, separated by commas.")
    start_focal = Number(
        0.0,
        bounds=(0.0, 1e6),
        unit="px",
        doc="Focal length that every model starts from, with the principal point in the picture's middle; 0: those "
        "of the scene's cameras.",
    )
    held_out = Number(0.5, bounds=(0.01, 1.0), doc="Part of the judging tracks that lose one observation.")
    min_track_length = Integer(
        4, bounds=(3, 1000), unit="pictures", doc="Tracks seen in fewer pictures judge no model."
    )
    max_tracks = Integer(
        4000, bounds=(50, 1000000), unit="tracks", doc="Of more, so many drawn at random judge the models."
    )
    max_error = Number(
        4.0,
        bounds=(0.1, 100.0),
        unit="px",
        doc="A track that no model explains to this error is a wrong match and judges none.",
    )
    min_registered = Number(
        0.9,
        bounds=(0.1, 1.0),
        doc="A model that places less than this part of the pictures of the best one counts as failed.",
    )
    restart = Boolean(
        True,
        doc="Adjust every model once more from the poses and the lens of the best one, and keep the better fit: "
        "a model that got lost on its way, starting without distortion, is not judged by that.",
    )
    resamples = Integer(1000, bounds=(100, 100000), doc="Of the bootstrap that tells how sure a difference is.")
    sfm = Group(SfmSettings(), doc="Incremental structure from motion")


def compare_models(
    scene: Scene,
    database_path: Path,
    settings: CameraModelSettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
    work_dir: Path,
) -> ModelComparison:
    """Fit camera models to the same features and matches and judge them by the same observations.

    1. Of the tracks of verified matches some are drawn; a share of them loses one observation each, the same for
       all models. These keypoints lose their matches, so that neither mapping nor adjustment sees them.
    2. Every model runs through structure from motion, starting without distortion.
    3. Tracks that at least one model explains are adjusted in every model, none removed; with ``restart`` once more
       from the best model's poses and lens, and the better of the two counts.
    4. Points placed without the withheld observations are projected into them. Among the models whose errors there
       cannot be told from the least, the least BIC decides, or nothing does.

    Verified matches are taken as they are in the database. Match with cameras whose focal length does not count as
    measured: pairs are then verified by fundamental matrices, which favour no model.

    Parameters
    ----------
    scene:
        Whose features are in the database. Its cameras give size, principal point and start focal length; their
        distortion and the scene's poses are not used.
    database_path:
        With features and verified matches. It is only read.
    settings:
        As declared.
    seed:
        Of every random choice.
    progress:
        Told of every model; raises to cancel.
    work_dir:
        Folder for files that are needed meanwhile and removed at the end.

    Raises
    ------
    SettingsError
        For unknown models, and where focal length or distortion is not to be refined.
    DataError, CapabilityError
        For a database of another scene, and cameras that are none of COLMAP's.
    StageError
        Where too few tracks are long enough, or no model could be fitted; the message has each model's reason.
    """
    names = _checked(settings)
    require_same_frames(database_path, scene)
    with disk_errors(work_dir, "writing"):
        work_dir.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=work_dir, prefix=".models.", suffix=".tmp") as temporary:
        copy = Path(temporary) / "withheld.db"
        copy_database(database_path, copy)
        tracks = hold_out(
            matched_tracks(copy),
            share=settings.held_out,
            min_length=settings.min_track_length,
            most=settings.max_tracks,
            seed=seed,
        )
        withhold(copy, tracks)
        mapped = {}
        for done, name in enumerate(names):
            progress(ProgressEvent("camera_models.map", done, len(names), name))
            mapped[name] = _map(scene, copy, name, settings, seed, progress, Path(temporary))
        progress(ProgressEvent("camera_models.map", len(names), len(names)))
    return _judge(scene, mapped, tracks, settings, seed, progress)


@dataclass(frozen=True, slots=True)
class _Mapped:
    result: SfmResult | None
    mapping: str
    seconds: float


def _checked(settings: CameraModelSettings) -> tuple[str, ...]:
    known = [name for name in pycolmap.CameraModelId.__members__ if name not in _NO_LENS]
    names = tuple(dict.fromkeys(part.strip().upper() for part in settings.models.split(",") if part.strip()))
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise SettingsError(
            "Setting 'models' names no camera model" if not names else f"Unknown camera model '{unknown[0]}'",
            expected="some of " + ", ".join(known),
        )
    for name in ("refine_focal", "refine_distortion"):
        if not getattr(settings.sfm, name):
            raise SettingsError(
                f"Setting 'sfm.{name}' does not serve a comparison: the lens is what is looked for",
                expected="true",
                found="false",
            )
    return names


def _map(
    scene: Scene,
    database_path: Path,
    model: str,
    settings: CameraModelSettings,
    seed: int,
    progress: Progress,
    work_dir: Path,
) -> _Mapped:
    """Run structure from motion with one model; that it finds nothing is a result, too."""
    start = time.perf_counter()
    cameras = plain_cameras(scene, model, settings.start_focal)
    write_cameras(database_path, cameras)
    try:
        found = incremental_sfm(
            with_cameras(scene, cameras),
            database_path,
            settings.sfm,
            seed=seed,
            progress=progress,
            work_dir=work_dir,
        )
    except StageError as error:
        return _Mapped(None, str(error), time.perf_counter() - start)
    placed = f"{len(found.scene.registered)} of {len(scene)} pictures placed"
    return _Mapped(found, placed, time.perf_counter() - start)


def _judge(
    scene: Scene,
    mapped: Mapping[str, _Mapped],
    tracks: MatchedTracks,
    settings: CameraModelSettings,
    seed: int,
    progress: Progress,
) -> ModelComparison:
    whole = _whole(mapped, settings)
    common = np.all(
        [[frame.cam_from_world is not None for frame in found.frames] for found in whole.values()], axis=0
    )
    seen = within(tracks, common)
    good = np.any(
        [
            explained(found, seen, max_error=settings.max_error, min_angle=settings.sfm.min_angle)
            for found in whole.values()
        ],
        axis=0,
    )
    seen = seen.of(good)
    if not seen.held_out.any():
        raise StageError(
            "No track can judge the camera models",
            expected=f"tracks that a model explains to {settings.max_error:g} px",
            found=f"none of {tracks.count}",
            todo="Raise max_error, or look at the matches",
        )
    seconds = {name: each.seconds for name, each in mapped.items()}
    made, odd = fit_all(
        whole,
        list(mapped),
        common,
        seen,
        restart=settings.restart,
        refine_principal_point=settings.sfm.refine_principal_point,
        threads=settings.sfm.threads,
        seconds=seconds,
        progress=progress,
    )
    if not made:
        raise StageError("No camera model could be fitted", found="; ".join(f"{k}: {v}" for k, v in odd.items()))
    scores, choice = choose(
        {name: each.judged.residuals for name, each in made.items()},
        {name: _free(each.judged) for name, each in made.items()},
        seen,
        max_error=settings.max_error,
        resamples=settings.resamples,
        seed=seed,
    )
    fits = tuple(
        _fit(name, own, made.get(name) or odd.get(name, own.mapping), scores.get(name), seen, seconds[name])
        for name, own in mapped.items()
    )
    withheld = int(seen.held_out.sum())
    return ModelComparison(fits, choice, int(common.sum()), seen.count, withheld, tracks.verified_as)


def _free(judged: Judged) -> int:
    cameras = [camera.to_pycolmap() for camera in used_cameras(judged.scene).values()]
    return free_intrinsics(cameras, principal_point=_principal_point_free(judged))


def _principal_point_free(judged: Judged) -> bool:
    return judged.report.principal_point == "refined"


def _fit(
    name: str, own: _Mapped, fit: JudgedFit | str, score: Score | None, seen: MatchedTracks, seconds: float
) -> ModelFit:
    """Put together what became of a model; in the place of its fit there may be the reason why it has none."""
    found = own.result
    made = None if isinstance(fit, str) else fit
    return ModelFit(
        model=name,
        failure=fit if isinstance(fit, str) else "",
        remark="" if made is None else _remark(made.judged),
        mapping=own.mapping,
        registered=0 if found is None else len(found.scene.registered),
        points=0 if found is None or found.scene.points is None else len(found.scene.points),
        started_from="" if made is None else made.started_from,
        scene=None if made is None else made.judged.scene,
        principal_point_free=made is not None and _principal_point_free(made.judged),
        score=score,
        pixels=seen.pixel[seen.held_out],
        residuals=np.zeros((0, 2)) if made is None else made.judged.residuals[seen.held_out],
        seconds=seconds,
    )


def _remark(judged: Judged) -> str:
    """Say where a fit is not at its end: its errors may be larger than those of the model."""
    return "" if judged.report.converged else f"not converged after {judged.report.steps} steps"


def _whole(mapped: Mapping[str, _Mapped], settings: CameraModelSettings) -> dict[str, Scene]:
    """Return the scenes of the models that placed nearly as many pictures as the best one."""
    scenes = {name: each.result.scene for name, each in mapped.items() if each.result is not None}
    if not scenes:
        reasons = {each.mapping for each in mapped.values()}
        raise StageError("No camera model gave a reconstruction", found=" / ".join(sorted(reasons)))
    most = max(len(found.registered) for found in scenes.values())
    return {
        name: found for name, found in scenes.items() if len(found.registered) >= settings.min_registered * most
    }
