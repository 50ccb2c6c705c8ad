"""A photo whose pose is asked for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import CapabilityError, DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.scene import Frame, Scene
from toolkit.scene.pictures import load_picture


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """A photo with the camera that took it.

    Attributes
    ----------
    name:
        What it is called in results.
    picture:
        (H, W, 3) uint8.
    camera:
        Of this very size; any of COLMAP's models.
    """

    name: str
    picture: NDArray[np.uint8]
    camera: ColmapCamera

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        if self.picture.shape != (*size, 3) or self.picture.dtype != np.uint8:
            raise DataError(
                f"Photo '{self.name}' does not fit its camera",
                expected=f"{size} pixels of three bytes",
                found=f"{self.picture.shape} {self.picture.dtype}",
                todo="Give the camera of this size (ColmapCamera.scaled)",
            )


def shrunk_query(query: Query, factor: float, *, least_side: int) -> Query:
    """Return a photo whose sides are shorter by ``factor``, averaged by area, with the camera that fits.

    A factor below one changes nothing, and the longer side does not fall below ``least_side`` pixels.
    """
    from toolkit.scene.pictures import area_resize

    longer = max(query.camera.width, query.camera.height)
    scale = max(1.0 / max(factor, 1e-9), min(1.0, least_side / longer))
    if scale >= 1.0:
        return query
    width, height = (max(1, round(scale * side)) for side in (query.camera.width, query.camera.height))
    return Query(query.name, area_resize(query.picture, width, height), query.camera.scaled(width, height))


def query_of(scene: Scene, frame: Frame) -> Query:
    """Return a frame's photo; its pose plays no part.

    Raises
    ------
    DataError
        Where the picture is missing, damaged or of another size than its camera.
    CapabilityError
        For a camera that is none of COLMAP's.
    """
    camera = scene.camera_of(frame)
    if not isinstance(camera, ColmapCamera):
        raise CapabilityError(
            f"Frame '{frame.name}' cannot be localised",
            expected="a camera of COLMAP's",
            found=type(camera).__name__,
        )
    return Query(frame.name, load_picture(scene.image_path(frame)), camera)


def render_camera(camera: ColmapCamera, max_side: int) -> ColmapCamera:
    """Return the pinhole camera from which a map is drawn for a photo of ``camera``.

    It has the photo's focal lengths and principal point, no distortion, and no side above ``max_side`` pixels.
    """
    matrix = camera.intrinsics
    params = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    flat = ColmapCamera("PINHOLE", camera.width, camera.height, params)
    scale = min(1.0, max_side / max(camera.width, camera.height))
    if scale == 1.0:
        return flat
    return flat.scaled(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))


def flat_picture(query: Query, camera: ColmapCamera) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return the photo as the pinhole ``camera`` at the same place would have taken it, and where it shows it.

    Returns
    -------
    picture, shown:
        (H, W, 3) uint8, bilinear after averaging down to the camera's size, and (H, W).
    """
    from scipy.ndimage import map_coordinates

    from toolkit.scene.pictures import area_resize

    small = area_resize(query.picture, camera.width, camera.height)
    scaled = query.camera.scaled(camera.width, camera.height)
    if scaled.is_pinhole and np.allclose(scaled.intrinsics, camera.intrinsics, atol=1e-6):
        return small, np.ones(small.shape[:2], dtype=bool)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    _, rays = camera.ray(np.column_stack([x.ravel(), y.ravel()]))
    at = scaled.project(rays).reshape(*x.shape, 2) - 0.5
    inside = np.isfinite(at) & (at >= 0) & (at <= (camera.width - 1, camera.height - 1))
    shown = np.asarray(inside.all(axis=-1), dtype=bool)
    where = np.nan_to_num(at[..., ::-1]).transpose(2, 0, 1)
    planes = [map_coordinates(small[..., k].astype(np.float32), where, order=1, mode="nearest") for k in range(3)]
    return np.rint(np.stack(planes, axis=-1)).clip(0, 255).astype(np.uint8), shown
