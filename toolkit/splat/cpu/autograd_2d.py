"""The CPU rasterizer of 2D Gaussians as two differentiable functions, like :mod:`toolkit.splat.cpu.autograd`."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from toolkit.geometry.compiled import launching
from toolkit.splat.cpu.autograd import Project, Projection, as_array, check_inputs, near_plane
from toolkit.splat.cpu.backward_2d import blend_backward_2d
from toolkit.splat.cpu.forward_2d import blend_2d
from toolkit.splat.cpu.projection_2d import project_2d
from toolkit.splat.cpu.projection_backward_2d import project_backward_2d
from toolkit.splat.cpu.tiles import TileLists
from toolkit.splat.cpu.tiles_2d import SPLAT, build_tile_lists_2d
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.rasterize import RasterSettings, RenderOutput, Views

Array = np.ndarray[Any, Any]


def rasterize_cpu_2d(
    gaussians: Gaussians, views: Views, settings: RasterSettings, background: Tensor
) -> RenderOutput:
    """Draw 2D Gaussians on all CPU cores; see :func:`toolkit.splat.rasterize.rasterize` for the arguments.

    What is drawn is said in :mod:`toolkit.splat.reference_2d`. Images and gradients are the same to the bit
    whatever the number of numba's threads.

    Raises
    ------
    CapabilityError
        Where the Gaussians are not float32 or not on the CPU.
    """
    check_inputs(gaussians, views, background)
    degree = gaussians.sh_degree if settings.sh_degree is None else settings.sh_degree
    means2d, splats, bounds, radii = Project.apply(
        gaussians.means,
        gaussians.quaternions,
        gaussians.log_scales,
        gaussians.opacity_logits,
        gaussians.sh,
        views.cam_from_world.to(torch.float32),
        views,
        (near_plane(views, settings), degree),
        Projection(project_2d, project_backward_2d, SPLAT),
    )
    size = views.width, views.height, None if views.affine else float(settings.near)
    colour, alpha, expected, median, normals, distortion = _Blend.apply(
        means2d, splats, background.to(torch.float32), bounds, radii, size
    )
    return RenderOutput(colour, alpha, expected, median, radii, means2d, normals, distortion)


class _Blend(torch.autograd.Function):
    """Footprints to images: see :mod:`toolkit.splat.cpu.forward_2d`."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        splats: Tensor,
        background: Tensor,
        bounds: Tensor,
        radii: Tensor,
        size: tuple[int, int, float | None],
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        width, height, near = size
        number = len(means2d)
        colour, normals = (splats.new_empty(number, height, width, 3) for _ in range(2))
        alpha, depth, median, distortion = (splats.new_empty(number, height, width) for _ in range(4))
        lists: list[TileLists] = []
        used: list[Array] = []
        footprint = [as_array(tensor) for tensor in (means2d, splats, bounds, radii[..., None])]
        images = [as_array(tensor) for tensor in (colour, alpha, depth, median, normals, distortion)]
        with launching():
            for c in range(number):
                a, b, d, e = (array[c] for array in footprint)
                lists.append(build_tile_lists_2d(a, b, d, e, (width, height), near))
                used.append(blend_2d(lists[c], near, as_array(background), tuple(image[c] for image in images)))
        ctx.save_for_backward(colour, alpha, depth, normals, distortion)
        ctx.lists, ctx.used, ctx.near, ctx.shape = lists, used, near, means2d.shape[:2]
        ctx.mark_non_differentiable(median)
        return colour, alpha, depth, median, normals, distortion

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        images = [as_array(tensor) for tensor in ctx.saved_tensors]
        by_images = [as_array(gradients[k]) for k in (0, 1, 2, 4, 5)]
        by_means2d, by_splats = (torch.zeros(*ctx.shape, columns) for columns in (2, SPLAT))
        by_background = np.zeros(3)
        with launching():
            for c, (lists, used) in enumerate(zip(ctx.lists, ctx.used, strict=True)):
                by_background += blend_backward_2d(
                    lists,
                    used,
                    ctx.near,
                    tuple(image[c] for image in images),
                    tuple(image[c] for image in by_images),
                    as_array(by_means2d)[c],
                    as_array(by_splats)[c],
                )
        return by_means2d, by_splats, torch.from_numpy(by_background).to(torch.float32), None, None, None
