"""The CPU rasterizer as two differentiable functions: projection and blending.

They are two so that the projected centres are a tensor of the graph, whose gradient density control reads.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from toolkit.errors import CapabilityError
from toolkit.geometry.compiled import launching
from toolkit.splat.cpu.backward import blend_backward
from toolkit.splat.cpu.forward import blend
from toolkit.splat.cpu.projection import camera_rows, project
from toolkit.splat.cpu.projection_backward import project_backward
from toolkit.splat.cpu.tiles import TileLists, build_tile_lists
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.rasterize import RasterSettings, RenderOutput, Views, absolute_carrier

Array = np.ndarray[Any, Any]


def rasterize_cpu(gaussians: Gaussians, views: Views, settings: RasterSettings, background: Tensor) -> RenderOutput:
    """Draw Gaussians on all CPU cores; see :func:`toolkit.splat.rasterize.rasterize` for the arguments.

    Images and gradients are the same to the bit whatever the number of threads.

    Raises
    ------
    CapabilityError
        Where the Gaussians are not float32 or not on the CPU.
    """
    check_inputs(gaussians, views, background)
    degree = gaussians.sh_degree if settings.sh_degree is None else settings.sh_degree
    means2d, splats, factors, radii = Project.apply(
        gaussians.means,
        gaussians.quaternions,
        gaussians.log_scales,
        gaussians.opacity_logits,
        gaussians.sh,
        views.cam_from_world.to(torch.float32),
        views,
        (near_plane(views, settings), degree),
        Projection(project, project_backward, 8),
    )
    carrier = absolute_carrier(means2d, settings)
    colour, alpha, expected_depth, median_depth = _Blend.apply(
        means2d, splats, background.to(torch.float32), factors, radii, (views.width, views.height), carrier
    )
    return RenderOutput(colour, alpha, expected_depth, median_depth, radii, means2d, absolute=carrier)


def near_plane(views: Views, settings: RasterSettings) -> float:
    """Return the smallest depth that is drawn."""
    return -math.inf if views.affine else settings.near


def check_inputs(gaussians: Gaussians, views: Views, background: Tensor) -> None:
    """Refuse what the kernels cannot take."""
    parameters = dict(gaussians.named())
    others = {"cam_from_world": views.cam_from_world, "intrinsics": views.intrinsics, "background": background}
    for name, tensor in (parameters | others).items():
        if name in parameters and tensor.dtype != torch.float32:
            raise CapabilityError(
                f"Backend 'cpu' cannot draw {name} in this precision",
                expected="float32",
                found=str(tensor.dtype).removeprefix("torch."),
                todo="Convert the Gaussians, or use backend 'reference'.",
            )
        if tensor.device.type != "cpu":
            raise CapabilityError(
                f"Backend 'cpu' cannot draw {name} on this device",
                expected="cpu",
                found=str(tensor.device),
                todo="Move the Gaussians, or use another backend.",
            )


def as_array(tensor: Tensor) -> Array:
    """Return the tensor's contiguous memory."""
    array: Array = tensor.detach().contiguous().numpy()
    return array


def flat(
    means: Tensor, quaternions: Tensor, log_scales: Tensor, logits: Tensor, sh: Tensor
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the parameters as matrices with a row for each Gaussian."""
    return (
        as_array(means),
        as_array(quaternions),
        as_array(log_scales),
        as_array(logits).reshape(-1, 1),
        as_array(sh).reshape(len(sh), 3 * sh.shape[1]),
    )


class Projection(NamedTuple):
    """What projects Gaussians of a kind, what differentiates that, and how many numbers a footprint has."""

    project: Callable[..., None]
    project_backward: Callable[..., tuple[tuple[Array, ...], Array]]
    columns: int


class Project(torch.autograd.Function):
    """Parameters and poses to footprints, and to what their tile lists are made from (4 numbers each)."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quaternions: Tensor,
        log_scales: Tensor,
        logits: Tensor,
        sh: Tensor,
        cam_from_world: Tensor,
        views: Views,
        near_and_degree: tuple[float, int],
        by: Projection,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        count, number = len(means), len(cam_from_world)
        near, degree = near_and_degree
        parameters = flat(means, quaternions, log_scales, logits, sh)
        cameras = camera_rows(
            as_array(cam_from_world), as_array(views.intrinsics), views.width, views.height, views.affine
        )
        means2d, splats, outlines = (means.new_empty(number, count, columns) for columns in (2, by.columns, 4))
        radii = means.new_empty(number, count, 1, dtype=torch.int32)
        size = (views.width, views.height, float(near), degree)
        made = (as_array(means2d), as_array(splats), as_array(outlines), as_array(radii))
        with launching():
            by.project(cameras, size, parameters, made)
        ctx.save_for_backward(means, quaternions, log_scales, logits, sh, splats)
        ctx.radii, ctx.cameras, ctx.degree, ctx.by = radii, cameras, degree, by
        flat_radii = radii.reshape(number, count)
        ctx.mark_non_differentiable(outlines, flat_radii)
        return means2d, splats, outlines, flat_radii

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *parameters, splats = ctx.saved_tensors
        with launching():
            by_parameters, by_pose = ctx.by.project_backward(
                ctx.cameras,
                ctx.degree,
                flat(*parameters),
                (as_array(splats), as_array(ctx.radii)),
                (as_array(gradients[0]), as_array(gradients[1])),
            )
        shaped = [
            torch.from_numpy(array).reshape(tensor.shape)
            for array, tensor in zip(by_parameters, parameters, strict=True)
        ]
        return *shaped, torch.from_numpy(by_pose), None, None, None


class _Blend(torch.autograd.Function):
    """Footprints to images: see :mod:`toolkit.splat.cpu.forward`."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        splats: Tensor,
        background: Tensor,
        factors: Tensor,
        radii: Tensor,
        size: tuple[int, int],
        absolute: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        width, height = size
        number = len(means2d)
        colour = splats.new_empty(number, height, width, 3)
        alpha, depth, median = (splats.new_empty(number, height, width) for _ in range(3))
        lists: list[TileLists] = []
        used: list[Array] = []
        centres, rows, triangles, sizes = (
            as_array(tensor) for tensor in (means2d, splats, factors, radii[..., None])
        )
        images = tuple(as_array(tensor) for tensor in (colour, alpha, depth, median))
        with launching():
            for c in range(number):
                view = build_tile_lists(centres[c], rows[c], triangles[c], sizes[c], width, height)
                lists.append(view)
                used.append(
                    blend(view, as_array(background), (images[0][c], images[1][c], images[2][c], images[3][c]))
                )
        ctx.save_for_backward(colour, alpha, depth)
        ctx.lists, ctx.used, ctx.shape, ctx.absolute = lists, used, means2d.shape[:2], absolute is not None
        ctx.mark_non_differentiable(median)
        return colour, alpha, depth, median

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        colour, alpha, depth = ctx.saved_tensors
        by_means2d, by_splats = colour.new_zeros(*ctx.shape, 2), colour.new_zeros(*ctx.shape, 8)
        by_background = np.zeros(3)
        images = [as_array(tensor) for tensor in (colour, alpha, depth)]
        by_images = [as_array(tensor) for tensor in gradients[:3]]
        absolute = colour.new_zeros(*ctx.shape, 2) if ctx.absolute else None
        arrays = [as_array(tensor) for tensor in (by_means2d, by_splats)]
        with launching():
            for c, (lists, used) in enumerate(zip(ctx.lists, ctx.used, strict=True)):
                by_background += blend_backward(
                    lists,
                    used,
                    (images[0][c], images[1][c], images[2][c]),
                    (by_images[0][c], by_images[1][c], by_images[2][c]),
                    arrays[0][c],
                    arrays[1][c],
                    None if absolute is None else as_array(absolute)[c],
                )
        background_gradient = torch.from_numpy(by_background).to(torch.float32)
        return by_means2d, by_splats, background_gradient, None, None, None, absolute
