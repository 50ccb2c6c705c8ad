"""A finished run's splat as a map in which photos are localised."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from toolkit.errors import CapabilityError, DataError, RunError
from toolkit.files import disk_errors
from toolkit.runs.folder import RunFolder

if TYPE_CHECKING:  # PyTorch comes with the first map that is opened.
    from toolkit.localize.splat_map import SplatMap
    from toolkit.splat.gaussians import Gaussians
    from toolkit.splat.rasterize import Kind

# Single precision may round what a map consists of by this share of its extent: a thousandth of a pixel or so.
_COARSEST = 1e-5


def splat_kind(run: RunFolder) -> Kind:
    """Return which kind of Gaussians a run trained. Raises :class:`DataError` where run.json is damaged."""
    return "2d" if run.record().flat_settings.get("train.kind") == "2d" else "3d"


def open_run_map(run: RunFolder, *, device: str = "cpu") -> SplatMap:
    """Return a run's splat as a map in the world of the run's scene.

    Parameters
    ----------
    run:
        A finished run of a method that makes a splat, 2D or 3D.
    device:
        ``"cuda"`` draws with gsplat.

    Raises
    ------
    RunError
        Where the run has no splat, or an empty one.
    DataError
        Where the splat is damaged, or so far from its world's origin that single precision blurs it.
    CapabilityError
        Where there is no GPU and one is asked for.
    """
    if not run.splat_file.is_file():
        raise RunError(
            f"Run {run.id} has no splat",
            expected="a finished run of a method that makes one",
            todo="toolkit recipes lists the methods",
        )
    import torch

    from toolkit.localize.splat_map import SplatMap
    from toolkit.splat.ply import read_splats

    with disk_errors(run.path, "reading"):
        gaussians = read_splats(run.splat_file)
    if not len(gaussians):
        raise RunError(f"The splat of run {run.id} is empty", expected="at least one Gaussian")
    _check_near(run, gaussians)
    if device == "cpu":
        return SplatMap(gaussians, splat_kind(run))
    if not torch.cuda.is_available():
        raise CapabilityError("No GPU was found", expected="one that CUDA can use", todo="Take the device cpu")
    return SplatMap(gaussians.to(device="cuda"), splat_kind(run), backend="cuda")


def _check_near(run: RunFolder, gaussians: Gaussians) -> None:
    """Raise where the rounding of coordinates to float32 is no small share of the splat's extent."""
    means = gaussians.means.numpy()
    centre = np.median(means, axis=0)
    extent = float(np.quantile(np.linalg.norm(means - centre, axis=1), 0.9))
    step = float(np.spacing(np.abs(centre).max().astype(np.float32)))
    if step > _COARSEST * extent:
        raise DataError(
            f"The splat of run {run.id} is too far from its world's origin for single precision",
            expected=f"coordinates that are exact to {_COARSEST * extent:.2g} scene units",
            found=f"steps of {step:.2g} around ({', '.join(f'{value:.6g}' for value in centre)})",
            todo="Run the method on a capture with a local origin",
        )
