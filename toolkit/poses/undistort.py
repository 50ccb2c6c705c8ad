"""Taking lens distortion out of pictures, so that a pinhole camera describes them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image

from toolkit.errors import DataError
from toolkit.files import atomic_path
from toolkit.geometry.cameras import Camera, ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.resample import pinhole_for, resampled
from toolkit.progress import Progress, silent, track
from toolkit.scene import Frame, Scene, Tracks
from toolkit.scene.colmap import colmap_camera
from toolkit.scene.pictures import load_picture

# A JPEG is written again at this quality and without colour subsampling: the second compression costs little.
_JPEG_QUALITY = 97
# A mask pixel that is at least this much inside stays inside after resampling.
_MASK_INSIDE = 128


def undistort(scene: Scene, folder: Path, *, progress: Progress = silent) -> Scene:
    """Return the scene's registered frames with pinhole cameras; pictures are rewritten into ``folder``.

    Each camera gets the pinhole camera that COLMAP chooses: as much of the picture as fits without blank pixels; so
    does any other camera whose rays meet in its centre (:mod:`toolkit.poses.resample`). Pictures keep their names
    and formats, observations in tracks are moved along, masks are resampled too. A scene whose cameras have no
    distortion is returned as it is, and nothing is written.

    Parameters
    ----------
    scene:
        With poses.
    folder:
        New folder; ``images/`` and, where the scene has masks, ``masks/`` are made in it.
    progress:
        Told of each picture.

    Raises
    ------
    DataError
        Where a picture cannot be read or has not the size that its camera says.
    CapabilityError
        Where a camera's rays do not meet in one point, or it sees more than a pinhole camera can.
    """
    used = {frame.camera_id for frame in scene.registered}
    distorted = {number: scene.cameras[number] for number in sorted(used)}
    if all(isinstance(camera, ColmapCamera) and camera.is_pinhole for camera in distorted.values()):
        return scene
    flat = {number: _flat_camera(scene, number) for number in distorted}
    images, masks = folder / "images", folder / "masks"
    for frame in track(scene.registered, "undistort", progress):
        camera, target = distorted[frame.camera_id], images / frame.name
        picture = _checked(load_picture(scene.image_path(frame)), scene.image_path(frame), camera)
        _write(_undistorted(picture, camera, flat[frame.camera_id]), target)
        mask = scene.mask_path(frame)
        if mask is not None:
            grey = np.ascontiguousarray(_checked(load_picture(mask), mask, camera)[:, :, 0])
            inside = _undistorted(grey, camera, flat[frame.camera_id]) >= _MASK_INSIDE
            _write(inside.astype(np.uint8) * 255, masks / f"{frame.name}.png")
    return _with_cameras(scene, distorted, flat, images, masks if scene.mask_dir is not None else None)


def flatten(scene: Scene, folder: Path, *, progress: Progress = silent) -> Scene:
    """Return all frames with pinhole cameras, no poses and no points; pictures are rewritten into ``folder``.

    As :func:`undistort`, which see, for pictures whose intrinsics are known and whose poses are not.
    """
    bare = scene.without_poses()
    # Undistortion takes the frames that have a pose; which one does not matter to it.
    placed = tuple(dataclasses.replace(frame, cam_from_world=RigidTransform.identity()) for frame in bare.frames)
    return undistort(bare.replace(frames=placed), folder, progress=progress).without_poses()


def _flat_camera(scene: Scene, number: int) -> ColmapCamera:
    if not isinstance(scene.cameras[number], ColmapCamera):
        return pinhole_for(scene.cameras[number], f"camera {number}")
    camera = colmap_camera(scene, number).to_pycolmap()
    return ColmapCamera.from_pycolmap(pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera))


def _checked(picture: NDArray[np.uint8], path: Path, camera: Camera) -> NDArray[np.uint8]:
    height, width = picture.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise DataError(
            f"{path} has not the size of its camera",
            expected=f"{camera.width}x{camera.height} pixels",
            found=f"{width}x{height}",
            todo="Give each picture size a camera of its own, or resample the picture",
        )
    return picture


def _undistorted(picture: NDArray[np.uint8], camera: Camera, flat: ColmapCamera) -> NDArray[np.uint8]:
    if not isinstance(camera, ColmapCamera):
        return resampled(picture, camera, flat)
    options = pycolmap.UndistortCameraOptions()
    bitmap, _ = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(picture), camera.to_pycolmap())
    array: NDArray[np.uint8] = bitmap.to_array()
    return array


def _write(picture: NDArray[np.uint8], path: Path) -> None:
    """Write a picture in the format of its ending; JPEG with little loss, the others without any."""
    lossy: dict[str, Any] = (
        {"quality": _JPEG_QUALITY, "subsampling": 0} if path.suffix.lower() in (".jpg", ".jpeg") else {}
    )
    with atomic_path(path) as temporary:
        Image.fromarray(picture).save(temporary, **lossy)


def _with_cameras(
    scene: Scene,
    distorted: Mapping[int, Camera],
    flat: Mapping[int, ColmapCamera],
    images: Path,
    masks: Path | None,
) -> Scene:
    """Return the registered frames with other cameras, observations moved to where these see them."""
    frames: list[Frame] = list(scene.registered)
    points = scene.points
    if points is not None and points.tracks is not None:
        place = {frame.name: number for number, frame in enumerate(frames)}
        new_index = np.array([place.get(frame.name, -1) for frame in scene.frames], dtype=np.int64)
        tracks = points.tracks
        kept = new_index[tracks.frame] >= 0
        camera_ids = np.array([frame.camera_id for frame in scene.frames])[tracks.frame]
        pixel = tracks.pixel.copy()
        for number, camera in distorted.items():
            rows = kept & (camera_ids == number)
            pixel[rows] = flat[number].project(camera.ray(pixel[rows])[1])
        kept &= np.isfinite(pixel).all(axis=1)
        moved = Tracks(tracks.point[kept], new_index[tracks.frame[kept]], pixel[kept])
        points = dataclasses.replace(points, tracks=moved)
    return scene.replace(image_dir=images, mask_dir=masks, cameras=dict(flat), frames=tuple(frames), points=points)
