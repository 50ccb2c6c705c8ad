"""The pictures, masks and sparse model of a dense folder, made from a scene."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from toolkit.depth.dense_folder import DenseFolder, frame_size, require_pinhole
from toolkit.depth.monocular import load_checked_picture
from toolkit.depth.view_choice import with_tracks
from toolkit.files import atomic_path, disk_errors
from toolkit.geometry.cameras import ColmapCamera
from toolkit.progress import Progress, silent, track
from toolkit.scene import Frame, Scene, Tracks
from toolkit.scene.colmap import write_colmap
from toolkit.scene.pictures import area_resize, load_mask

_QUALITY = 97


def make_dense_folder(scene: Scene, root: Path, longest: int, *, progress: Progress = silent) -> DenseFolder:
    """Write pictures, masks and the sparse model of the registered frames; pictures that are there stay.

    Parameters
    ----------
    scene:
        With poses and PINHOLE or SIMPLE_PINHOLE cameras.
    root:
        Folder to be made.
    longest:
        Pictures with a longer side, in pixels, are made smaller by area, cameras and observations with them.

    Raises
    ------
    CapabilityError
        Where a camera has distortion.
    DataError
        Where a picture or a mask cannot be read or has not the size of its camera.
    RunError
        When the disk is full or may not be written.
    """
    require_pinhole(scene)
    dense = DenseFolder(root)
    small = scaled_scene(with_tracks(scene), longest).replace(image_dir=root / "images")
    for frame in track(scene.registered, "stereo.pictures", progress):
        _write_picture(scene, frame, longest, root / "images" / frame.name)
        mask = load_mask(scene, frame)
        if mask is not None:
            width, height = frame_size(scene, frame, longest)
            whole = area_resize(mask.astype(np.float32), width, height) > 1 - 1e-6
            _save(whole.astype(np.uint8) * 255, root / "masks" / f"{frame.name}.png")
    write_colmap(small, root / "sparse")
    with disk_errors(root, "making folders in"):
        for kind in ("depth_maps", "normal_maps", "consistency_graphs"):
            (dense.stereo / kind).mkdir(parents=True, exist_ok=True)
    return dense


def scaled_scene(scene: Scene, longest: int) -> Scene:
    """Return the registered frames with the cameras of pictures whose longest side is at most ``longest``."""
    frames = scene.registered
    cameras = {}
    scale = {}
    for frame in frames:
        camera = scene.camera_of(frame)
        assert isinstance(camera, ColmapCamera)
        size = frame_size(scene, frame, longest)
        cameras[frame.camera_id] = camera.scaled(*size)
        scale[frame.camera_id] = (size[0] / camera.width, size[1] / camera.height)
    points = scene.points
    if points is not None and points.tracks is not None:
        place = {frame.name: number for number, frame in enumerate(frames)}
        index = np.array([place.get(frame.name, -1) for frame in scene.frames], dtype=np.int64)
        factor = np.array([scale.get(frame.camera_id, (1.0, 1.0)) for frame in scene.frames])
        tracks = points.tracks
        kept = index[tracks.frame] >= 0
        points = dataclasses.replace(
            points,
            tracks=Tracks(
                tracks.point[kept],
                index[tracks.frame[kept]],
                tracks.pixel[kept] * factor[tracks.frame[kept]],
            ),
        )
    return scene.replace(cameras=cameras, frames=frames, points=points)


def _write_picture(scene: Scene, frame: Frame, longest: int, target: Path) -> None:
    picture = load_checked_picture(scene, frame)
    if target.is_file():
        return
    size = frame_size(scene, frame, longest)
    if size == picture.shape[1::-1]:
        with atomic_path(target) as temporary:
            shutil.copyfile(scene.image_path(frame), temporary)
    else:
        _save(area_resize(picture, *size), target)


def _save(picture: NDArray[np.uint8], target: Path) -> None:
    lossy = target.suffix.lower() in (".jpg", ".jpeg")
    with atomic_path(target) as temporary:
        if lossy:
            Image.fromarray(picture).save(temporary, quality=_QUALITY, subsampling=0)
        else:
            Image.fromarray(picture).save(temporary)
