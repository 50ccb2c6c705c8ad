"""A splat as a map: what it shows from a pose, how deep that is, and which of it can be relied on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.errors import CapabilityError, DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.settings import ReliabilitySettings
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.images import views_of
from toolkit.splat.rasterize import BackendName, Kind, RasterSettings, RenderOutput, rasterize

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Spreads up to this many times the picture's median one are usual.
_USUAL = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class MapView:
    """What a map shows from one pose.

    Attributes
    ----------
    camera, cam_from_world:
        A pinhole camera and its pose in the map's world.
    colour:
        (H, W, 3) uint8.
    depth:
        (H, W) float32 median camera depth in scene units, 0 where nothing is.
    reliable:
        (H, W) which pixels may be back-projected.
    """

    camera: ColmapCamera
    cam_from_world: RigidTransform
    colour: NDArray[np.uint8]
    depth: NDArray[np.float32]
    reliable: Mask

    def points(self, pixels: Array, *, all_depths: bool = False) -> tuple[Array, Mask]:
        """Return the world points (N, 3) seen at pixels (N, 2), and (N,) which of them are reliable.

        Parameters
        ----------
        pixels:
            Pixel centres at +0.5.
        all_depths:
            Take every pixel with a depth for reliable, as the paper does (section 3.2), and its depth as it is.
            Else depth is interpolated between the four pixels around, where all of them are reliable.
        """
        height, width = self.depth.shape
        inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
        column, row = (np.clip(pixels[:, k].astype(int), 0, size - 1) for k, size in ((0, width), (1, height)))
        depth = self.depth[row, column].astype(np.float64)
        good = inside & (depth > 0)
        if not all_depths:
            good &= self.reliable[row, column]
            depth = self._between(pixels, depth)
        _, directions = self.camera.ray(pixels)
        in_camera = directions * (depth / directions[:, 2])[:, None]
        return self.cam_from_world.inverse().apply(in_camera), good

    def _between(self, pixels: Array, nearest: Array) -> Array:
        """Return depth (N,) between pixel centres where the four around are reliable, ``nearest`` elsewhere."""
        height, width = self.depth.shape
        corner = np.clip(np.floor(pixels - 0.5).astype(int), 0, (max(width - 2, 0), max(height - 2, 0)))
        part = np.clip(pixels - 0.5 - corner, 0.0, 1.0)
        right, below = (np.minimum(corner[:, k] + 1, size - 1) for k, size in ((0, width), (1, height)))
        four = [(corner[:, 1], corner[:, 0]), (corner[:, 1], right), (below, corner[:, 0]), (below, right)]
        shares = [
            (1 - part[:, 0]) * (1 - part[:, 1]),
            part[:, 0] * (1 - part[:, 1]),
            (1 - part[:, 0]) * part[:, 1],
            part[:, 0] * part[:, 1],
        ]
        mixed = sum(share * self.depth[at].astype(np.float64) for share, at in zip(shares, four, strict=True))
        whole = np.logical_and.reduce([self.reliable[at] for at in four])
        return np.where(whole, mixed, nearest)


@dataclass(frozen=True, slots=True, eq=False)
class SplatMap:
    """Gaussians in a world of which poses are asked.

    Attributes
    ----------
    gaussians:
        In scene units, metres for georeferenced maps. float32: the world's origin must lie near them.
    kind:
        ``"2d"`` disks or ``"3d"`` ellipsoids.
    background:
        Red, green and blue behind them, 0 to 1.
    backend:
        Rasterizer.
    """

    gaussians: Gaussians
    kind: Kind = "2d"
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    backend: BackendName = "cpu"

    def __post_init__(self) -> None:
        if len(self.gaussians) == 0:
            raise DataError("The map is empty", expected="Gaussians", found="none", todo="Train the map first")

    @property
    def raster(self) -> RasterSettings:
        """How it is drawn."""
        return RasterSettings(kind=self.kind, backend=self.backend)

    @torch.no_grad()
    def detail(self) -> float:
        """Return the size of the map's small Gaussians in scene units.

        The lower quartile of their standard deviations (the geometric mean of the two larger ones), of those that
        are more opaque than not, or of all where none is.
        """
        opaque = torch.sigmoid(self.gaussians.opacity_logits) > 0.5
        scales = self.gaussians.log_scales[opaque] if bool(opaque.any()) else self.gaussians.log_scales
        axes = scales[:, :2] if self.kind == "2d" else scales.topk(2, dim=1).values
        return float(np.quantile(axes.mean(dim=1).exp().cpu().numpy(), 0.25))

    @torch.no_grad()
    def render(
        self, camera: ColmapCamera, cam_from_world: RigidTransform, reliable: ReliabilitySettings
    ) -> MapView:
        """Draw colour and depth from a pose.

        Raises
        ------
        CapabilityError
            For a camera that is no pinhole; take :func:`toolkit.localize.query.render_camera`.
        """
        if not camera.is_pinhole:
            raise CapabilityError(
                "The map is drawn by pinhole cameras", expected="PINHOLE or SIMPLE_PINHOLE", found=camera.model
            )
        device = self.gaussians.means.device
        matrix = torch.tensor(cam_from_world.matrix, dtype=torch.float32, device=device)[None]
        output = rasterize(
            self.gaussians,
            views_of(camera, matrix),
            self.raster,
            background=self.gaussians.means.new_tensor(self.background),
        )
        colour = np.rint(output.colour[0].clamp(0, 1).cpu().numpy() * 255).astype(np.uint8)
        depth = output.median_depth[0].cpu().numpy()
        return MapView(camera, cam_from_world, colour, depth, _reliable(output, camera, reliable))


def _reliable(output: RenderOutput, camera: ColmapCamera, settings: ReliabilitySettings) -> Mask:
    """Return which pixels (H, W) show one surface, and not too slantingly."""
    alpha, median = (values[0].cpu().numpy().astype(np.float64) for values in (output.alpha, output.median_depth))
    drawn = (alpha >= settings.min_alpha) & (median > 0)
    deep = np.where(drawn, median, np.inf)
    if output.distortion is None:
        spread = np.abs(output.expected_depth[0].cpu().numpy() - median)
    else:
        # The distortion is the variance of the depths along the ray times the square of the alpha.
        spread = np.sqrt(np.maximum(output.distortion[0].cpu().numpy(), 0.0)) / np.maximum(alpha, 1e-6)
    # A faint Gaussian right before the camera spreads all depths alike: then what is usual is no reason for doubt.
    usual = _USUAL * float(np.median(spread[drawn])) if drawn.any() else 0.0
    good: Mask = drawn & (spread <= np.maximum(settings.max_spread * deep, usual))
    good &= _step(median) <= settings.max_step * deep
    if output.normals is not None:
        normals = output.normals[0].cpu().numpy().astype(np.float64)
        good &= _cosine(normals, camera) >= np.cos(np.radians(settings.max_slant))
    return good


def _step(depth: NDArray[np.floating]) -> Array:
    """Return the largest difference (H, W) of each pixel's depth to its eight neighbours."""
    from scipy.ndimage import maximum_filter, minimum_filter

    higher, lower = (f(depth, size=3, mode="nearest") for f in (maximum_filter, minimum_filter))
    return np.asarray(np.maximum(higher - depth, depth - lower), dtype=np.float64)


def _cosine(normals: Array, camera: ColmapCamera) -> Array:
    """Return the cosine (H, W) of the angle between normals (H, W, 3), turned to the camera, and the rays."""
    height, width = normals.shape[:2]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    matrix = camera.intrinsics
    rays = np.stack(
        [(x - matrix[0, 2]) / matrix[0, 0], (y - matrix[1, 2]) / matrix[1, 1], np.ones_like(x)], axis=-1
    )
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    lengths = np.maximum(np.linalg.norm(normals, axis=-1), 1e-9)
    return np.asarray(-(normals * rays).sum(axis=-1) / lengths)
