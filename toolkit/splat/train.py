"""Training of Gaussian splats on posed photos (Kerbl et al. 2023), on one photo a step.

A run can be stopped, killed and resumed: with a checkpoint folder it goes on where it was, and a resumed run
equals the uninterrupted one to the bit on the same machine, build and number of threads.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from toolkit.errors import Cancelled, CapabilityError, NumericalError
from toolkit.metrics.image import psnr
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene import Scene
from toolkit.splat.checkpoint import load_newest, require_same, save_checkpoint
from toolkit.splat.density import DensityChange
from toolkit.splat.evaluate import draw, fixed_background, raster_settings
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.images import Photo, load_photo, load_photos
from toolkit.splat.initialise import scene_extent
from toolkit.splat.loss import photometric_loss
from toolkit.splat.rasterize import rasterize
from toolkit.splat.train_settings import Schedule, TrainSettings
from toolkit.splat.train_state import HistoryRow, TrainState, scene_fingerprint

STAGE = "splat.train"
MAX_PSNR = 100.0


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
        Wall time of the steps, over all sessions, by what it was spent on: photo, forward, loss, backward,
        optimiser, density, evaluation, checkpoint.
    extent:
        Of the scene, the unit of sizes and learning rates.
    changes:
        How many Gaussians were cloned, split and pruned.
    initial_gaussians:
        Before the first step.
    train_photos:
        How many there were.
    resumed_at:
        Step from which this session went on, 0 where it began.
    notes:
        What a person should know, for example that a damaged checkpoint was passed over.
    """

    gaussians: Gaussians
    steps: int
    history: tuple[HistoryRow, ...]
    seconds: dict[str, float]
    extent: float
    changes: DensityChange
    initial_gaussians: int
    train_photos: int
    resumed_at: int = 0
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the Gaussians' values, ready for JSON."""
        total = sum(self.seconds.values())
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
            "step_ms": 1e3 * total / max(1, self.steps),
            "resumed_at": self.resumed_at,
            "notes": list(self.notes),
            "history": [asdict(row) for row in self.history],
        }


def train_splats(
    scene: Scene,
    settings: TrainSettings,
    *,
    seed: int,
    device: str = "cpu",
    progress: Progress = silent,
    checkpoint_dir: Path | None = None,
) -> TrainResult:
    """Train Gaussians on the frames of the split ``train`` that have a pose.

    Parameters
    ----------
    scene:
        With poses, pinhole cameras and points.
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

    Raises
    ------
    StageError
        Without training frames with poses, without points, or where all Gaussians vanish.
    DataError
        For photos or cameras that cannot be used, and where all checkpoints are damaged.
    RunError
        Where the folder's checkpoints belong to another scene, seed or other settings.
    NumericalError
        For NaN or infinity in loss, gradients or parameters.
    CapabilityError
        Where backend and device do not fit, or the backend is not there.
    """
    settings = settings.frozen()
    _check_device(settings, device)
    extent = scene_extent(scene)
    photos = load_photos(scene, scene.of_split("train"), settings.max_side, device=device, progress=progress)
    test_frames = scene.of_split("test")
    test_photo = load_photo(scene, test_frames[0], settings.max_side, device=device) if test_frames else None
    made_with = {
        "settings": settings.to_dict(),
        "seed": seed,
        "scene": scene_fingerprint(scene, photos if test_photo is None else (*photos, test_photo)),
    }
    state, notes = None, _notes(scene, settings)
    if checkpoint_dir is not None:
        checkpoint, damaged = load_newest(checkpoint_dir)
        notes += damaged
        if checkpoint is not None:
            require_same(checkpoint.state["made_with"], made_with, checkpoint_dir)
            state = TrainState.resume(checkpoint, settings, extent, device)
    if state is None:
        state = TrainState.start(scene, len(photos), settings, extent, seed, device)
    resumed_at = state.step
    message = " ".join([*notes, f"resumed at step {resumed_at}" if resumed_at else ""]).strip()
    progress(ProgressEvent(STAGE, resumed_at, settings.steps, message))

    trainer = _Trainer(state, settings, extent, photos, test_photo)
    trainer.run(progress, checkpoint_dir, made_with)
    return TrainResult(
        gaussians=state.optimiser.gaussians.detach(),
        steps=state.step,
        history=tuple(state.history),
        seconds=dict(state.seconds),
        extent=extent,
        changes=state.changes,
        initial_gaussians=state.initial_gaussians,
        train_photos=len(photos),
        resumed_at=resumed_at,
        notes=notes,
    )


class _Trainer:
    """Moves a state step by step to the end of its schedule."""

    def __init__(
        self,
        state: TrainState,
        settings: TrainSettings,
        extent: float,
        photos: tuple[Photo, ...],
        test_photo: Photo | None,
    ) -> None:
        self.state, self.settings, self.extent = state, settings, extent
        self.photos, self.test_photo = photos, test_photo
        self.schedule = Schedule.of(settings)

    def run(self, progress: Progress, folder: Path | None, made_with: dict[str, Any]) -> None:
        """Do all steps that are left, with progress and checkpoints."""
        state, settings = self.state, self.settings
        saved = state.step
        while state.step < settings.steps:
            start = time.perf_counter()
            row = self.step()
            due = state.step % settings.checkpoint_every == 0 or state.step == settings.steps
            if folder is not None and due:
                with self._clock("checkpoint"):
                    save_checkpoint(folder, state.checkpoint(made_with))
                saved = state.step
            values = {
                "loss": row.loss,
                "gaussians": float(row.gaussians),
                "step_ms": 1e3 * (time.perf_counter() - start),
            }
            if row.psnr_test is not None:
                values["psnr_test"] = row.psnr_test
            try:
                progress(ProgressEvent(STAGE, state.step, settings.steps, values=values))
            except Cancelled:
                if folder is not None and saved != state.step:
                    save_checkpoint(folder, state.checkpoint(made_with))
                raise

    def step(self) -> HistoryRow:
        """Do one step and return its row of the history."""
        state, step = self.state, self.state.step + 1
        state.optimiser.raise_sh_degree(self.schedule.sh_degree_at(step))
        loss = self._learn(self.photos[state.next_photo()], step)
        with self._clock("density"):
            self._control_density(step)
        psnr_test = None
        if self.test_photo is not None and (step % self.settings.eval_every == 0 or step == self.settings.steps):
            with self._clock("evaluation"):
                psnr_test = self._psnr_test(self.test_photo)
        row = HistoryRow(step, loss, len(state.optimiser.gaussians), psnr_test)
        state.history.append(row)
        state.step = step
        return row

    def _learn(self, photo: Photo, step: int) -> float:
        """Render one photo, compare, and move the parameters. Returns the loss."""
        state, settings = self.state, self.settings
        gaussians = state.optimiser.gaussians
        device = str(gaussians.means.device)
        with self._clock("photo"):
            target, weights = photo.colours(device), photo.weights(device)
        with self._clock("forward"):
            output = rasterize(
                gaussians, photo.views, raster_settings(settings), background=self._background(gaussians.means)
            )
            output.means2d.retain_grad()
        with self._clock("loss"):
            loss = photometric_loss(output.colour[0], target, lambda_dssim=settings.lambda_dssim, weights=weights)
            value = float(loss.detach())
        _require_finite(value, photo, step)
        with self._clock("backward"):
            loss.backward()
        if self.schedule.observes(step) and output.means2d.grad is not None:
            with self._clock("density"):
                camera = photo.camera
                state.density.observe(output.means2d.grad, output.radii, camera.width, camera.height)
        with self._clock("optimiser"):
            state.optimiser.step(settings, self.extent, step)
        return value

    def _control_density(self, step: int) -> None:
        state, schedule = self.state, self.schedule
        if schedule.densifies_after(step):
            state.changes += state.density.refine(
                state.optimiser, state.generator, prune_large=schedule.prunes_large_after(step)
            )
        if schedule.resets_after(step):
            state.density.set_opacities_back(state.optimiser)

    def _background(self, like: Tensor) -> Tensor:
        if self.settings.background == "random":
            return torch.rand(3, generator=self.state.generator).to(like)
        return fixed_background(self.settings, like)

    def _psnr_test(self, photo: Photo) -> float:
        gaussians = self.state.optimiser.gaussians
        device = str(gaussians.means.device)
        render = draw(gaussians, photo, self.settings).colour[0].clamp(0, 1)
        weights = photo.weights(device)
        decibels = psnr(render, photo.colours(device), None if weights is None else weights > 0)
        # An identical picture has infinitely many, which a checkpoint's JSON cannot hold.
        return min(decibels, MAX_PSNR)

    @contextmanager
    def _clock(self, part: str) -> Iterator[None]:
        """Add the time of the block to a part of the run's seconds."""
        start = time.perf_counter()
        yield
        self.state.seconds[part] = self.state.seconds.get(part, 0.0) + time.perf_counter() - start


def _check_device(settings: TrainSettings, device: str) -> None:
    if (settings.backend == "cuda") != device.startswith("cuda"):
        raise CapabilityError(
            f"Backend '{settings.backend}' does not work on device '{device}'",
            expected="backend 'cuda' with device 'cuda', another one with device 'cpu'",
        )


def _require_finite(loss: float, photo: Photo, step: int) -> None:
    if not (float("-inf") < loss < float("inf")):
        raise NumericalError(
            f"Training met a loss that is not finite at step {step}, photo '{photo.name}'",
            expected="a finite number",
            found=str(loss),
            todo="Lower the learning rates; the last checkpoint before this step is kept",
        )


def _notes(scene: Scene, settings: TrainSettings) -> tuple[str, ...]:
    """Return what of a scene is left out."""
    notes = []
    train = sum(frame.split == "train" for frame in scene.frames)
    posed = len(scene.of_split("train"))
    if posed < train:
        notes.append(f"{train - posed} of {train} training frames have no pose and are left out.")
    points = 0 if scene.points is None else len(scene.points)
    if points > settings.max_gaussians:
        notes.append(f"{settings.max_gaussians} of {points} points are used, by chance: max_gaussians.")
    return tuple(notes)
