"""Terms that hold 2D Gaussians to surfaces (Huang et al., 2D Gaussian Splatting, 2024, section 5)."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from toolkit.errors import DataError
from toolkit.splat.rasterize import RenderOutput, Views


def normals_from_depth(
    depth: Tensor, intrinsics: Tensor, *, there: Tensor | None = None, affine: bool = False
) -> Tensor:
    """Return the normals of the surface that a depth map shows, by finite differences of its points.

    Differences are central, and to the one neighbour there is at the image's edges (the paper, equation 15).

    Parameters
    ----------
    depth:
        (H, W) camera depths (z), both sides at least 2.
    intrinsics:
        (3, 3) calibration matrix in pixels, pixel centres at +0.5, as in :class:`toolkit.splat.rasterize.Views`.
    there:
        (H, W) bool, which pixels show a surface; by default those with a depth above 0, which affine views do not
        keep to.
    affine:
        Whether the camera is affine, so that pixels' rays are parallel.

    Returns
    -------
    Tensor
        (H, W, 3) unit normals in camera axes, turned towards the camera; zero where a point that is needed has no
        depth. Differentiable by the depth.

    Raises
    ------
    DataError
        Where the shapes are not these.
    """
    if depth.ndim != 2 or min(depth.shape) < 2 or intrinsics.shape != (3, 3):
        raise DataError(
            "Normals need a depth map and a calibration matrix",
            expected="(H, W), both at least 2, and (3, 3)",
            found=f"{tuple(depth.shape)} and {tuple(intrinsics.shape)}",
        )
    height, width = depth.shape
    matrix = intrinsics.to(depth)
    ys = ((torch.arange(height, dtype=depth.dtype, device=depth.device) + 0.5 - matrix[1, 2]) / matrix[1, 1])[
        :, None
    ]
    xs = torch.arange(width, dtype=depth.dtype, device=depth.device) + 0.5 - matrix[0, 2]
    xs = (xs - matrix[0, 1] * ys) / matrix[0, 0]
    scale = torch.ones_like(depth) if affine else depth
    points = torch.stack([scale * xs, scale * ys, depth], dim=-1)
    left, right = _neighbours(width, depth.device)
    above, below = _neighbours(height, depth.device)
    along_x = points[:, right] - points[:, left]
    along_y = points[below] - points[above]
    # x points right and y down: the cross product in this order points back to the camera.
    across = torch.linalg.cross(along_y, along_x)
    there = depth > 0 if there is None else there
    known = there & there[:, left] & there[:, right] & there[above] & there[below]
    known = known & (across.detach().square().sum(-1) > 0)
    # The gradient of a length is not finite at zero: unknown normals must not get there.
    safe = torch.where(known[..., None], across, torch.ones_like(across))
    return torch.where(known[..., None], safe / safe.norm(dim=-1, keepdim=True), torch.zeros_like(across))


def _neighbours(length: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the indices of the pixels before and after each one, its own at either end."""
    index = torch.arange(length, device=device)
    return (index - 1).clamp(min=0), (index + 1).clamp(max=length - 1)


def normal_consistency(
    output: RenderOutput, views: Views, depth: Literal["expected", "median"] = "expected"
) -> Tensor:
    """Return the mean over pixels of sum_i w_i (1 - n_i . N), N the normal of the drawn depth (equation 14).

    Parameters
    ----------
    output:
        What was drawn of ``views`` with kind "2d".
    views:
        C cameras.
    depth:
        Which depth N is taken from; ``"median"`` has no gradient, so that only the disks turn.

    Returns
    -------
    Tensor
        Scalar, 0 to 2. Pixels where N is not known count as 0.

    Raises
    ------
    DataError
        Where there are no normals, as with kind "3d".
    """
    if output.normals is None:
        raise _no_disks("normals")
    depths = output.expected_depth if depth == "expected" else output.median_depth
    surface = torch.stack(
        [
            normals_from_depth(image, matrix, there=alpha > 0, affine=views.affine)
            for image, matrix, alpha in zip(depths, views.intrinsics, output.alpha.detach(), strict=True)
        ]
    )
    known = (surface != 0).any(-1)
    differences = output.alpha - (output.normals * surface).sum(-1)
    return torch.where(known, differences, torch.zeros_like(differences)).mean()


def depth_distortion(output: RenderOutput) -> Tensor:
    """Return the mean over pixels of the depth distortion, in squared scene units (equation 13).

    See :class:`toolkit.splat.rasterize.RenderOutput` for its definition.

    Raises
    ------
    DataError
        Where there is no distortion, as with kind "3d".
    """
    if output.distortion is None:
        raise _no_disks("distortion")
    return output.distortion.mean()


def _no_disks(what: str) -> DataError:
    return DataError(
        f"The drawn images have no {what}",
        expected="images of 2D Gaussians",
        found="images of 3D Gaussians",
        todo="Draw with RasterSettings(kind='2d').",
    )
