"""One mask for all frames: read, painted by hand, and written as the mask of each frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from toolkit.errors import DataError
from toolkit.files import atomic_path
from toolkit.progress import Progress, silent, track
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene, write_scene
from toolkit.scene.pictures import load_picture

MASK_FILE = "mask.png"
"""Name of the one mask in a scene folder: white is used, black is left out."""

Mask = NDArray[np.bool_]

# Painting programs soften the edge of a brush.
_USED = 128


def read_mask(path: Path, size: tuple[int, int]) -> Mask:
    """Return where a mask leaves pixels out, (H, W) bool.

    Parameters
    ----------
    path:
        A picture; what is darker than mid-grey is left out.
    size:
        Width and height that it must have.

    Raises
    ------
    DataError
        Where it is missing, damaged or of another size, or leaves nothing of the picture.
    """
    picture = load_picture(path)
    if (picture.shape[1], picture.shape[0]) != size:
        raise DataError(
            f"Mask {path} has another size than the pictures",
            expected=f"{size[0]}x{size[1]}",
            found=f"{picture.shape[1]}x{picture.shape[0]}",
            todo="Paint it on one of the pictures, and save it without scaling",
        )
    left_out: Mask = picture.mean(axis=2) < _USED
    require_something_left(left_out, f"Mask {path}")
    return left_out


def require_something_left(left_out: Mask, name: str) -> None:
    """Raise :class:`DataError` where a mask covers the whole picture."""
    if left_out.all():
        raise DataError(
            f"{name} is black everywhere: it leaves nothing of the pictures",
            expected="white where pixels are used, black where they are left out",
            found="no white pixel",
            todo="Invert it if it was painted the other way round, or delete it and make it again",
        )


def write_mask(left_out: Mask, path: Path) -> None:
    """Write a mask, 0 where pixels are left out and 255 elsewhere. Raises :class:`RunError` as disks do."""
    with atomic_path(path) as temporary:
        Image.fromarray(np.where(left_out, np.uint8(0), np.uint8(255))).save(temporary, "PNG")


def with_mask(scene: Scene, left_out: Mask, mask_dir: Path, *, progress: Progress = silent) -> Scene:
    """Return the scene with one mask for all its frames, written as ``<frame name>.png`` each.

    :func:`toolkit.matching.features.extract_sift` and all others that read masks leave the zeros out.

    Parameters
    ----------
    scene:
        Its pictures have the size of the mask.
    left_out:
        (H, W) True where pixels are left out. Where none is, no mask is written and the scene has none.
    mask_dir:
        Folder of the masks; those of frames that are there are replaced.
    progress:
        Told after each mask.

    Raises
    ------
    DataError
        Where the mask leaves nothing, or a camera has another size.
    RunError
        Where the disk is full or may not be written.
    """
    require_something_left(left_out, "The mask")
    for frame in scene.frames:
        camera = scene.camera_of(frame)
        if (camera.height, camera.width) != left_out.shape:
            raise DataError(
                f"The mask has another size than frame '{frame.name}'",
                expected=f"{camera.width}x{camera.height}",
                found=f"{left_out.shape[1]}x{left_out.shape[0]}",
            )
    if not left_out.any():
        return scene.replace(mask_dir=None)
    for frame in track(scene.frames, "masks", progress):
        write_mask(left_out, mask_dir / f"{frame.name}.png")
    return scene.replace(mask_dir=mask_dir)


def apply_mask(folder: Path, mask: Path | None = None, *, progress: Progress = silent) -> Scene:
    """Give all frames of a scene folder the mask that a person painted.

    Parameters
    ----------
    folder:
        Of the scene. The mask becomes its ``mask.png`` and the masks of its frames; nothing else is changed.
    mask:
        A picture of the frames' size, black where they are left out; None takes ``mask.png`` of the folder.
    progress:
        Told after each mask.

    Raises
    ------
    DataError
        Where the folder is no scene or has no frames or frames of several sizes, or the mask is missing, of another
        size, or black everywhere.
    RunError
        Where the disk is full or may not be written.
    """
    scene = read_scene(folder)
    sizes = {(scene.camera_of(frame).width, scene.camera_of(frame).height) for frame in scene.frames}
    if len(sizes) != 1:
        raise DataError(
            f"One mask does not fit the frames of {folder}",
            expected="frames of one size",
            found=f"{len(sizes)} sizes" if sizes else "no frames",
        )
    left_out = read_mask(mask or folder / MASK_FILE, sizes.pop())
    masked = with_mask(scene, left_out, folder / "masks", progress=progress)
    write_mask(left_out, folder / MASK_FILE)
    # Its poses and points are not written again where only the masks' content changes.
    if masked.mask_dir != scene.mask_dir:
        write_scene(masked, folder)
    return masked
