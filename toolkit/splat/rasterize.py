"""The rasterizer's front door: one call, several backends, the same image.

The image formation is that of 3D Gaussian splatting (Kerbl et al. 2023; Zwicker et al. 2001), with these
conventions, which every backend keeps:

- A Gaussian is drawn where its opacity times its falloff is at least 1/255, alpha is capped at 0.999, and a
  pixel is finished when its transmittance would fall to 1e-4 or below (that last Gaussian is not drawn).
- 0.3 square pixels are added to the diagonal of the projected covariance.
- The perspective Jacobian is evaluated at x/z and y/z clamped to 0.3 half fields of view beyond the image.
- Gaussians with camera depth below ``near`` are not drawn; the others are blended in order of camera depth.
- Colours are spherical harmonics of the direction from camera centre to Gaussian, plus 0.5, cut off at zero.

Kind "2d" is that of Huang et al. 2024: disks, met by the pixels' rays. The second and third rule do not apply to
it; :mod:`toolkit.splat.reference_2d` says what does.

Affine views are those of a camera infinitely far away, as a satellite nearly is: all rays are parallel to the
camera's z axis. A point (x, y, z) in camera coordinates is seen at K2 (x, y) + c, whatever z is (Hartley and
Zisserman, Multiple View Geometry, section 6.3), so the Jacobian is K2 for all and is never clamped. Nothing is
behind such a camera: ``near`` does not apply, and depths are relative to the plane through the camera's origin,
negative on the sensor's side of it. The direction for colours is the z axis in the world, the same for all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from toolkit.errors import CapabilityError, DataError, SettingsError
from toolkit.splat.gaussians import Gaussians

Kind = Literal["3d", "2d"]
BackendName = Literal["reference", "cpu", "cuda"]

ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4
COVARIANCE_BLUR = 0.3
JACOBIAN_MARGIN = 0.3


@dataclass(frozen=True, slots=True)
class Views:
    """C pinhole cameras, or C affine ones, of one image size.

    Attributes
    ----------
    cam_from_world:
        (C, 4, 4) rigid motions. May carry gradients; compose it with :func:`toolkit.splat.lie.exp_se3` to
        optimise the 6-vector ``xi`` in ``cam_from_world <- exp(xi) cam_from_world``.
    intrinsics:
        (C, 3, 3) calibration matrices in pixels, pixel centres at +0.5, no skew. Not differentiated. Of affine
        views: [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] in pixels per scene unit and pixels, to be applied to
        (x, y, 1).
    width, height:
        Image size in pixels.
    affine:
        Whether the cameras are affine: see :mod:`toolkit.splat.rasterize`. Their origins should lie near the
        scene, for float32 must hold the depths.
    """

    cam_from_world: Tensor
    intrinsics: Tensor
    width: int
    height: int
    affine: bool = False

    def __post_init__(self) -> None:
        count = len(self.cam_from_world)
        if self.cam_from_world.shape != (count, 4, 4) or self.intrinsics.shape != (count, 3, 3):
            raise DataError(
                "Views do not fit together",
                expected="(C, 4, 4) and (C, 3, 3)",
                found=f"{tuple(self.cam_from_world.shape)} and {tuple(self.intrinsics.shape)}",
            )
        if self.width < 1 or self.height < 1:
            raise DataError("Views without pixels", found=f"{self.width}x{self.height}")

    def __len__(self) -> int:
        return len(self.cam_from_world)


@dataclass(frozen=True, slots=True)
class RasterSettings:
    """How to draw.

    Attributes
    ----------
    kind:
        ``"3d"`` or ``"2d"`` Gaussians.
    sh_degree:
        Degree up to which spherical harmonics are used; None: all that are stored.
    near:
        Smallest camera depth that is drawn, in scene units; more than zero. Affine views have none.
    backend:
        ``"reference"`` (float32 or float64 PyTorch, slow, readable), ``"cpu"`` (float32 numba) or ``"cuda"``.
    absolute_gradients:
        Whether :meth:`RenderOutput.screen_gradient` sums the gradients of the pixels without their signs (Ye et
        al., AbsGS, 2024). For kind "3d".
    """

    kind: Kind = "3d"
    sh_degree: int | None = None
    near: float = 0.01
    backend: BackendName = "cpu"
    absolute_gradients: bool = False

    def __post_init__(self) -> None:
        if not self.near > 0:
            raise SettingsError("near is out of range", expected="more than 0", found=str(self.near))


@dataclass(frozen=True, slots=True)
class RenderOutput:
    """Images of C views.

    In affine views 0 is a depth like any other, and depths may be negative: there only alpha, which is 0 where
    nothing was drawn, tells whether a pixel has one.

    Attributes
    ----------
    colour:
        (C, H, W, 3), background included; not clamped above 1.
    alpha:
        (C, H, W) one minus the transmittance that is left.
    expected_depth:
        (C, H, W) mean camera depth (z) of what was drawn, weighted by its share; 0 where nothing was drawn. A
        contribution's depth is that of the Gaussian's centre, with kind "2d" that of the ray's intersection.
    median_depth:
        (C, H, W) camera depth of the Gaussian at which the transmittance falls to one half or below, or of the
        last one that was drawn where it never does; 0 where nothing was drawn. No gradient.
    radii:
        (C, N) int32: half size in pixels of the square around the projected centre that can be touched, 0 for
        Gaussians that are not drawn.
    means2d:
        (C, N, 2) projected centres in pixels. Its gradient (``retain_grad``) is that by a shift of the Gaussian's
        whole image, x -> x - shift, with its shape, depths and colour as they are.
    normals:
        (C, H, W, 3) sum of the disks' unit normals times their shares, in camera axes, turned towards the camera;
        not normalised. None for kind "3d".
    distortion:
        (C, H, W) sum over pairs i < j of w_i w_j (z_i - z_j)^2, w the shares and z the camera depths of what was
        drawn, in squared scene units (Huang et al. 2024, equation 13, in the squared form of their supplement:
        intersections are not ordered along the ray; z itself in place of normalised device coordinates). None
        for kind "3d".
    absolute:
        With absolute gradients: a tensor whose gradient they become; None otherwise, and with backend "cuda".
    """

    colour: Tensor
    alpha: Tensor
    expected_depth: Tensor
    median_depth: Tensor
    radii: Tensor
    means2d: Tensor
    normals: Tensor | None = None
    distortion: Tensor | None = None
    absolute: Tensor | None = None

    def screen_gradient(self) -> Tensor | None:
        """Return what density control reads after a backward pass: (C, N, 2), or None where there was none.

        The gradient by the projected centres, if it was retained; with absolute gradients, for both coordinates the
        sum over the pixels of its absolute value, so that pulls to opposite sides do not cancel.
        """
        if self.absolute is not None:
            return self.absolute.grad
        absolute: Tensor | None = getattr(self.means2d, "absgrad", None)  # where gsplat leaves it
        return self.means2d.grad if absolute is None else absolute


def absolute_carrier(means2d: Tensor, settings: RasterSettings) -> Tensor | None:
    """Return zeros like ``means2d`` for a backend to give the absolute gradients to, None where there are none."""
    wanted = settings.absolute_gradients and torch.is_grad_enabled()
    return torch.zeros_like(means2d, requires_grad=True) if wanted else None


Backend = Callable[[Gaussians, Views, RasterSettings, Tensor], RenderOutput]


def rasterize(
    gaussians: Gaussians,
    views: Views,
    settings: RasterSettings | None = None,
    *,
    background: Tensor | None = None,
) -> RenderOutput:
    """Draw Gaussians, with gradients to every parameter, the camera poses and the background.

    Parameters
    ----------
    gaussians:
        N Gaussians; float32, or float64 with the reference backend.
    views:
        C cameras.
    settings:
        How to draw; by default 3D on the CPU.
    background:
        (3,) colour behind everything; black by default.

    Raises
    ------
    CapabilityError
        Where the backend cannot do what settings or views ask. Nothing is substituted.
    DataError
        Where the background is no colour.
    """
    chosen = settings if settings is not None else RasterSettings()
    if chosen.sh_degree is not None and not 0 <= chosen.sh_degree <= gaussians.sh_degree:
        raise CapabilityError(
            "Cannot use that degree of spherical harmonics",
            expected=f"0 to {gaussians.sh_degree}, the degree that is stored",
            found=str(chosen.sh_degree),
        )
    if chosen.absolute_gradients and chosen.kind != "3d":
        raise CapabilityError("Absolute gradients are there for kind '3d' only", found=f"kind '{chosen.kind}'")
    if background is None:
        background = gaussians.means.new_zeros(3)
    if background.shape != (3,):
        raise DataError("background is no colour", expected="shape (3,)", found=f"shape {tuple(background.shape)}")
    return _backend(chosen)(gaussians, views, chosen, background)


def _backend(settings: RasterSettings) -> Backend:
    if settings.backend == "reference":
        if settings.kind == "2d":
            from toolkit.splat.reference_2d import rasterize_reference_2d

            return rasterize_reference_2d
        from toolkit.splat.reference import rasterize_reference

        return rasterize_reference
    if settings.backend == "cpu":
        if settings.kind == "2d":
            from toolkit.splat.cpu.autograd_2d import rasterize_cpu_2d

            return rasterize_cpu_2d
        from toolkit.splat.cpu import rasterize_cpu

        return rasterize_cpu
    if settings.backend == "cuda":
        from toolkit.splat.cuda import rasterize_cuda

        return rasterize_cuda
    raise CapabilityError(f"Backend '{settings.backend}' is not there", expected="'reference', 'cpu' or 'cuda'")
