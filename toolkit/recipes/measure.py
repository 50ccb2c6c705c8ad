"""Measures that every recipe reports in the same way: test pictures, poses."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from toolkit.errors import StageError
from toolkit.files import atomic_path
from toolkit.metrics.image import psnr, ssim
from toolkit.metrics.lpips import Lpips
from toolkit.metrics.trajectory import Alignment, relative_errors, trajectory_errors
from toolkit.progress import Progress, track
from toolkit.recipes.base import TestView
from toolkit.scene import Scene

if TYPE_CHECKING:
    from toolkit.splat.evaluate import RenderedView


def measure_test_renders(
    renders: Iterable[RenderedView],
    count: int,
    artifacts: Path,
    lpips: Lpips,
    progress: Progress,
    *,
    name: str = "test",
) -> tuple[tuple[TestView, ...], dict[str, float | None], dict[str, Any]]:
    """Write each test photo beside its render and measure PSNR, SSIM and, where there are weights, LPIPS.

    Pixels that a photo's mask leaves out do not count for PSNR and SSIM; LPIPS knows no masks and takes all.

    Parameters
    ----------
    renders:
        Photos and renders of test frames only.
    count:
        How many there are.
    artifacts:
        Folder below which ``<name>/`` is filled with PNG pictures.
    lpips:
        Made before the training, so that a damaged weights file is told before hours are spent.
    name:
        Of the folder and in front of the measures.

    Returns
    -------
    views, metrics, report:
        One entry a test frame; their means as ``<name>.<measure>``; a remark where LPIPS is not available.
    """
    views: list[TestView] = []
    for number, render in enumerate(track(renders, "measure", progress, count)):
        photo, drawn = f"{name}/{number:04d}_photo.png", f"{name}/{number:04d}_render.png"
        counts = None if render.weights is None else render.weights > 0
        _write_picture(render.photo, artifacts / photo)
        _write_picture(render.render, artifacts / drawn)
        views.append(
            TestView(
                render.name,
                photo,
                drawn,
                psnr=psnr(render.photo, render.render, counts),
                ssim=ssim(render.photo, render.render, counts),
                lpips=lpips(render.photo, render.render),
            )
        )
    if not views:
        return (), {f"{name}.psnr": None, f"{name}.ssim": None}, {"reason": "no test frame was registered"}
    metrics: dict[str, float | None] = {
        f"{name}.views": float(len(views)),
        f"{name}.psnr": float(np.mean([view.psnr for view in views])),
        f"{name}.ssim": float(np.mean([view.ssim for view in views])),
    }
    distances = [view.lpips for view in views if view.lpips is not None]
    metrics[f"{name}.{lpips.name}"] = float(np.mean(distances)) if distances else None
    return tuple(views), metrics, {} if lpips.available else {lpips.name: f"not available: {lpips.reason}"}


def measure_training_renders(
    renders: Iterable[RenderedView], count: int, progress: Progress
) -> dict[str, float | None]:
    """Return the mean absolute difference and PSNR of training photos and renders, as ``training.*``.

    They tell how well the splat fits what it was made from, and nothing of how it looks from elsewhere.
    """
    absolute, ratio = [], []
    for render in track(renders, "measure training", progress, count):
        counts = np.ones(render.photo.shape[:2], bool) if render.weights is None else render.weights > 0
        absolute.append(float(np.abs(render.photo - render.render)[counts].mean()))
        ratio.append(psnr(render.photo, render.render, counts))
    return {
        "training.views": float(len(absolute)),
        "training.l1": float(np.mean(absolute)) if absolute else None,
        "training.psnr": float(np.mean(ratio)) if ratio else None,
    }


def measure_poses(
    estimate: Scene, reference: Scene | None, *, name: str = "poses"
) -> tuple[dict[str, float | None], dict[str, Any]]:
    """Compare poses with the reference: POS, ROT and ATE, and the relative pose error.

    Always after Sim(3) alignment; after SE(3) alignment and unaligned too where the estimate claims the reference's
    metric frame by its georeference (poses from pictures alone have neither scale nor place).

    Returns
    -------
    metrics, report:
        ``<name>.<alignment>.<measure>`` in scene units of the reference and in degrees; what could not be
        measured is left out and the report says why. The report also holds the errors of each frame and
        ``extent``, the diagonal of the box around the reference's camera centres.
    """
    if reference is None or not reference.registered:
        return {}, {"reason": "the data have no reference poses"}
    metrics: dict[str, float | None] = {}
    centres = reference.centres()
    report: dict[str, Any] = {"extent": float(np.linalg.norm(np.ptp(centres, axis=0)))}
    alignments: tuple[Alignment, ...] = ("sim3",) if estimate.georeference is None else ("sim3", "se3", "none")
    for alignment in alignments:
        try:
            errors = trajectory_errors(estimate, reference, alignment)
        except StageError as error:
            report[alignment] = {"reason": str(error)}
            continue
        report[alignment] = errors.to_dict()
        metrics[f"{name}.{alignment}.pos"] = errors.pos
        metrics[f"{name}.{alignment}.rot_deg"] = errors.rot
        metrics[f"{name}.{alignment}.ate"] = errors.ate
    try:
        relative = relative_errors(estimate, reference).to_dict()
    except StageError as error:
        report["relative"] = {"reason": str(error)}
    else:
        report["relative"] = relative
        metrics[f"{name}.rpe.translation"] = relative["translation_rmse"]
        metrics[f"{name}.rpe.rotation_deg"] = relative["rotation_deg_rmse"]
    return metrics, report


def _write_picture(picture: NDArray[np.float32], path: Path) -> None:
    with atomic_path(path) as temporary:
        Image.fromarray((np.clip(picture, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)).save(temporary)
