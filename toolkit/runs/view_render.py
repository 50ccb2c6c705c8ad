"""Pictures of a run's splat from wherever a viewer stands, and the splat as a file for browsers."""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.runs.view_scene import ViewScene, ViewSplat

Array = NDArray[np.float64]

#: Sides of a picture that a browser may ask for, in pixels.
SMALLEST_SIDE, LARGEST_SIDE = 16, 1600
#: Radius of the scene in the file for browsers: what they round is then small.
PACKED_RADIUS = 10.0
#: Nearest depth that is drawn, as a share of the scene's radius.
NEAR = 1e-3
# Thickness of a disk over its smaller radius, where a viewer knows but ellipsoids.
_THIN = 0.02
_FARTHEST = 1e6


@dataclass(frozen=True, slots=True)
class ViewPose:
    """Where a viewer stands, in the coordinates of :class:`ViewScene`.

    Attributes
    ----------
    position:
        (3,) of the camera's centre.
    rotation:
        (4,) unit quaternion ``wxyz`` of ``world_from_cam`` (x right, y down, z forward).
    focal, principal:
        In pixels of the picture.
    size:
        Width and height in pixels.
    background:
        Red, green and blue behind the splat, 0 to 1.
    """

    position: Array
    rotation: Array
    focal: tuple[float, float]
    principal: tuple[float, float]
    size: tuple[int, int]
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def from_message(cls, message: Mapping[str, Any]) -> ViewPose:
        """Return the pose that a browser asks for.

        Raises
        ------
        DataError
            Where something is missing, not finite or out of its range.
        """
        position = _numbers(message, "position", 3, -_FARTHEST, _FARTHEST)
        rotation = _numbers(message, "rotation", 4, -2, 2)
        length = float(np.linalg.norm(rotation))
        if not 0.5 < length < 2:
            raise DataError("The view's rotation is no quaternion", expected="length 1", found=f"{length:.3g}")
        width, height = (round(side) for side in _numbers(message, "size", 2, SMALLEST_SIDE, LARGEST_SIDE))
        fx, fy = _numbers(message, "focal", 2, 1, 1e6)
        cx, cy = _numbers(message, "principal", 2, -1e5, 1e5)
        red, green, blue = _numbers(message, "background", 3, 0, 1)
        return cls(position, rotation / length, (fx, fy), (cx, cy), (width, height), (red, green, blue))

    def scaled(self, scale: float) -> ViewPose:
        """Return the same view as a picture of ``scale`` times the size, at least one pixel a side."""
        width, height = (max(1, round(scale * side)) for side in self.size)
        x, y = width / self.size[0], height / self.size[1]
        return dataclasses.replace(
            self,
            focal=(x * self.focal[0], y * self.focal[1]),
            principal=(x * self.principal[0], y * self.principal[1]),
            size=(width, height),
        )


def _numbers(message: Mapping[str, Any], name: str, count: int, lowest: float, highest: float) -> Array:
    values = message.get(name)
    sound = isinstance(values, list | tuple) and len(values) == count
    if sound and all(
        isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) and lowest <= v <= highest
        for v in values or ()
    ):
        return np.array(values, dtype=np.float64)
    raise DataError(
        f"The view's {name} cannot be used",
        expected=f"{count} numbers from {lowest:g} to {highest:g}",
        found=repr(values)[:80],
    )


def render_view(splat: ViewSplat, pose: ViewPose) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) by the CPU rasterizer.

    Raises
    ------
    CapabilityError
        As :func:`toolkit.splat.rasterize.rasterize`.
    """
    import torch

    from toolkit.geometry.rigid import RigidTransform
    from toolkit.splat.rasterize import RasterSettings, Views, rasterize

    cam_from_view = RigidTransform.from_quaternion(pose.rotation, pose.position).inverse()
    (fx, fy), (cx, cy), (width, height) = pose.focal, pose.principal, pose.size
    intrinsics = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float32)
    views = Views(torch.from_numpy(cam_from_view.matrix).float()[None], intrinsics[None], width, height)
    settings = RasterSettings(kind=splat.scene.kind, near=NEAR * splat.scene.radius)
    with torch.no_grad():
        output = rasterize(splat.gaussians, views, settings, background=torch.tensor(pose.background))
    image: NDArray[np.uint8] = np.rint(255 * output.colour[0].clamp(0, 1).numpy()).astype(np.uint8)
    return image


def packed_scale(view: ViewScene) -> float:
    """Return by what the lengths of :func:`packed_splat` are larger than the scene's."""
    return PACKED_RADIUS / view.radius


def packed_splat(splat: ViewSplat) -> bytes:
    """Return the splat as the content of an SPZ file, its radius brought to :data:`PACKED_RADIUS`.

    2D Gaussians become ellipsoids that are nearly flat: the format knows nothing else.

    Raises
    ------
    DataError
        Where a Gaussian is farther away than the format can say.
    RunError
        Where the disk for temporary files is full.
    """
    from toolkit.splat.spz import write_spz

    scale, gaussians = packed_scale(splat.scene), splat.gaussians
    log_scales = gaussians.log_scales + math.log(scale)
    if splat.scene.kind == "2d":
        log_scales = log_scales.clone()
        log_scales[:, 2] = log_scales[:, :2].min(dim=1).values + math.log(_THIN)
    sized = dataclasses.replace(gaussians, means=gaussians.means * scale, log_scales=log_scales)
    with tempfile.TemporaryDirectory(prefix="toolkit-view-") as folder:
        file = Path(folder) / "splat.spz"
        write_spz(sized, file)
        return file.read_bytes()
