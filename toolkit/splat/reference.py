"""The readable rasterizer: every pixel against every Gaussian that may reach it, gradients by autograd.

It is the twin that the fast backends are tested against, in float64, and the one to read first. The steps are
those of Kerbl et al., 3D Gaussian Splatting (2023), sections 4 to 6, and Zwicker et al., EWA Splatting (2001).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from toolkit.splat.gaussians import Gaussians
from toolkit.splat.rasterize import (
    ALPHA_MAX,
    ALPHA_MIN,
    COVARIANCE_BLUR,
    JACOBIAN_MARGIN,
    TRANSMITTANCE_MIN,
    RasterSettings,
    RenderOutput,
    Views,
    absolute_carrier,
)
from toolkit.splat.sh import eval_sh

# Standard deviations at which the falloff of an opaque Gaussian is below 1/255: sqrt(2 ln 255) = 3.329.
MAX_EXTENT = 3.33
# Side in pixels of the squares that are done one by one; Gaussians that do not reach a square are left out there.
BLOCK = 16
# Pixels times Gaussians that are kept for the backward pass: bounds the memory (about 20 arrays of this size).
PAIRS_KEPT = 1 << 22


@dataclass(frozen=True, slots=True)
class Projected:
    """The M Gaussians of one view that can be drawn, nearest first.

    Attributes
    ----------
    index:
        (M,) their positions among all N.
    means2d:
        (M, 2) centres in pixels.
    conics:
        (M, 3) inverse covariance in the image: xx, xy, yy, in 1 / pixels^2.
    depths:
        (M,) camera depths.
    opacities, colours:
        (M,) and (M, 3).
    radii:
        (M,) int32, pixels.
    """

    index: Tensor
    means2d: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor
    colours: Tensor
    radii: Tensor


def rasterize_reference(
    gaussians: Gaussians, views: Views, settings: RasterSettings, background: Tensor
) -> RenderOutput:
    """Draw Gaussians by the letter of :mod:`toolkit.splat.rasterize`; see there for the arguments.

    Works in the precision of ``gaussians.means``. Gradients reach every parameter of the Gaussians,
    ``views.cam_from_world``, the background, and ``means2d`` of the result.
    """
    dtype = gaussians.means.dtype
    projected = [
        project(gaussians, cam_from_world.to(dtype), intrinsics.to(dtype), views, settings)
        for cam_from_world, intrinsics in zip(views.cam_from_world, views.intrinsics, strict=True)
    ]
    means2d, radii = of_all(len(gaussians), projected)
    carrier = absolute_carrier(means2d, settings)
    carriers = [None] * len(means2d) if carrier is None else list(carrier)
    images = [
        blend(
            view,
            centres[view.index],
            background.to(dtype),
            views.width,
            views.height,
            absolute=None if carried is None else carried[view.index],
        )
        for view, centres, carried in zip(projected, means2d, carriers, strict=True)
    ]
    colour, alpha, expected_depth, median_depth = (torch.stack(image) for image in zip(*images, strict=True))
    return RenderOutput(colour, alpha, expected_depth, median_depth, radii, means2d, absolute=carrier)


class Drawn(Protocol):
    """What a view's projection has of the M Gaussians that can be drawn."""

    @property
    def index(self) -> Tensor:
        """(M,) their positions among all."""

    @property
    def means2d(self) -> Tensor:
        """(M, 2)."""

    @property
    def radii(self) -> Tensor:
        """(M,)."""


def of_all(count: int, views: Sequence[Drawn]) -> tuple[Tensor, Tensor]:
    """Return centres (C, N, 2) and radii (C, N) of all N Gaussians, zero for those that are not drawn.

    The images depend on the centres through this one tensor: its gradient is what density control reads.
    """
    means2d = [view.means2d.new_zeros(count, 2).index_copy(0, view.index, view.means2d) for view in views]
    radii = [view.radii.new_zeros(count).index_copy(0, view.index, view.radii) for view in views]
    return torch.stack(means2d), torch.stack(radii)


def project(
    gaussians: Gaussians, cam_from_world: Tensor, intrinsics: Tensor, views: Views, settings: RasterSettings
) -> Projected:
    """Project Gaussians into one view and keep those that can be drawn, sorted by depth.

    Parameters
    ----------
    cam_from_world, intrinsics:
        (4, 4) and (3, 3) of the view.
    """
    rotation, translation = cam_from_world[:3, :3], cam_from_world[:3, 3]
    means = gaussians.means @ rotation.T + translation
    opacities = torch.sigmoid(gaussians.opacity_logits)
    # Everything below is computed for these only: behind the camera there is no projection, nor a gradient.
    index = torch.nonzero(beyond_near(means, views, settings) & (opacities >= ALPHA_MIN))[:, 0]
    means, opacities = means[index], opacities[index]

    z = means[:, 2]
    plane = means[:, :2] if views.affine else means[:, :2] / z[:, None]
    means2d = plane @ intrinsics[:2, :2].T + intrinsics[:2, 2]
    jacobian = _affine_jacobian(intrinsics) if views.affine else _jacobian(means, intrinsics, views)
    axes = rotation_matrices(gaussians.quaternions[index]) * gaussians.log_scales[index].exp()[:, None, :]
    spread = jacobian @ rotation @ axes
    covariances = spread @ spread.mT + COVARIANCE_BLUR * torch.eye(2, dtype=means.dtype, device=means.device)
    xx, xy, yy = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    determinants = xx * yy - xy * xy

    with torch.no_grad():
        extent = torch.sqrt(2 * torch.log(opacities / ALPHA_MIN)).clamp(max=MAX_EXTENT)
        half = torch.ceil(extent[:, None] * torch.stack([xx, yy], dim=-1).sqrt())
        size = half.new_tensor([views.width, views.height])
        on_image = ((means2d + half > 0) & (means2d - half < size)).all(-1)
        drawn = torch.nonzero(on_image & (determinants > 0) & torch.isfinite(determinants))[:, 0]
        drawn = drawn[torch.argsort(z[drawn], stable=True)]
        index = index[drawn]
        radii = half[drawn].amax(-1).clamp(max=torch.iinfo(torch.int32).max // 2).to(torch.int32)

    conics = torch.stack([yy, -xy, xx], dim=-1)[drawn] / determinants[drawn, None]
    colours = colours_of(gaussians, index, cam_from_world, views, settings)
    return Projected(index, means2d[drawn], conics, z[drawn], opacities[drawn], colours, radii)


def beyond_near(means: Tensor, views: Views, settings: RasterSettings) -> Tensor:
    """Return which of the points (N, 3), in camera coordinates, are not too near to be drawn, (N,)."""
    if views.affine:
        return torch.ones_like(means[:, 2], dtype=torch.bool)
    return means[:, 2] >= settings.near


def colours_of(
    gaussians: Gaussians, index: Tensor, cam_from_world: Tensor, views: Views, settings: RasterSettings
) -> Tensor:
    """Return the colours (M, 3) of the Gaussians ``index`` (M,) in one view, by the direction they are seen in.

    From an affine camera that is its third axis for all: the limit of a pinhole camera that is moved away along it.
    """
    rotation, translation = cam_from_world[:3, :3], cam_from_world[:3, 3]
    along = rotation[2].expand(len(index), 3) if views.affine else gaussians.means[index] + rotation.T @ translation
    directions = torch.nn.functional.normalize(along, dim=-1)
    degree = gaussians.sh_degree if settings.sh_degree is None else settings.sh_degree
    return (eval_sh(degree, gaussians.sh[index], directions) + 0.5).clamp(min=0)


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """Return rotations (N, 3, 3) of quaternions ``wxyz`` (N, 4) of any length but zero."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def _jacobian(means: Tensor, intrinsics: Tensor, views: Views) -> Tensor:
    """Return d(pixel) / d(camera coordinates), (M, 2, 3), at points held near the image.

    Far outside the image the linearisation would make a Gaussian unboundedly large.
    """
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    x, y, z = means.unbind(-1)
    margin_x, margin_y = JACOBIAN_MARGIN * views.width / (2 * fx), JACOBIAN_MARGIN * views.height / (2 * fy)
    tan_x = torch.clamp(x / z, -cx / fx - margin_x, (views.width - cx) / fx + margin_x)
    tan_y = torch.clamp(y / z, -cy / fy - margin_y, (views.height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    rows = [fx / z, zero, -fx * tan_x / z, zero, fy / z, -fy * tan_y / z]
    return torch.stack(rows, dim=-1).reshape(-1, 2, 3)


def _affine_jacobian(intrinsics: Tensor) -> Tensor:
    """Return d(pixel) / d(camera coordinates), (2, 3), of an affine view: the same everywhere."""
    return torch.cat([intrinsics[:2, :2], intrinsics.new_zeros(2, 1)], dim=1)


class _PerPixel(torch.autograd.Function):
    """Centres (M, 2) repeated for a square's pixels; a second tensor gets the gradients without their signs."""

    @staticmethod
    def forward(ctx: Any, means2d: Tensor, absolute: Tensor, height: int, width: int) -> Tensor:
        return means2d.expand(height, width, *means2d.shape)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return gradients[0].sum((0, 1)), gradients[0].abs().sum((0, 1)), None, None


def blend(
    view: Projected,
    means2d: Tensor,
    background: Tensor,
    width: int,
    height: int,
    *,
    absolute: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return colour (H, W, 3), alpha, expected depth and median depth (H, W) of one view.

    ``absolute`` (M, 2) gets the sum over pixels of the gradient by ``means2d`` without its sign. Where the pairs
    are too many to be kept, each square is computed again in the backward pass.
    """
    corners = [[(left, top) for left in range(0, width, BLOCK)] for top in range(0, height, BLOCK)]
    reaching = [[_reaching(view, means2d, left, top) for left, top in row] for row in corners]
    pairs = BLOCK**2 * sum(len(near) for row in reaching for near in row)
    rows = []
    for places, lists in zip(corners, reaching, strict=True):
        squares = []
        for (left, top), near in zip(places, lists, strict=True):
            box = left, top, min(width, left + BLOCK), min(height, top + BLOCK)
            arguments = box, near, view, means2d, background, absolute
            if pairs > PAIRS_KEPT and torch.is_grad_enabled():
                square = checkpoint(_blend_square, *arguments, use_reentrant=False, preserve_rng_state=False)
            else:
                square = _blend_square(*arguments)
            squares.append(square)
        rows.append([torch.cat(parts, dim=1) for parts in zip(*squares, strict=True)])
    colour, alpha, expected, median = (torch.cat(parts) for parts in zip(*rows, strict=True))
    return colour, alpha, expected, median


@torch.no_grad()
def _reaching(view: Projected, means2d: Tensor, left: int, top: int) -> Tensor:
    """Return which Gaussians, nearest first, may be drawn in the square with this corner."""
    corner = means2d.new_tensor([left, top])
    apart = (means2d - (corner + BLOCK / 2)).abs().amax(-1)
    return torch.nonzero(apart <= view.radii + BLOCK / 2)[:, 0]


def _blend_square(
    box: tuple[int, int, int, int],
    near: Tensor,
    view: Projected,
    means2d: Tensor,
    background: Tensor,
    absolute: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Blend the Gaussians ``near`` in the pixels of a box (left, top, right, bottom), front to back."""
    left, top, right, bottom = box
    ys = torch.arange(top, bottom, dtype=means2d.dtype, device=means2d.device) + 0.5
    xs = torch.arange(left, right, dtype=means2d.dtype, device=means2d.device) + 0.5
    centres = means2d[near]
    if absolute is not None:
        centres = _PerPixel.apply(centres, absolute[near], len(ys), len(xs))
    dx = xs[None, :, None] - centres[..., 0]  # (1, W, M), or (H, W, M)
    dy = ys[:, None, None] - centres[..., 1]  # (H, 1, M), or (H, W, M)
    depths = view.depths[near]
    xx, xy, yy = view.conics[near].unbind(-1)
    power = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy  # (H, W, M)
    # The power cannot be negative; rounding can make it so for needles.
    alpha = (view.opacities[near] * torch.exp(-power.clamp(min=0))).clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))

    # The transmittance never grows, so what follows the one that would end the pixel fails this test too.
    unfinished = torch.cumprod(1 - alpha, dim=-1) > TRANSMITTANCE_MIN
    alpha = torch.where(unfinished, alpha, torch.zeros_like(alpha))
    behind = torch.cumprod(1 - alpha, dim=-1)
    in_front = behind.new_ones(*behind.shape[:-1], 1)
    transmittance = torch.cat([in_front, behind], dim=-1)  # (H, W, M + 1)
    before, final = transmittance[..., :-1], transmittance[..., -1]
    weights = alpha * before

    colour = weights @ view.colours[near] + final[..., None] * background
    total = weights.sum(-1)
    drawn = total > 0
    depth = (weights @ depths) / torch.where(drawn, total, torch.ones_like(total))
    with torch.no_grad():
        # The last one that was drawn while more than half of the light was left.
        count = torch.arange(1, alpha.shape[-1] + 1, device=alpha.device)
        last = torch.where((alpha > 0) & (before > 0.5), count, torch.zeros_like(count))
        last = torch.cat([last.new_zeros(*last.shape[:-1], 1), last], dim=-1).amax(-1)
        median = torch.cat([depths.new_zeros(1), depths])[last]
    return colour, 1 - final, depth, median
