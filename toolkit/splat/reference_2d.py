"""The readable rasterizer of 2D Gaussians: disks, met by the pixels' rays; gradients by autograd.

Huang et al., 2D Gaussian Splatting for Geometrically Accurate Radiance Fields (2024), sections 4 and 5. A Gaussian
is a disk: its first two axes span it, the third is its normal, the third scale is not used. Like
:mod:`toolkit.splat.reference` this is the twin that fast backends are tested against, in float64.

What is drawn, beyond the rules in :mod:`toolkit.splat.rasterize`:

- At the pixel (x, y) the falloff is the larger one of exp(-(u^2 + v^2) / 2), with (u, v) where the ray meets the
  disk's plane in units of its scales, and exp(-d^2), with d the distance in pixels from the projected centre: a
  screen space Gaussian of deviation sqrt(1/2) (equation 11), without which disks seen edge-on would vanish. (The
  paper's code and gsplat put it in the middle of the disk's image, which perspective moves off that centre.)
- The disk is not there where the ray meets its plane at a camera depth below ``near``. The screen space Gaussian
  is still drawn around the centre, whose depth is ``near`` or more.
- A contribution's depth is that of the intersection where the disk decides, that of the centre elsewhere.
- Gaussians are blended in order of their centres' camera depths.

In affine views rays are parallel: a pixel's (u, v) are linear in its position, and so is the depth along a disk.
There is no near plane, and depths may be negative.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from toolkit.splat.gaussians import Gaussians
from toolkit.splat.rasterize import (
    ALPHA_MAX,
    ALPHA_MIN,
    TRANSMITTANCE_MIN,
    RasterSettings,
    RenderOutput,
    Views,
)
from toolkit.splat.reference import MAX_EXTENT, beyond_near, colours_of, of_all, rotation_matrices

# Deviation of the screen space Gaussian, in pixels: the square root of a half.
FILTER_DEVIATION = 0.5**0.5
# Pixels times Gaussians that are evaluated at once: bounds the memory (about 40 arrays of this size).
PAIRS_AT_ONCE = 1 << 21


@dataclass(frozen=True, slots=True)
class Disks:
    """The M disks of one view that can be drawn, nearest first.

    Attributes
    ----------
    index:
        (M,) their positions among all N.
    means2d:
        (M, 2) projected centres in pixels.
    axes:
        (M, 3, 2) the point (u, v) of the disk is seen at the pixel means2d + (axes[:2] @ (u, v)) / z, and its depth
        is z = depth + axes[2] @ (u, v). These are the rows of the paper's matrix T, in pixel coordinates around the
        projected centre, where the third column is (0, 0, depth). In affine views it is seen at
        means2d + axes[:2] @ (u, v), and its depth is the same.
    depths:
        (M,) camera depths of the centres.
    opacities, colours:
        (M,) and (M, 3).
    normals:
        (M, 3) unit, camera axes, turned towards the camera.
    bounds:
        (M, 2, 2) the box that can be touched, in pixels from the centre: lowest x and y, highest x and y.
    radii:
        (M,) int32, pixels.
    affine:
        Whether the view is.
    """

    index: Tensor
    means2d: Tensor
    axes: Tensor
    depths: Tensor
    opacities: Tensor
    colours: Tensor
    normals: Tensor
    bounds: Tensor
    radii: Tensor
    affine: bool = False


def rasterize_reference_2d(
    gaussians: Gaussians, views: Views, settings: RasterSettings, background: Tensor
) -> RenderOutput:
    """Draw 2D Gaussians; see :func:`toolkit.splat.rasterize.rasterize` for the arguments.

    Works in the precision of ``gaussians.means``. Gradients reach every parameter of the Gaussians but the third
    scale, ``views.cam_from_world``, the background, and ``means2d`` of the result.
    """
    dtype = gaussians.means.dtype
    disks = [
        project_disks(gaussians, cam_from_world.to(dtype), intrinsics.to(dtype), views, settings)
        for cam_from_world, intrinsics in zip(views.cam_from_world, views.intrinsics, strict=True)
    ]
    means2d, radii = of_all(len(gaussians), disks)
    images = [
        _blend(view, centres[view.index], background.to(dtype), views.width, views.height, settings.near)
        for view, centres in zip(disks, means2d, strict=True)
    ]
    colour, alpha, expected, median, normals, distortion = (
        torch.stack(image) for image in zip(*images, strict=True)
    )
    return RenderOutput(colour, alpha, expected, median, radii, means2d, normals, distortion)


def project_disks(
    gaussians: Gaussians, cam_from_world: Tensor, intrinsics: Tensor, views: Views, settings: RasterSettings
) -> Disks:
    """Project 2D Gaussians into one view and keep those that can be drawn, sorted by depth.

    Parameters
    ----------
    cam_from_world, intrinsics:
        (4, 4) and (3, 3) of the view, in the precision of the Gaussians.
    """
    rotation, translation = cam_from_world[:3, :3], cam_from_world[:3, 3]
    means = gaussians.means @ rotation.T + translation
    opacities = torch.sigmoid(gaussians.opacity_logits)
    # Everything below is computed for these only: behind the camera there is no projection, nor a gradient.
    index = torch.nonzero(beyond_near(means, views, settings) & (opacities >= ALPHA_MIN))[:, 0]
    means, opacities = means[index], opacities[index]

    scale, principal = intrinsics[:2, :2], intrinsics[:2, 2]
    depths = means[:, 2]
    plane = means[:, :2] if views.affine else means[:, :2] / depths[:, None]
    turned = rotation @ rotation_matrices(gaussians.quaternions[index])
    spanning = turned[:, :, :2] * gaussians.log_scales[index, None, :2].exp()
    # x = fx X / Z + cx, so Z (x - centre) = fx (X - slope Z): linear in (u, v), and zero at the centre.
    moving = torch.zeros_like(plane) if views.affine else plane
    across = scale @ (spanning[:, :2] - moving[:, :, None] * spanning[:, 2:])
    axes = torch.cat([across, spanning[:, 2:]], dim=1)
    means2d = plane @ scale.T + principal
    normals = turned[:, :, 2]
    away = normals[:, 2:] if views.affine else (normals * means).sum(-1, keepdim=True)
    normals = torch.where(away > 0, -normals, normals)

    with torch.no_grad():
        if views.affine:
            bounds = affine_disk_bounds(axes, opacities)
        else:
            bounds = disk_bounds(axes, depths, opacities, settings.near)
        size = bounds.new_tensor([views.width, views.height])
        on_image = ((means2d + bounds[:, 1] > 0) & (means2d + bounds[:, 0] < size)).all(-1)
        on_image &= torch.isfinite(axes).all(-1).all(-1) & torch.isfinite(bounds).all(-1).all(-1)
        drawn = torch.nonzero(on_image)[:, 0]
        drawn = drawn[torch.argsort(depths[drawn], stable=True)]
        index = index[drawn]
        largest = torch.iinfo(torch.int32).max // 2
        radii = torch.ceil(bounds[drawn].abs().amax((1, 2))).clamp(max=largest).to(torch.int32)

    colours = colours_of(gaussians, index, cam_from_world, views, settings)
    return Disks(
        index,
        means2d[drawn],
        axes[drawn],
        depths[drawn],
        opacities[drawn],
        colours,
        normals[drawn],
        bounds[drawn],
        radii,
        views.affine,
    )


def disk_bounds(axes: Tensor, depths: Tensor, opacities: Tensor, near: float) -> Tensor:
    """Return the boxes (M, 2, 2) in which disks reach an alpha of 1/255, as ``Disks.bounds``.

    Where the circle u^2 + v^2 = r^2 lies in front of the camera its image is an ellipse, whose box follows from the
    matrix T (the paper's code; Sigg et al. 2006). Otherwise, and at most, no point reaches farther than r |axis| /
    near, for a point's depth is ``near`` or more. The screen space Gaussian is inside the box too.
    """
    squared = (2 * torch.log(opacities / ALPHA_MIN)).clamp(min=0, max=MAX_EXTENT**2)[:, None]
    across, along = axes[:, :2], axes[:, 2:]
    in_front = (depths * depths)[:, None] - squared * along.square().sum(-1)
    bounded = in_front > 0
    safe = torch.where(bounded, in_front, torch.ones_like(in_front))
    middle = -squared * (across * along).sum(-1) / safe
    length = across.square().sum(-1)
    half = torch.sqrt(middle * middle + squared * length / safe)
    farthest = torch.sqrt(squared * length) / near
    least = torch.where(bounded, torch.maximum(middle - half, -farthest), -farthest)
    most = torch.where(bounded, torch.minimum(middle + half, farthest), farthest)
    low_pass = FILTER_DEVIATION * squared.sqrt()
    return torch.stack([torch.minimum(least, -low_pass), torch.maximum(most, low_pass)], dim=1)


def affine_disk_bounds(axes: Tensor, opacities: Tensor) -> Tensor:
    """Return the boxes (M, 2, 2) as :func:`disk_bounds`: in affine views ellipses about the projected centres."""
    squared = (2 * torch.log(opacities / ALPHA_MIN)).clamp(min=0, max=MAX_EXTENT**2)[:, None]
    half = torch.sqrt(squared * axes[:, :2].square().sum(-1).clamp(min=FILTER_DEVIATION**2))
    return torch.stack([-half, half], dim=1)


def _blend(
    view: Disks, means2d: Tensor, background: Tensor, width: int, height: int, near: float
) -> tuple[Tensor, ...]:
    """Return colour (H, W, 3), alpha, two depths (H, W), normals (H, W, 3) and distortion (H, W) of one view.

    Rows of pixels are done in groups, each computed again in the backward pass, to bound the memory.
    """
    rows = max(1, PAIRS_AT_ONCE // max(1, width * len(view.index)))
    groups = []
    for top in range(0, height, rows):
        bottom = min(height, top + rows)
        arguments = (top, bottom, width, near, view, means2d, background)
        if rows < height and torch.is_grad_enabled():
            groups.append(checkpoint(_blend_rows, *arguments, use_reentrant=False, preserve_rng_state=False))
        else:
            groups.append(_blend_rows(*arguments))
    return tuple(torch.cat(parts) for parts in zip(*groups, strict=True))


def meet(dx: Tensor, dy: Tensor, view: Disks, near: float) -> tuple[Tensor, Tensor]:
    """Return -log of the falloff, and the depth, of every contribution (rows, W, M).

    ``dx`` (1, W, M) and ``dy`` (rows, 1, M) are the pixels' distances from the projected centres. A pixel's ray is
    where the planes x = const and y = const meet; in the disk's frame they are h_u = x T_2 - T_0 and
    h_v = y T_2 - T_1, and (u, v, 1) is across both (equations 8 to 10). In affine views T_2 is (0, 0, 1) here.
    """
    (k_u, k_v), (l_u, l_v), (g_u, g_v) = ((row[:, 0], row[:, 1]) for row in view.axes.unbind(1))
    if view.affine:
        hu, hv = (-k_u, -k_v, dx), (-l_u, -l_v, dy)
    else:
        hu = dx * g_u - k_u, dx * g_v - k_v, dx * view.depths
        hv = dy * g_u - l_u, dy * g_v - l_v, dy * view.depths
    a = hu[1] * hv[2] - hu[2] * hv[1]
    b = hu[2] * hv[0] - hu[0] * hv[2]
    c = hu[0] * hv[1] - hu[1] * hv[0]
    # Farther out nothing is drawn, and a division there (c = 0: the ray is in the disk's plane) could overflow.
    met = (c != 0) & (a * a + b * b <= MAX_EXTENT**2 * c * c)
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    safe = torch.where(met, c, one)
    u, v = torch.where(met, a, zero) / safe, torch.where(met, b, zero) / safe
    depth = g_u * u + g_v * v + view.depths
    on_disk, low_pass = 0.5 * (u * u + v * v), dx * dx + dy * dy
    decides = met & (on_disk <= low_pass) & (view.affine | (depth >= near))
    return torch.where(decides, on_disk, low_pass), torch.where(decides, depth, view.depths)


def _blend_rows(
    top: int, bottom: int, width: int, near: float, view: Disks, means2d: Tensor, background: Tensor
) -> tuple[Tensor, ...]:
    """Blend the pixels of rows top to bottom - 1, front to back."""
    ys = torch.arange(top, bottom, dtype=means2d.dtype, device=means2d.device) + 0.5
    xs = torch.arange(width, dtype=means2d.dtype, device=means2d.device) + 0.5
    power, depths = meet(xs[None, :, None] - means2d[:, 0], ys[:, None, None] - means2d[:, 1], view, near)
    alpha = (view.opacities * torch.exp(-power)).clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))

    # The transmittance never grows, so what follows the one that would end the pixel fails this test too.
    unfinished = torch.cumprod(1 - alpha, dim=-1) > TRANSMITTANCE_MIN
    alpha = torch.where(unfinished, alpha, torch.zeros_like(alpha))
    behind = torch.cumprod(1 - alpha, dim=-1)
    in_front = behind.new_ones(*behind.shape[:-1], 1)
    transmittance = torch.cat([in_front, behind], dim=-1)  # (rows, W, M + 1)
    before, final = transmittance[..., :-1], transmittance[..., -1]
    weights = alpha * before

    colour = weights @ view.colours + final[..., None] * background
    normals = weights @ view.normals
    total = weights.sum(-1)
    expected = (weights * depths).sum(-1) / torch.where(total > 0, total, torch.ones_like(total))
    # The sum over pairs of w_i w_j (z_i - z_j)^2 is the total weight times the second moment about the mean.
    distortion = total * (weights * (depths - expected[..., None]).square()).sum(-1)
    with torch.no_grad():
        # The last one that was drawn while more than half of the light was left.
        count = torch.arange(1, alpha.shape[-1] + 1, device=alpha.device)
        last = torch.where((alpha > 0) & (before > 0.5), count, torch.zeros_like(count))
        last = torch.cat([last.new_zeros(*last.shape[:-1], 1), last], dim=-1).amax(-1, keepdim=True)
        padded = torch.cat([depths.new_zeros(*depths.shape[:-1], 1), depths], dim=-1)
        median = padded.gather(-1, last)[..., 0]
    return colour, 1 - final, expected, median, normals, distortion
