"""What keeps Gaussians simple while poses are learned: faint where they are not needed, and not too long.

Both are costs that are added to the photometric loss in NoposeGS (Schmidt et al. 2024; A-3DGS, section 3.1 and
Table 2). Long thin Gaussians can fit an edge from one wrong pose, and hold the pose there.
"""

from __future__ import annotations

from torch import Tensor

from toolkit.splat.gaussians import Gaussians
from toolkit.splat.rasterize import Kind


def mean_opacity(gaussians: Gaussians) -> Tensor:
    """Return the mean opacity of all Gaussians."""
    return gaussians.opacity_logits.sigmoid().mean()


def anisotropy_excess(gaussians: Gaussians, most: float, kind: Kind) -> Tensor:
    """Return the mean of ``max(ratio, most) - most`` with the ratio of a Gaussian's largest and smallest scale.

    The form is that of PhysGaussian (Xie et al. 2024, equation 12). Disks have two scales; kind ``2d`` looks at
    these.
    """
    log_scales = gaussians.log_scales if kind == "3d" else gaussians.log_scales[:, :2]
    ratio = (log_scales.amax(dim=-1) - log_scales.amin(dim=-1)).exp()
    return (ratio - most).clamp(min=0).mean()
