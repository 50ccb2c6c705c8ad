"""Training of a radiance field on posed photos: NeRF (Mildenhall et al. 2020), DS-NeRF (Deng et al. 2022).

A run can be stopped, killed and resumed: with a checkpoint folder it goes on where it was, and a resumed run
equals the uninterrupted one to the bit on the same machine, build and number of threads.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from toolkit.checkpoint import load_newest, require_same
from toolkit.errors import CapabilityError
from toolkit.nerf.field import RadianceField
from toolkit.nerf.keypoints import KeypointRays, keypoint_rays
from toolkit.nerf.photos import PixelPool, load_photo, load_photos, photos_fingerprint
from toolkit.nerf.settings import NerfSettings, total_steps
from toolkit.nerf.space import Space, space_of
from toolkit.nerf.train_state import NerfRow, NerfState
from toolkit.nerf.trainer import STAGE, NerfTrainer, Observer
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene import Scene


@dataclass(frozen=True, slots=True)
class NerfResult:
    """What a training made.

    Attributes
    ----------
    field:
        The radiance field.
    steps:
        That were done, those before a resume included.
    history:
        A row a step.
    seconds:
        Wall time, over all sessions, by what it was spent on.
    train_photos, pixels, keypoints:
        How many there were: photos, pixels that count, observations of sparse points (0: depth is not learned).
    resumed_at:
        Step from which this session went on, 0 where it began.
    """

    field: RadianceField
    steps: int
    history: tuple[NerfRow, ...]
    seconds: dict[str, float]
    train_photos: int
    pixels: int
    keypoints: int
    resumed_at: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the field's numbers, ready for JSON."""
        total, known = sum(self.seconds.values()), self.field.occupancy
        return {
            "steps": self.steps,
            "parameters": sum(p.numel() for n in self.field.networks() for p in n.parameters()),
            "space": self.field.space.to_dict(),
            "filled": None if known is None else float(known.filled.float().mean()),
            "train_photos": self.train_photos,
            "pixels": self.pixels,
            "keypoints": self.keypoints,
            "seconds": total,
            "seconds_by_part": dict(self.seconds),
            "step_ms": 1e3 * total / max(1, self.steps),
            "resumed_at": self.resumed_at,
            "history": [asdict(row) for row in self.history],
        }


def train_nerf(
    scene: Scene,
    settings: NerfSettings,
    *,
    seed: int,
    device: str = "cpu",
    progress: Progress = silent,
    checkpoint_dir: Path | None = None,
    observer: Observer | None = None,
) -> NerfResult:
    """Train a radiance field on the frames of the split ``train`` that have a pose.

    Parameters
    ----------
    scene:
        With poses, cameras of any of COLMAP's models and points; with ``depth_weight`` also tracks.
    settings:
        See :class:`NerfSettings`.
    seed:
        Of every random choice.
    device:
        ``"cpu"`` or ``"cuda"``.
    progress:
        Told of every step, with ``loss``, ``step_ms`` and now and then ``psnr_test``. Where it raises
        :class:`Cancelled`, a last checkpoint is written.
    checkpoint_dir:
        Where checkpoints are written to, and where an interrupted run is picked up from; None: no checkpoints.
    observer:
        Called after each step with the training as it is; what it returns is told with the step's values. The
        result is the same with and without.

    Raises
    ------
    StageError
        For fewer than two training frames with poses, without points that say where the scene is, and without
        tracks where depth is to be learned.
    DataError
        For photos, cameras, weights or checkpoints that cannot be used.
    RunError
        Where the folder's checkpoint belongs to another scene, seed or other settings.
    NumericalError
        For NaN or infinity in loss or parameters.
    CapabilityError
        Where there is no such device, or fine samples are wanted of a hash grid.
    """
    _check(settings, device)
    space = space_of(scene, margin=settings.margin, contracted=settings.space == "contracted")
    keypoints = keypoint_rays(scene, settings.depth_sigma) if settings.depth_weight > 0 else None
    photos = load_photos(scene, scene.of_split("train"), settings.max_side, progress=progress)
    tests = scene.of_split("test")
    test_photo = load_photo(scene, tests[0], settings.max_side) if tests else None
    pixels = PixelPool(photos)
    settings = settings.replace(
        {"steps": total_steps(settings, len(photos), len(pixels)), "steps_count": "in-all"}
    ).frozen()
    told = {
        **photos_fingerprint(photos if test_photo is None else (*photos, test_photo)),
        "space": space.to_dict(),
        "keypoints": "" if keypoints is None else keypoints.fingerprint(),
    }
    made_with = {"settings": settings.to_dict(), "seed": seed, "scene": told}
    saved, damaged = (None, ()) if checkpoint_dir is None else load_newest(checkpoint_dir)
    if saved is None or checkpoint_dir is None:
        state = _start(settings, space, keypoints, seed, device)
    else:
        require_same(saved.state["made_with"], made_with, checkpoint_dir)
        state = NerfState.resume(saved, settings, device, checkpoint_dir)
    resumed_at = state.step
    message = " ".join([*damaged, f"resumed at step {resumed_at}" if resumed_at else ""]).strip()
    progress(ProgressEvent(STAGE, resumed_at, settings.steps, message))
    trainer = NerfTrainer(state, settings, pixels, keypoints, test_photo, observer)
    trainer.run(progress, checkpoint_dir, made_with)
    return NerfResult(
        field=state.field,
        steps=state.step,
        history=tuple(state.history),
        seconds=dict(state.seconds),
        train_photos=len(photos),
        pixels=len(pixels),
        keypoints=0 if keypoints is None else len(keypoints),
        resumed_at=resumed_at,
    )


def _start(
    settings: NerfSettings, space: Space, keypoints: KeypointRays | None, seed: int, device: str
) -> NerfState:
    kept = None
    if keypoints is not None:
        kept = keypoints.origins + keypoints.distances[:, None] * keypoints.directions
    return NerfState.start(settings, space, kept, seed, device)


def _check(settings: NerfSettings, device: str) -> None:
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise CapabilityError("There is no CUDA device", expected="device cpu", found=f"device {device}")
    if settings.field == "hash" and settings.fine_samples:
        raise CapabilityError(
            "A hash grid has no coarse network",
            expected="fine_samples 0, or field frequency",
            found=f"fine_samples {settings.fine_samples}",
            todo="An occupancy grid tells a hash grid where to look",
        )
