"""The rasterizer for NVIDIA GPUs: an adapter on gsplat (1.5.3).

gsplat's conventions are ours: quaternions ``wxyz``, pixel centres at +0.5, 0.3 square pixels of blur, the same
limits of alpha and transmittance, harmonics of the direction from the camera centre, which it finds from the pose
with gradient.

Kind "3d" is :func:`gsplat.rasterization`. It has no median depth: that is found from gsplat's lists of what each
pixel meets.

Kind "2d" differs in gsplat from ours in what a depth is (the centre's, not the intersection's), in the distortion
(absolute, not squared, differences) and in where the screen space Gaussian lies. So the disks are projected as in
:mod:`toolkit.splat.reference_2d`, gsplat sorts them and lists which pixel meets which, and PyTorch blends the list:
memory grows with its length. Where a ray meets a disk nearer than ``near``, gsplat may end a pixel's list early.
"""

from __future__ import annotations

import dataclasses
import importlib
import math
from types import ModuleType

import torch
from torch import Tensor

from toolkit.errors import CapabilityError
from toolkit.optional import require
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.pairs import median_pairs, sums, transmittance_before
from toolkit.splat.rasterize import (
    ALPHA_MAX,
    ALPHA_MIN,
    COVARIANCE_BLUR,
    RasterSettings,
    RenderOutput,
    Views,
)
from toolkit.splat.reference import of_all
from toolkit.splat.reference_2d import Disks, meet, project_disks

TILE = 16
# So many times 256 Gaussians of a tile are listed at once for the median depth: bounds the memory.
_BATCHES = 4


def rasterize_cuda(
    gaussians: Gaussians, views: Views, settings: RasterSettings, background: Tensor
) -> RenderOutput:
    """Draw Gaussians on a GPU; see :func:`toolkit.splat.rasterize.rasterize` for the arguments.

    Gradients reach every parameter of the Gaussians (of kind "2d" but the third scale),
    ``views.cam_from_world``, the background, and ``means2d`` of the result. ``radii`` may be somewhat larger than
    those of other backends.

    Raises
    ------
    MissingDependencyError
        Where gsplat is not installed.
    CapabilityError
        For affine views; where there is no GPU, gsplat has no kernels for it, or the Gaussians are not float32 on
        it.
    """
    if views.affine:
        raise CapabilityError(
            "Backend 'cuda' cannot draw affine views",
            expected="pinhole cameras",
            todo="Use backend 'cpu', or fit perspective cameras to the affine ones",
        )
    gsplat = require("gsplat")
    _require_gpu(gaussians)
    # Poses may have been kept in double precision or on the CPU: their gradients find the way back.
    views = dataclasses.replace(
        views,
        cam_from_world=views.cam_from_world.to(gaussians.means),
        intrinsics=views.intrinsics.to(gaussians.means),
    )
    background = background.to(gaussians.means)
    if settings.kind == "2d":
        return _rasterize_2d(gsplat, gaussians, views, settings, background)
    return _rasterize_3d(gsplat, gaussians, views, settings, background)


def _require_gpu(gaussians: Gaussians) -> None:
    if not torch.cuda.is_available():
        raise CapabilityError(
            "Backend 'cuda' cannot draw here",
            expected="an NVIDIA GPU and a build of PyTorch with CUDA",
            found=f"PyTorch {torch.__version__} without a GPU that it can use",
            todo="Use backend 'cpu', or install the driver and PyTorch for CUDA",
        )
    for name, tensor in gaussians.named():
        if tensor.dtype != torch.float32 or not tensor.is_cuda:
            raise CapabilityError(
                f"Backend 'cuda' cannot draw these Gaussians' {name}",
                expected="float32 on a GPU",
                found=f"{str(tensor.dtype).removeprefix('torch.')} on {tensor.device}",
                todo="Use gaussians.to(dtype=torch.float32, device='cuda')",
            )
    _require_kernels()


def _require_kernels() -> None:
    # Compiled at its first use where the wheel has none for this machine, which needs NVIDIA's compiler.
    if importlib.import_module("gsplat.cuda._backend")._C is None:
        raise CapabilityError(
            "gsplat cannot draw here",
            expected="its CUDA kernels",
            found="none that are compiled, and no CUDA toolkit to compile them",
            todo="Install the CUDA toolkit (nvcc) of PyTorch's version, or a wheel of gsplat with kernels",
        )


def _rasterize_3d(
    gsplat: ModuleType, gaussians: Gaussians, views: Views, settings: RasterSettings, background: Tensor
) -> RenderOutput:
    images, alpha, info = gsplat.rasterization(
        means=gaussians.means,
        quats=gaussians.quaternions,
        scales=gaussians.log_scales.exp(),
        opacities=torch.sigmoid(gaussians.opacity_logits),
        colors=gaussians.sh,
        viewmats=views.cam_from_world,
        Ks=views.intrinsics,
        width=views.width,
        height=views.height,
        near_plane=settings.near,
        eps2d=COVARIANCE_BLUR,
        sh_degree=gaussians.sh_degree if settings.sh_degree is None else settings.sh_degree,
        packed=False,
        tile_size=TILE,
        backgrounds=background.expand(len(views), 3),
        render_mode="RGB+ED",
        rasterize_mode="classic",
        camera_model="pinhole",
        absgrad=settings.absolute_gradients,
    )
    drawn = (info["radii"] > 0).all(-1)
    # gsplat leaves memory as it was where nothing is drawn. Through .data: a change of what it keeps for the
    # backward pass, which reads only what is drawn, would be an error.
    info["means2d"].data.masked_fill_(~drawn[..., None], 0)
    return RenderOutput(
        colour=images[..., :3],
        alpha=alpha[..., 0],
        expected_depth=images[..., 3],
        median_depth=_median_depth(gsplat, info, views),
        radii=torch.where(drawn, info["radii"].amax(-1), 0).to(torch.int32),
        means2d=info["means2d"],
    )


@torch.no_grad()
def _median_depth(gsplat: ModuleType, info: dict[str, Tensor], views: Views) -> Tensor:
    """Return the median depth (C, H, W) from the projected Gaussians, a few batches of every tile at a time."""
    means2d, conics, opacities, depths = (info[key] for key in ("means2d", "conics", "opacities", "depths"))
    width, height = views.width, views.height
    pixels = len(views) * height * width
    left, median = means2d.new_ones(pixels), means2d.new_zeros(pixels)
    for start in range(0, _batches(info["isect_offsets"], info["flatten_ids"]), _BATCHES):
        index, pixel, view = gsplat.rasterize_to_indices_in_range(
            start,
            start + _BATCHES,
            left.reshape(len(views), height, width),
            means2d,
            conics,
            opacities,
            width,
            height,
            TILE,
            info["isect_offsets"],
            info["flatten_ids"],
        )
        dx = pixel % width + 0.5 - means2d[view, index, 0]
        dy = pixel // width + 0.5 - means2d[view, index, 1]
        xx, xy, yy = conics[view, index].unbind(-1)
        power = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
        alpha = (opacities[view, index] * torch.exp(-power)).clamp(max=ALPHA_MAX)
        where = view * (height * width) + pixel
        before = left[where] * transmittance_before(where, alpha, pixels)
        seen, pair = median_pairs(where, alpha, before, pixels)
        median[seen] = depths[view, index][pair]
        left = left * torch.exp(sums(where, torch.log1p(-alpha), pixels))
        # Nothing more is listed for a pixel without light.
        left = torch.where(left > 0.5, left, 0)
    return median.reshape(len(views), height, width)


def _batches(offsets: Tensor, flatten_ids: Tensor) -> int:
    """Return how many times TILE * TILE Gaussians the fullest tile has."""
    ends = torch.cat([offsets.flatten(), offsets.new_tensor([len(flatten_ids)])])
    return math.ceil(int(ends.diff().max()) / TILE**2)


def _rasterize_2d(
    gsplat: ModuleType, gaussians: Gaussians, views: Views, settings: RasterSettings, background: Tensor
) -> RenderOutput:
    disks = [
        project_disks(gaussians, cam_from_world, intrinsics, views, settings)
        for cam_from_world, intrinsics in zip(views.cam_from_world, views.intrinsics, strict=True)
    ]
    means2d, radii = of_all(len(gaussians), disks)
    images = [
        _blend_disks(gsplat, view, centres[view.index], background, views, settings.near)
        for view, centres in zip(disks, means2d, strict=True)
    ]
    colour, alpha, expected, median, normals, distortion = (torch.stack(part) for part in zip(*images, strict=True))
    return RenderOutput(colour, alpha, expected, median, radii, means2d, normals=normals, distortion=distortion)


def _blend_disks(
    gsplat: ModuleType, view: Disks, means2d: Tensor, background: Tensor, views: Views, near: float
) -> tuple[Tensor, ...]:
    """Return colour (H, W, 3), alpha, two depths (H, W), normals (H, W, 3) and distortion (H, W) of one view."""
    shape, pixels = (views.height, views.width), views.height * views.width
    index, pixel = _list_disks(gsplat, view, means2d, views)
    picked = dataclasses.replace(view, axes=view.axes[index], depths=view.depths[index])
    dx = pixel % views.width + 0.5 - means2d[index, 0]
    dy = pixel // views.width + 0.5 - means2d[index, 1]
    power, depths = meet(dx, dy, picked, near)
    alpha = (view.opacities[index] * torch.exp(-power)).clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))
    before = transmittance_before(pixel, alpha, pixels)
    weights = alpha * before

    features = torch.cat([view.colours[index], view.normals[index], depths[:, None]], dim=-1)
    blended = sums(pixel, weights[:, None] * features, pixels)
    total = sums(pixel, weights, pixels)
    colour = blended[:, :3] + (1 - total)[:, None] * background
    expected = blended[:, 6] / torch.where(total > 0, total, torch.ones_like(total))
    distortion = total * sums(pixel, weights * (depths - expected[pixel]).square(), pixels)
    with torch.no_grad():
        seen, pair = median_pairs(pixel, alpha, before, pixels)
        median = total.new_zeros(pixels).index_copy(0, seen, depths[pair])
    return (
        colour.reshape(*shape, 3),
        total.reshape(shape),
        expected.reshape(shape),
        median.reshape(shape),
        blended[:, 3:6].reshape(*shape, 3),
        distortion.reshape(shape),
    )


@torch.no_grad()
def _list_disks(gsplat: ModuleType, view: Disks, means2d: Tensor, views: Views) -> tuple[Tensor, Tensor]:
    """Return disk and pixel (P,) of every pair, sorted by pixel, nearest first."""
    if not len(view.index):
        return view.index, view.index
    size = means2d.new_tensor([views.width, views.height])
    low, high = (torch.minimum((means2d + view.bounds[:, side]).clamp(min=0), size) for side in (0, 1))
    across, down = math.ceil(views.width / TILE), math.ceil(views.height / TILE)
    _, keys, flatten_ids = gsplat.isect_tiles(
        ((low + high) / 2)[None],
        torch.ceil((high - low) / 2).clamp(min=1).to(torch.int32)[None],
        view.depths[None],
        TILE,
        across,
        down,
    )
    offsets = gsplat.isect_offset_encode(keys, 1, across, down).reshape(1, down, across)
    # The paper's matrix T in pixels: its first rows are seen from the projected centre, and from the corner here.
    third = torch.cat([view.axes[:, 2], view.depths[:, None]], dim=-1)
    rows = torch.cat([view.axes[:, :2], view.axes.new_zeros(len(view.index), 2, 1)], dim=-1)
    rows = rows + means2d[:, :, None] * third[:, None]
    index, pixel, _ = gsplat.rasterize_to_indices_in_range_2dgs(
        0,
        _batches(offsets, flatten_ids),
        means2d.new_ones(1, views.height, views.width),
        means2d[None],
        torch.cat([rows, third[:, None]], dim=1)[None],
        view.opacities[None],
        views.width,
        views.height,
        TILE,
        offsets,
        flatten_ids,
    )
    return index, pixel
