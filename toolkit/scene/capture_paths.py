"""Where an opened capture reaches: a file in it may name folders anywhere on the machine."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from toolkit.errors import DataError
from toolkit.scene.capture_folders import require_below
from toolkit.scene.dataset import Capture, open_capture


def require_pictures_below(capture: Capture, roots: Sequence[Path]) -> Capture:
    """Return the capture where its pictures, masks and video lie in ``roots``, with all links followed.

    ``scene.json`` may refer to pictures by an absolute path: what a visitor brought could show files of the
    machine.

    Raises
    ------
    DataError
        Where one lies elsewhere; the message names it.
    """
    scene = capture.scene
    paths = [scene.image_dir, *(scene.image_path(frame) for frame in scene.frames)]
    if scene.mask_dir is not None:
        paths.append(scene.mask_dir)
        paths += [path for frame in scene.frames if (path := scene.mask_path(frame)) is not None]
    if capture.video is not None:
        paths.append(capture.video)
    for path in paths:
        try:
            require_below(path, roots)
        except DataError as error:
            raise DataError(
                f"The capture refers to {path.name or path} outside the data folders",
                expected="pictures, masks and video inside",
                found=str(path),
                todo="Copy them into the capture's folder",
            ) from error
    return capture


def require_capture_below(folder: Path, roots: Sequence[Path]) -> Path:
    """Return the folder of a capture that lies, with everything that it refers to, in ``roots``.

    Raises
    ------
    DataError
        Where it does not, or is no capture.
    """
    inside = require_below(folder, roots)
    require_pictures_below(open_capture(inside, check=False), roots)
    return inside
