"""Incremental structure from motion: poses, points and calibration from matched pictures, by COLMAP's mapper."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Collection
from contextlib import closing
from pathlib import Path

import pycolmap

from toolkit.errors import Cancelled, StageError
from toolkit.files import disk_errors
from toolkit.matching.colmap_job import run_colmap
from toolkit.matching.database import copy_database, require_same_frames
from toolkit.poses.adjust import POINT_SIGMA, AdjustmentReport, adjust, position_priors
from toolkit.poses.sfm_failure import check_matches, no_initial_pair
from toolkit.poses.sfm_result import SfmResult, sfm_result
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene import Scene, scene_from_pycolmap
from toolkit.settings import Boolean, Integer, Number, Settings


class SfmSettings(Settings):
    """Incremental structure from motion."""

    min_matches = Integer(15, bounds=(6, 1000), unit="matches", doc="Pairs with fewer inliers are not used.")
    init_min_inliers = Integer(
        100, bounds=(15, 10000), unit="matches", doc="Least inliers of the pair that is placed first."
    )
    init_min_angle = Number(
        16.0,
        bounds=(0.1, 90.0),
        unit="degrees",
        doc="Least angle between the rays of the pair that is placed first.",
    )
    min_inliers = Integer(
        30, bounds=(6, 10000), unit="points", doc="Least points by which a further picture is placed."
    )
    max_error = Number(4.0, bounds=(0.1, 100.0), unit="px", doc="Observations with a larger error are removed.")
    min_angle = Number(
        1.5, bounds=(0.0, 45.0), unit="degrees", doc="Points whose rays meet under a smaller angle are removed."
    )
    multiple_models = Boolean(
        True, doc="Start again with the pictures that are left over; the largest model is the result."
    )
    least_focal = Number(
        0.1,
        bounds=(0.001, 1.0),
        unit="longer sides",
        doc="A model whose focal length falls below this is thrown away, and another one begun. A camera model "
        "that cannot bend like the lens may go there with frames a small turn apart.",
    )
    refine_focal = Boolean(True, doc="Find the focal length; no: keep that of the scene's cameras.")
    refine_distortion = Boolean(True, doc="Find the distortion; no: keep that of the scene's cameras.")
    refine_principal_point = Boolean(
        True, doc="Find the principal point in the last adjustment, where the pictures determine it."
    )
    principal_point_sigma = Number(
        POINT_SIGMA,
        bounds=(0.0, 1.0),
        unit="longer sides",
        doc="Largest standard deviation of a principal point that counts as determined. Low for lenses whose axis "
        "meets the picture near its middle; higher where it does not, as in borescopes.",
    )
    global_growth = Number(
        1.1,
        bounds=(1.01, 10.0),
        doc="Everything is adjusted again when pictures or points have grown by this factor; larger is faster.",
    )
    tolerance = Number(
        1e-6, bounds=(0.0, 0.01), doc="While pictures are added, an adjustment ends when its cost changes by less."
    )
    use_positions = Boolean(
        False,
        doc="Take the frames' GPS positions for priors while pictures are added and adjusted: the result is in "
        "metres, east-north-up.",
    )
    threads = Integer(0, bounds=(0, 256), doc="Threads of the solver; 0: as many as there are cores.")


def incremental_sfm(
    scene: Scene,
    database_path: Path,
    settings: SfmSettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
    work_dir: Path,
    only: Collection[str] | None = None,
) -> SfmResult:
    """Place the pictures of a scene one after the other and adjust everything at the end.

    COLMAP's incremental mapper (Schönberger and Frahm 2016, "Structure-from-motion revisited"), and
    :func:`toolkit.poses.adjust.adjust` on the largest model that it finds. The world frame and its scale are
    arbitrary, unless ``use_positions`` makes the positions of the frames' priors part of every adjustment (COLMAP's
    pose-prior mapping, with a robust loss): then it is that of the scene. Poses that the scene has are not used.

    Parameters
    ----------
    scene:
        Whose features are in the database.
    database_path:
        With features and verified matches. It is only read.
    settings:
        As declared.
    seed:
        Of every random choice. On the same machine poses repeat to the bit with one thread, and to rounding
        (1e-12 of the scene's width was seen) with several.
    progress:
        Told how many pictures are placed; raises to cancel.
    work_dir:
        Folder for files that are needed meanwhile and removed at the end.
    only:
        Names of the frames that are placed; the others have no part in poses, points and cameras, and stay without
        pose. None: all.

    Raises
    ------
    DataError
        For a database that is missing, damaged or of another scene, and for names that are none of its frames.
    StageError
        For fewer than two frames to place; where no model was found, saying whether features, overlap or a sound
        first pair is missing; where positions are to be used and fewer than 3 frames have one, or the scene has no
        georeference.
    """
    wanted = _wanted(scene, only)
    if settings.use_positions:
        _check_positions(scene, wanted)
    require_same_frames(database_path, scene)
    check_matches(database_path, settings.min_matches)
    start = time.perf_counter()
    with disk_errors(work_dir, "writing"):
        work_dir.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=work_dir, prefix=".sfm.", suffix=".tmp") as temporary:
        # COLMAP changes a database by opening it; this one may belong to another stage.
        copy = Path(temporary) / "matches.db"
        copy_database(database_path, copy)
        found = _map(scene, copy, settings, seed, progress, () if only is None else wanted)
        with closing(pycolmap.Database.open(copy)) as database:
            before = {camera.camera_id: camera for camera in database.read_all_cameras()}
    if not found:
        raise no_initial_pair(database_path, settings.init_min_inliers, settings.init_min_angle)
    found.sort(key=lambda model: (model.num_reg_images(), model.num_points3D()), reverse=True)
    mapped = time.perf_counter()
    best = found[0]
    report = adjust_model(best, scene, settings, progress)
    found_scene = scene_from_pycolmap(best, scene.image_dir, like=scene.without_poses())
    return sfm_result(
        best,
        found_scene if settings.use_positions else _in_its_own_world(found_scene),
        models=tuple(model.num_reg_images() for model in found),
        before=before,
        adjustment=report,
        seconds={"mapping": mapped - start, "adjustment": time.perf_counter() - mapped},
        wanted=wanted,
    )


def _wanted(scene: Scene, only: Collection[str] | None) -> tuple[str, ...]:
    """Return the names of the frames to place, in the scene's order."""
    if only is None:
        return tuple(frame.name for frame in scene.frames)
    for name in only:
        scene.frame(name)
    if len(set(only)) < 2:
        raise StageError(
            "Structure from motion needs pictures", expected="at least 2 to place", found=str(len(only))
        )
    return tuple(frame.name for frame in scene.frames if frame.name in only)


def _check_positions(scene: Scene, wanted: Collection[str]) -> None:
    priors = [scene.frame(name).prior for name in wanted]
    placed = sum(prior is not None and prior.position is not None for prior in priors)
    if scene.georeference is None or placed < 3:
        raise StageError(
            "There are too few positions to use as priors",
            expected="at least 3 frames with a GPS position",
            found=f"{placed} of {len(wanted)}",
            todo="Set use_positions to no",
        )


def _in_its_own_world(scene: Scene) -> Scene:
    """Drop what speaks of another world frame: pictures alone give neither place, heading nor scale."""
    frames = tuple(dataclasses.replace(frame, prior=None) for frame in scene.frames)
    return scene.replace(frames=frames, georeference=None)


def _map(
    scene: Scene,
    database_path: Path,
    settings: SfmSettings,
    seed: int,
    progress: Progress,
    only: tuple[str, ...],
) -> list[pycolmap.Reconstruction]:
    """Return all models that COLMAP's mapper finds, of ``only`` these frames where there are any.

    It writes them beside the database, too.
    """
    total = len(only) or len(scene)
    placed = {"model": 0, "pictures": 0}

    def started() -> None:
        placed.update(model=placed["model"] + 1, pictures=2)

    def added() -> None:
        placed["pictures"] += 1

    def event() -> ProgressEvent:
        message = f"model {placed['model']}" if placed["model"] > 1 else ""
        return ProgressEvent("sfm", min(placed["pictures"], total), total, message)

    def call(token: pycolmap.CancellationToken) -> dict[int, pycolmap.Reconstruction]:
        pycolmap.set_random_seed(seed)
        return pycolmap.incremental_mapping(
            database_path,
            scene.image_dir,
            database_path.parent,
            options=_options(settings, seed, only),
            initial_image_pair_callback=started,
            next_image_callback=added,
            cancellation_token=token,
        )

    models = run_colmap(call, event, progress, database_path)
    return [model for model in models.values() if model.num_reg_images() >= 2]


def _options(settings: SfmSettings, seed: int, only: tuple[str, ...]) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions(
        image_names=list(only),
        min_num_matches=settings.min_matches,
        multiple_models=settings.multiple_models,
        # COLMAP would drop every model after the first with fewer than ten pictures, were it the largest.
        min_model_size=2,
        num_threads=settings.threads or -1,
        random_seed=seed,
        ba_refine_focal_length=settings.refine_focal,
        ba_refine_extra_params=settings.refine_distortion,
        # With few pictures it is not determined, and a wrong one spoils what follows: it waits for the end.
        ba_refine_principal_point=False,
        ba_global_frames_ratio=settings.global_growth,
        ba_global_points_ratio=settings.global_growth,
        ba_local_function_tolerance=settings.tolerance,
        ba_global_function_tolerance=settings.tolerance,
        use_prior_position=settings.use_positions,
        use_robust_loss_on_prior_position=settings.use_positions,
    )
    for part in (options, options.mapper, options.triangulation):
        part.min_focal_length_ratio = settings.least_focal
    options.mapper.random_seed = seed
    options.mapper.init_min_num_inliers = settings.init_min_inliers
    options.mapper.init_min_tri_angle = settings.init_min_angle
    options.mapper.abs_pose_min_num_inliers = settings.min_inliers
    options.mapper.abs_pose_refine_focal_length = settings.refine_focal
    options.mapper.abs_pose_refine_extra_params = settings.refine_distortion
    options.mapper.filter_max_reproj_error = settings.max_error
    options.mapper.filter_min_tri_angle = settings.min_angle
    options.triangulation.random_seed = seed
    options.triangulation.min_angle = settings.min_angle
    return options


def adjust_model(
    model: pycolmap.Reconstruction, scene: Scene, settings: SfmSettings, progress: Progress
) -> AdjustmentReport:
    """Adjust a model of the scene's frames in place by :func:`toolkit.poses.adjust.adjust`, as the settings say."""
    priors = position_priors(scene, model) if settings.use_positions else ()

    def call(token: pycolmap.CancellationToken) -> AdjustmentReport:
        def check_cancelled() -> None:
            if token.is_cancelled:
                raise Cancelled("Cancelled in the last adjustment")

        return adjust(
            model,
            refine_focal=settings.refine_focal,
            refine_distortion=settings.refine_distortion,
            refine_principal_point=settings.refine_principal_point,
            point_sigma=settings.principal_point_sigma,
            max_error=settings.max_error,
            min_angle=settings.min_angle,
            threads=settings.threads,
            check_cancelled=check_cancelled,
            priors=priors,
        )

    event = ProgressEvent("sfm", model.num_reg_images(), len(scene), "last adjustment")
    return run_colmap(call, lambda: event, progress)
