"""Training of Gaussian splats on posed photos (Kerbl et al. 2023), on one photo a step.

A run can be stopped, killed and resumed: with a checkpoint folder it goes on where it was, and a resumed run
equals the uninterrupted one to the bit on the same machine, build and number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from torch import Tensor

from toolkit.checkpoint import load_newest, require_same
from toolkit.errors import CapabilityError
from toolkit.geometry.rigid import RigidTransform
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene import Scene
from toolkit.splat.density import DensityChange
from toolkit.splat.depth_loss import DepthPredictions, PredictedDepth, prediction_notes
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.images import Photo, load_photo, load_photos
from toolkit.splat.initialise import scene_extent
from toolkit.splat.memory import free_memory, most_gaussians
from toolkit.splat.pose_refine import PoseTargets, pose_change
from toolkit.splat.train_settings import Schedule, TrainSettings
from toolkit.splat.train_state import HistoryRow, TrainState, scene_fingerprint
from toolkit.splat.trainer import STAGE, Observer, Trainer
from toolkit.splat.warm_up import warm_up

#: Stage of compiling the kernels in progress events.
COMPILE_STAGE: Final = "splat.compile"


@dataclass(frozen=True, slots=True)
class TrainResult:
    """What a training made.

    Attributes
    ----------
    gaussians:
        Outside every gradient graph.
    steps:
        That were done, those before a resume included.
    history:
        A row a step.
    seconds:
        Wall time, over all sessions, by what it was spent on: compile (of the kernels, before the first step),
        photo, forward, loss, backward, optimiser, density, evaluation, checkpoint, observer.
    extent:
        Of the scene, the unit of sizes and learning rates.
    changes:
        How many Gaussians were cloned, split, pruned and relocated.
    initial_gaussians:
        Before the first step.
    train_photos:
        How many there were.
    resumed_at:
        Step from which this session went on, 0 where it began.
    notes:
        What a person should know, for example that a damaged checkpoint was passed over.
    exposures:
        With exposure: the colour change of each training photo by its name, three rows of four numbers.
    poses:
        With refine_poses: the refined pose of each training photo by its name. The Gaussians belong to these; the
        world as a whole may have moved with them (:mod:`toolkit.splat.align_test`).
    pose_changes:
        By how much each of them moved, in scene units, and turned, in degrees.
    origins:
        (N, 3) float32, where each Gaussian began; one that was cloned, split or relocated began where what it is a
        copy of did.
    """

    gaussians: Gaussians
    origins: Tensor
    steps: int
    history: tuple[HistoryRow, ...]
    seconds: dict[str, float]
    extent: float
    changes: DensityChange
    initial_gaussians: int
    train_photos: int
    resumed_at: int = 0
    notes: tuple[str, ...] = ()
    exposures: dict[str, list[list[float]]] = field(default_factory=dict)
    poses: dict[str, RigidTransform] = field(default_factory=dict)
    pose_changes: dict[str, tuple[float, float]] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return everything but values of single Gaussians, ready for JSON."""
        total = sum(self.seconds.values())
        stepping = total - self.seconds.get("compile", 0.0)
        return {
            "steps": self.steps,
            "gaussians": len(self.gaussians),
            "initial_gaussians": self.initial_gaussians,
            "sh_degree": self.gaussians.sh_degree,
            "train_photos": self.train_photos,
            "extent": self.extent,
            "changes": asdict(self.changes),
            "seconds": total,
            "seconds_by_part": dict(self.seconds),
            "step_ms": 1e3 * stepping / max(1, self.steps),
            "resumed_at": self.resumed_at,
            "notes": list(self.notes),
            **({"exposures": self.exposures} if self.exposures else {}),
            **({"poses": self._poses_to_dict()} if self.poses else {}),
            "history": [asdict(row) for row in self.history],
        }

    def _poses_to_dict(self) -> dict[str, Any]:
        return {
            name: {
                "cam_from_world": pose.matrix.tolist(),
                "moved": self.pose_changes[name][0],
                "turned_deg": self.pose_changes[name][1],
            }
            for name, pose in self.poses.items()
        }


def train_splats(
    scene: Scene,
    settings: TrainSettings,
    *,
    seed: int,
    device: str = "cpu",
    progress: Progress = silent,
    checkpoint_dir: Path | None = None,
    observer: Observer | None = None,
    predicted_depth: PredictedDepth | None = None,
) -> TrainResult:
    """Train Gaussians on the frames of the split ``train`` that have a pose.

    Parameters
    ----------
    scene:
        With poses, pinhole or affine cameras, and points.
    settings:
        See :class:`TrainSettings`.
    seed:
        Of every random choice.
    device:
        ``"cuda"`` with the cuda backend, else ``"cpu"``.
    progress:
        Told of every step, with ``loss``, ``gaussians``, ``step_ms`` and now and then ``psnr_test``. Where it
        raises :class:`Cancelled`, a last checkpoint is written.
    checkpoint_dir:
        Where checkpoints are written to, and where an interrupted run is picked up from; None: no checkpoints.
    observer:
        Called after each step with the training as it is; what it returns is told with the step's values. The
        result is the same with and without.
    predicted_depth:
        What drawn depth is held to, and how much; None: nothing. Photos without a prediction are not held to any.

    Raises
    ------
    StageError
        Without training frames with poses, without points, where all Gaussians vanish, where the memory does not
        hold the first ones, or with ``predicted_depth`` for no training photo.
    DataError
        For photos, cameras or predictions that cannot be used, and where all checkpoints are damaged.
    RunError
        Where the folder's checkpoints belong to another scene, seed, other settings or predictions.
    NumericalError
        For NaN or infinity in loss, gradients or parameters.
    CapabilityError
        Where backend and device do not fit, or the backend is not there.
    """
    settings, wanted = settings.frozen(), settings.max_gaussians
    _check_device(settings, device)
    extent = scene_extent(scene)
    photos = load_photos(scene, scene.of_split("train"), settings.max_side, device=device, progress=progress)
    test_frames = scene.of_split("test")
    test_photo = load_photo(scene, test_frames[0], settings.max_side, device=device) if test_frames else None
    predictions = _predictions(predicted_depth, photos)
    made_with = {
        "settings": settings.to_dict(),
        "seed": seed,
        "scene": scene_fingerprint(
            scene,
            photos if test_photo is None else (*photos, test_photo),
            with_priors=settings.refine_poses and settings.pose_prior == "sensor",
        ),
    }
    if predictions is not None:
        made_with["depth loss"] = predictions.of.settings.to_dict()
        made_with["depth predictions"] = predictions.fingerprint()
    checkpoint, damaged = (None, ()) if checkpoint_dir is None else load_newest(checkpoint_dir)
    if checkpoint is not None and checkpoint_dir is not None:
        require_same(checkpoint.state["made_with"], made_with, checkpoint_dir)
        # The cap with which it began: the memory that is free now must not change the result.
        settings = _capped(settings, checkpoint.state["most_gaussians"])
        state = TrainState.resume(checkpoint, settings, extent, device)
    else:
        points = 0 if scene.points is None else len(scene.points)
        free = None if device.startswith("cuda") else free_memory()
        settings = _capped(settings, most_gaussians(settings, points, free))
        state = TrainState.start(scene, len(photos), settings, extent, seed, device)
    unused = prediction_notes(predictions, len(photos))
    notes = (*_notes(scene, settings, wanted), *unused, *damaged)
    resumed_at = state.step
    if state.step < settings.steps:
        kinds = {photo.views.affine for photo in photos}
        progress(ProgressEvent(COMPILE_STAGE, 0, 1, "once a machine, up to a minute"))
        compiling = sum(warm_up(settings, affine=affine) for affine in kinds)
        progress(ProgressEvent(COMPILE_STAGE, 1, 1))
        state.seconds["compile"] = state.seconds.get("compile", 0.0) + compiling
    message = " ".join([*notes, f"resumed at step {resumed_at}" if resumed_at else ""]).strip()
    progress(ProgressEvent(STAGE, resumed_at, settings.steps, message))

    targets = _pose_targets(scene, settings, extent)
    trainer = Trainer(state, settings, extent, photos, test_photo, targets, observer, predictions)
    trainer.run(progress, checkpoint_dir, made_with)
    poses = trainer.poses()
    return TrainResult(
        gaussians=state.optimiser.gaussians.detach(),
        origins=state.optimiser.origins,
        steps=state.step,
        history=tuple(state.history),
        seconds=dict(state.seconds),
        extent=extent,
        changes=state.changes,
        initial_gaussians=state.initial_gaussians,
        train_photos=len(photos),
        resumed_at=resumed_at,
        notes=notes,
        exposures=_exposures(state, photos),
        poses=poses,
        pose_changes={
            frame.name: pose_change(frame.cam_from_world, poses[frame.name])
            for frame in scene.of_split("train")
            if frame.cam_from_world is not None and frame.name in poses
        },
    )


def _predictions(predicted: PredictedDepth | None, photos: Sequence[Photo]) -> DepthPredictions | None:
    """Return the predictions that the training is held to, None where it is held to none.

    A shape that does not fit is told before the first step.
    """
    if predicted is None:
        return None
    known = DepthPredictions(predicted, [photo.name for photo in photos])
    for photo in photos:
        known.of_photo(photo)
    return known


def _check_device(settings: TrainSettings, device: str) -> None:
    if (settings.backend == "cuda") != device.startswith("cuda"):
        raise CapabilityError(
            f"Backend '{settings.backend}' does not work on device '{device}'",
            expected="backend 'cuda' with device 'cuda', another one with device 'cpu'",
        )
    if settings.kind == "2d" and settings.absolute_gradients:
        raise CapabilityError("Absolute gradients are there for ellipsoids only", expected="kind '3d'")
    if settings.kind == "2d" and settings.density == "mcmc":
        raise CapabilityError(
            "Density 'mcmc' moves ellipsoids, not disks", expected="density 'adaptive' with kind '2d'"
        )


def _capped(settings: TrainSettings, most: int) -> TrainSettings:
    return settings.replace({"max_gaussians": most}).frozen()


def _exposures(state: TrainState, photos: Iterable[Photo]) -> dict[str, list[list[float]]]:
    if state.exposure is None:
        return {}
    return {photo.name: rows.tolist() for photo, rows in zip(photos, state.exposure.affine, strict=True)}


def _pose_targets(scene: Scene, settings: TrainSettings, extent: float) -> PoseTargets | None:
    """Return where poses are pulled to, None where they are not."""
    if not settings.refine_poses or settings.pose_prior_weight == 0:
        return None
    make = PoseTargets.sensors if settings.pose_prior == "sensor" else PoseTargets.start_poses
    turn = math.radians(settings.pose_rotation_sigma)
    return make(scene.of_split("train"), settings.pose_position_sigma * extent, turn)


def _notes(scene: Scene, settings: TrainSettings, wanted: int) -> tuple[str, ...]:
    """Return what of a scene is left out, and whether fewer Gaussians are allowed than were wanted."""
    notes = []
    train = sum(frame.split == "train" for frame in scene.frames)
    posed = len(scene.of_split("train"))
    if posed < train:
        notes.append(f"{train - posed} of {train} training frames have no pose and are left out.")
    points = 0 if scene.points is None else len(scene.points)
    most = Schedule.of(settings).most_gaussians_at(1)
    if points > most:
        cap = "max_gaussians" if most == settings.max_gaussians else "early_max_gaussians"
        notes.append(f"{most} of {points} points are used, by chance: {cap}.")
    if settings.max_gaussians < wanted:
        notes.append(f"At most {settings.max_gaussians} Gaussians instead of {wanted}: the memory holds no more.")
    return tuple(notes)
