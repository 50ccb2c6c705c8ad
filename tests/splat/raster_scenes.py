"""Small scenes for the rasterizers' tests, each hard in its own way; all values fit float32 exactly."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toolkit.splat.gaussians import Gaussians
from toolkit.splat.lie import exp_se3
from toolkit.splat.rasterize import Views


@dataclass(frozen=True)
class RasterScene:
    """Gaussians, the views they are drawn in, and the near plane; float64."""

    gaussians: Gaussians
    views: Views
    near: float = 0.2


def cameras(count: int, width: int, height: int, focal: float = 45.0, spread: float = 0.15) -> Views:
    """Cameras around the origin that look along z, with different focal lengths in x and y."""
    generator = torch.Generator().manual_seed(7)
    xi = spread * (2 * torch.rand(count, 6, generator=generator, dtype=torch.float64) - 1)
    intrinsics = torch.tensor([[focal, 0, width / 2 + 1.25], [0, focal * 1.125, height / 2 - 0.75], [0, 0, 1]])
    pose = exp_se3(xi).to(torch.float32).to(torch.float64)
    return Views(pose, intrinsics.to(torch.float64).expand(count, 3, 3), width, height)


def gaussians_in(
    lower: tuple[float, float, float],
    upper: tuple[float, float, float],
    count: int,
    *,
    degree: int = 1,
    scale: tuple[float, float] = (-2.5, 0.5),
    logit: tuple[float, float] = (0.0, 1.5),
    seed: int = 0,
) -> Gaussians:
    """Gaussians with uniform centres; mean and deviation are given for log scales and opacity logits."""
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(lower), torch.tensor(upper)
    return Gaussians(
        means=low + (high - low) * torch.rand(count, 3, generator=generator),
        quaternions=torch.randn(count, 4, generator=generator),
        log_scales=scale[0] + scale[1] * torch.randn(count, 3, generator=generator),
        opacity_logits=logit[0] + logit[1] * torch.randn(count, generator=generator),
        sh=0.4 * torch.randn(count, (degree + 1) ** 2, 3, generator=generator),
    ).to(dtype=torch.float64)


def needles(count: int) -> Gaussians:
    """Gaussians a hundred to a thousand times longer than thick."""
    plain = gaussians_in((-1.5, -1, 2), (1.5, 1, 5), count, seed=3)
    generator = torch.Generator().manual_seed(4)
    log_scales = torch.tensor([-0.5, -6.0, -7.0]) + 0.3 * torch.randn(count, 3, generator=generator)
    return Gaussians(plain.means, plain.quaternions, log_scales.to(torch.float64), plain.opacity_logits, plain.sh)


def one_gaussian(
    mean: tuple[float, float, float] = (0, 0, 2),
    deviation: float = 0.1,
    opacity: float = 0.5,
    colour: tuple[float, float, float] = (0.9, 0.5, 0.1),
) -> Gaussians:
    """One round Gaussian of one colour; float64."""
    return Gaussians(
        means=torch.tensor([mean], dtype=torch.float64),
        quaternions=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
        log_scales=torch.full((1, 3), deviation, dtype=torch.float64).log(),
        opacity_logits=torch.logit(torch.tensor([opacity], dtype=torch.float64)),
        sh=(torch.tensor([[colour]], dtype=torch.float64) - 0.5) / 0.28209479177387814,
    )


def together(*parts: Gaussians) -> Gaussians:
    """All Gaussians of several sets."""
    names = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
    return Gaussians(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


def straight_view(size: int = 21, focal: float = 20.0) -> Views:
    """One camera in the origin, an odd number of pixels, the principal point in the middle one's centre."""
    intrinsics = torch.tensor([[[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]], dtype=torch.float64)
    return Views(torch.eye(4, dtype=torch.float64)[None], intrinsics, size, size)


SCENES: dict[str, RasterScene] = {
    "ordinary, degree 3": RasterScene(
        gaussians_in((-1.5, -1, 1.5), (1.5, 1, 5), 250, degree=3), cameras(1, 61, 43)
    ),
    "three views, degree 2": RasterScene(
        gaussians_in((-1.5, -1, 1.5), (1.5, 1, 5), 150, degree=2, seed=1), cameras(3, 35, 50)
    ),
    "degree 0": RasterScene(gaussians_in((-2, -1.5, 1.5), (2, 1.5, 5), 400, degree=0, seed=2), cameras(1, 70, 33)),
    "across the near plane": RasterScene(
        gaussians_in((-0.4, -0.3, -0.5), (0.4, 0.3, 1.2), 150, scale=(-3.5, 0.4), seed=5), cameras(1, 47, 39)
    ),
    "held Jacobians": RasterScene(
        gaussians_in((-4, -3, 0.8), (4, 3, 1.6), 150, scale=(-1.0, 0.4), seed=6), cameras(1, 47, 39)
    ),
    "opaque": RasterScene(
        gaussians_in((-1.5, -1, 1.5), (1.5, 1, 5), 150, logit=(9.0, 4.0), seed=8), cameras(1, 47, 39)
    ),
    "needles": RasterScene(needles(120), cameras(1, 47, 39)),
    "smaller than a tile": RasterScene(
        gaussians_in((-0.2, -0.1, 1.5), (0.2, 0.1, 4), 60, seed=9), cameras(2, 7, 5)
    ),
    "inside of Gaussians": RasterScene(
        together(
            gaussians_in((-0.3, -0.3, -0.3), (0.3, 0.3, 0.5), 30, scale=(0.0, 0.3), logit=(-2.0, 0.5), seed=10),
            gaussians_in((-1.5, -1, 1.5), (1.5, 1, 5), 80, seed=11),
        ),
        cameras(1, 47, 39),
    ),
}


def undecided_pixels(scene: RasterScene, colour_of: Tensor, margin: float) -> Tensor:
    """Return (C, H, W) True where float32 and float64 may rightly disagree on whether a Gaussian is drawn.

    These are the pixels in which, in float64, some alpha lies within ``margin`` (relative) of 1/255, or some
    transmittance of 1e-4: a rounding error decides there, and the image jumps. ``colour_of`` (C, H, W, ...) only
    gives the shape. Written out here again on purpose, not taken from the code that is tested.
    """
    from toolkit.splat.rasterize import RasterSettings
    from toolkit.splat.reference import project

    views, masks = scene.views, []
    assert colour_of.shape[:3] == (len(views), views.height, views.width)
    for pose, intrinsics in zip(views.cam_from_world, views.intrinsics, strict=True):
        seen = project(scene.gaussians, pose, intrinsics, views, RasterSettings(near=scene.near))
        dx = torch.arange(views.width)[None, :, None] + 0.5 - seen.means2d[:, 0]
        dy = torch.arange(views.height)[:, None, None] + 0.5 - seen.means2d[:, 1]
        xx, xy, yy = seen.conics.T
        alpha = seen.opacities * torch.exp(-0.5 * (xx * dx**2 + yy * dy**2) - xy * dx * dy)
        near_first = ((255 * alpha - 1).abs() < margin).any(-1)
        drawn = torch.where(255 * alpha >= 1, alpha.clamp(max=0.999), 0.0)
        near_last = ((1e4 * torch.cumprod(1 - drawn, -1) - 1).abs() < 10 * margin).any(-1)
        masks.append(near_first | near_last)
    return torch.stack(masks)
