"""A localised photo beside what the map shows from its pose."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import CapabilityError, DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.query import Query, flat_picture, query_of, render_camera
from toolkit.localize.settings import ReliabilitySettings
from toolkit.runs.photo_results import MatchLines, StoredPose
from toolkit.scene import Scene
from toolkit.scene.pictures import load_picture

if TYPE_CHECKING:  # PyTorch comes with the first map that is opened.
    from toolkit.localize.splat_map import SplatMap

Array = NDArray[np.float64]

#: Longer side of the pictures, in pixels.
SIDE = 960


@dataclass(frozen=True, slots=True, eq=False)
class PosePictures:
    """Pictures of one size, without distortion.

    Attributes
    ----------
    photo, render:
        (H, W, 3) uint8; the render is from the pose that was found, or else from where the last round or the
        search began.
    reliable:
        (H, W) which pixels of the render may be back-projected.
    photo_pixels, render_pixels:
        (M, 2) of matches, and ``inside`` (M,) which of them agree with the pose; (0, 2) where none are known.
    camera:
        That took the photo, in its full size.
    file:
        Of the photo.
    distance:
        Median depth of what the render shows, in scene units.
    truth:
        The pose that the scene has for the photo, or None.
    metric:
        Whether the scene's unit is the metre: it is georeferenced.
    """

    photo: NDArray[np.uint8]
    render: NDArray[np.uint8]
    reliable: NDArray[np.bool_]
    photo_pixels: Array
    render_pixels: Array
    inside: NDArray[np.bool_]
    camera: ColmapCamera
    file: Path
    distance: float
    truth: RigidTransform | None
    metric: bool


def pose_pictures(splat_map: SplatMap, scene: Scene, stored: StoredPose, *, side: int = SIDE) -> PosePictures:
    """Return a photo and what the map shows of it.

    Parameters
    ----------
    scene:
        Of the run: cameras and pictures of its frames.
    side:
        Longer side of the pictures at most, in pixels.

    Raises
    ------
    DataError
        Where the photo is gone or damaged, its frame is not in the scene, or nothing is known from where it might
        have been taken.
    CapabilityError
        For a frame whose camera is none of COLMAP's.
    """
    pose = stored.cam_from_world
    if pose is None:
        pose = stored.lines.rendered_from if stored.lines is not None else stored.start
    if pose is None:
        raise DataError(f"Nothing is known of where '{stored.name}' was looked for", expected="a pose or a start")
    query, full, file, truth = _photo(scene, stored)
    camera = render_camera(query.camera, side)
    photo, _ = flat_picture(query, camera)
    view = splat_map.render(camera, pose, ReliabilitySettings())
    seen, shown, inside = _pixels(stored.lines, full, camera, pose)
    deep = view.depth[view.depth > 0]
    distance = float(np.median(deep)) if deep.size else 1.0
    metric = scene.georeference is not None
    return PosePictures(photo, view.colour, view.reliable, seen, shown, inside, full, file, distance, truth, metric)


def _photo(scene: Scene, stored: StoredPose) -> tuple[Query, ColmapCamera, Path, RigidTransform | None]:
    """Return the photo as it is kept, the camera of its full size, its file, and its true pose."""
    if stored.picture is not None and stored.camera is not None:
        picture = load_picture(stored.picture)
        small = stored.camera.scaled(picture.shape[1], picture.shape[0])
        return Query(stored.name, picture, small), stored.camera, stored.picture, None
    frame = scene.frame(stored.name)
    camera = scene.camera_of(frame)
    if not isinstance(camera, ColmapCamera):
        raise CapabilityError(
            f"Frame '{frame.name}' cannot be drawn", expected="a camera of COLMAP's", found=type(camera).__name__
        )
    return query_of(scene, frame), camera, scene.image_path(frame), frame.cam_from_world


def _pixels(
    lines: MatchLines | None, full: ColmapCamera, camera: ColmapCamera, pose: RigidTransform
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return the matches' pixels in the flat photo and in the render, those that lie in both, and their flags."""
    if lines is None or not len(lines.inside):
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, dtype=np.bool_)
    _, rays = full.ray(lines.pixels)
    pairs = [camera.project(rays), camera.project(pose.apply(lines.points))]
    size = (camera.width, camera.height)
    inside = [np.isfinite(pixels).all(axis=1) & ((pixels >= 0) & (pixels <= size)).all(axis=1) for pixels in pairs]
    good = inside[0] & inside[1]
    return pairs[0][good], pairs[1][good], lines.inside[good]
