"""COLMAP's dense workspace: undistorted pictures, a sparse model, depth and normal maps in its own format.

``images/``, ``sparse/`` and ``stereo/{depth_maps,normal_maps}/<picture>.{photometric,geometric}.bin`` with
``patch-match.cfg`` and ``fusion.cfg`` are COLMAP's: its GUI and its fusion open the folder, and what reads sparse
models (nerfstudio, Meshlab) does too. ``masks/`` and ``stereo/confidence_maps/`` are additions that COLMAP ignores.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, overload

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import CapabilityError, DataError
from toolkit.files import atomic_path, disk_errors, write_text
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.surface import DepthView
from toolkit.scene import Frame, Scene
from toolkit.scene.colmap import read_colmap
from toolkit.scene.pictures import load_picture

Image = NDArray[np.float32]
Stage = Literal["photometric", "searched", "geometric"]

_HEADER = re.compile(rb"(\d{1,7})&(\d{1,7})&(\d{1,3})&")
_LONGEST_HEADER = 24
_CONFIDENCE = "confidence_maps"


def write_map(path: Path, values: Image) -> None:
    """Write a map (height, width) or (height, width, channels) in COLMAP's format, whole or not at all.

    That is ``width&height&channels&`` in ASCII, then float32 in little-endian order, one channel after the other.

    Raises
    ------
    DataError
        Where it is no such array or has no pixels.
    RunError
        When the disk is full or may not be written.
    """
    if values.ndim not in (2, 3) or 0 in values.shape:
        raise DataError(
            f"What is to be written to {path} is no map",
            expected="(height, width) or (height, width, channels)",
            found=str(values.shape),
        )
    planes = values[:, :, None] if values.ndim == 2 else values
    height, width, channels = planes.shape
    with atomic_path(path) as temporary:
        data = np.ascontiguousarray(planes.transpose(2, 0, 1), dtype="<f4")
        temporary.write_bytes(f"{width}&{height}&{channels}&".encode() + data.tobytes())


def read_map(path: Path, *, channels: int = 1, size: tuple[int, int] | None = None) -> Image:
    """Return a map of COLMAP's format: (height, width), or (height, width, channels) where there are several.

    Parameters
    ----------
    channels:
        How many it must have.
    size:
        Width and height that it must have, or None.

    Raises
    ------
    DataError
        Where the file is missing, its header lies, it is cut off or too long, or holds NaN or infinity.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"Cannot read the map {path}", found=str(error), todo="Compute it again") from error
    header = _HEADER.match(data[:_LONGEST_HEADER])
    if header is None:
        raise DataError(
            f"{path} is no map of COLMAP's",
            expected="a header width&height&channels&",
            found=repr(data[:_LONGEST_HEADER]),
        )
    width, height, found = (int(number) for number in header.groups())
    if found != channels or (size is not None and (width, height) != size) or 0 in (width, height):
        wanted = f"{size[0]}x{size[1]}" if size is not None else "any size"
        raise DataError(
            f"The map {path} is not of the size that it should be",
            expected=f"{wanted} with {channels} channel(s)",
            found=f"{width}x{height} with {found}",
            todo="Compute it again at the size of the pictures in this folder",
        )
    expected = header.end() + 4 * width * height * channels
    if len(data) != expected:
        raise DataError(
            f"The map {path} is {'cut off' if len(data) < expected else 'too long'}",
            expected=f"{expected} bytes, as its header says",
            found=str(len(data)),
            todo="Compute it again",
        )
    planes = np.frombuffer(data, "<f4", offset=header.end()).reshape(channels, height, width)
    if not np.isfinite(planes).all():
        bad = int((~np.isfinite(planes)).sum())
        raise DataError(f"The map {path} is not finite", expected="numbers", found=f"{bad} NaN or infinite values")
    values: Image = planes.transpose(1, 2, 0).astype(np.float32)
    return values[:, :, 0] if channels == 1 else values


@dataclass(frozen=True)
class DenseFolder:
    """A dense workspace of COLMAP's, with the paths in it.

    Attributes
    ----------
    root:
        The folder that holds ``images``, ``sparse`` and ``stereo``.
    """

    root: Path

    @cached_property
    def scene(self) -> Scene:
        """Pictures, PINHOLE cameras, poses and points.

        Raises
        ------
        DataError
            Where the model is missing or damaged.
        CapabilityError
            Where a camera has distortion.
        """
        read = read_colmap(self.root / "sparse", self.root / "images")
        masks = self.root / "masks"
        require_pinhole(read)
        return read.replace(mask_dir=masks if masks.is_dir() else None)

    @property
    def stereo(self) -> Path:
        """Folder of the maps."""
        return self.root / "stereo"

    def path(self, kind: str, name: str, stage: Stage = "geometric") -> Path:
        """Return where a map of a picture lies; ``kind`` is depth, normal or confidence."""
        return self.stereo / f"{kind}_maps" / f"{name}.{stage}.bin"

    def has(self, name: str, stage: Stage = "geometric") -> bool:
        """Whether all maps of a picture are there; they are written in one step each, the depth last."""
        return self.path("depth", name, stage).is_file()

    def write(
        self, name: str, depth: Image, normals: Image, extra: Image | None, stage: Stage = "geometric"
    ) -> None:
        """Write depth (height, width), normals (height, width, 3), confidence and what else is known."""
        if extra is not None:
            write_map(self.path("confidence", name, stage), extra)
        write_map(self.path("normal", name, stage), normals)
        write_map(self.path("depth", name, stage), depth)

    def remove(self, name: str, stage: Stage) -> None:
        """Delete the maps of a picture."""
        with disk_errors(self.stereo, "deleting maps in"):
            for kind in ("depth", "normal", "confidence"):
                self.path(kind, name, stage).unlink(missing_ok=True)

    def depth(self, name: str, stage: Stage = "geometric") -> Image:
        """Return a picture's depth (height, width), 0 where it is not known."""
        depth = read_map(self.path("depth", name, stage), size=self._size(name))
        if np.any(depth < 0):
            raise DataError(f"{self.path('depth', name, stage)} has depths below 0", expected="depths, 0 for none")
        return depth

    def normals(self, name: str, stage: Stage = "geometric") -> Image:
        """Return a picture's normals (height, width, 3) in the camera's frame."""
        return read_map(self.path("normal", name, stage), channels=3, size=self._size(name))

    def extra(self, name: str, channels: int = 1, stage: Stage = "geometric") -> Image | None:
        """Return a picture's confidence, or None where none was written."""
        path = self.path("confidence", name, stage)
        return read_map(path, channels=channels, size=self._size(name)) if path.is_file() else None

    def view(self, name: str) -> DepthView:
        """Return picture, camera and final maps of a frame.

        Raises
        ------
        DataError
            Where the frame is not in the model, or a map is missing, damaged or of the wrong size.
        """
        frame = self.scene.frame(name)
        camera = self.scene.camera_of(frame)
        assert isinstance(camera, ColmapCamera)
        assert frame.cam_from_world is not None
        return DepthView(
            name,
            camera,
            frame.cam_from_world,
            self.depth(name),
            self.normals(name),
            self.extra(name),
            load_picture(self.scene.image_path(frame)),
        )

    def _size(self, name: str) -> tuple[int, int]:
        camera = self.scene.camera_of(self.scene.frame(name))
        return camera.width, camera.height

    def write_lists(self, sources: Mapping[str, Sequence[str]], options: str = "") -> None:
        """Write ``patch-match.cfg`` (picture, then its source pictures) and ``fusion.cfg`` (one picture a line)."""
        pairs = "".join(f"{name}\n{', '.join(others)}\n" for name, others in sources.items())
        write_text(self.stereo / "patch-match.cfg", options + pairs)
        self.write_fusion_list(list(sources))

    def write_fusion_list(self, names: Sequence[str]) -> None:
        """Write which pictures are fused."""
        write_text(self.stereo / "fusion.cfg", "".join(f"{name}\n" for name in names))

    @property
    def fused_names(self) -> tuple[str, ...]:
        """The pictures that ``fusion.cfg`` lists.

        Raises
        ------
        DataError
            Where the list is missing.
        """
        path = self.stereo / "fusion.cfg"
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except (OSError, ValueError) as error:
            raise DataError(f"{self.root} is no dense folder", expected=str(path), found=str(error)) from error
        return tuple(line for line in lines if line and not line.startswith("#"))


class DepthViews(Sequence[DepthView]):
    """The depth views of a dense folder; each is read from the disk when it is asked for."""

    def __init__(self, folder: DenseFolder, names: Sequence[str]) -> None:
        self._folder, self._names = folder, tuple(names)

    def __len__(self) -> int:
        return len(self._names)

    def __iter__(self) -> Iterator[DepthView]:
        return (self._folder.view(name) for name in self._names)

    @overload
    def __getitem__(self, index: int) -> DepthView: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[DepthView]: ...

    def __getitem__(self, index: int | slice) -> DepthView | Sequence[DepthView]:
        if isinstance(index, slice):
            return DepthViews(self._folder, self._names[index])
        return self._folder.view(self._names[index])


def open_depth_views(folder: Path) -> DepthViews:
    """Return the views of a dense folder that have final maps, read one by one when they are asked for.

    Raises
    ------
    DataError
        Where it is no dense folder, or has no final map.
    """
    dense = DenseFolder(folder)
    names = [name for name in dense.fused_names if dense.has(name)]
    if not names:
        raise DataError(
            f"{folder} has no depth maps",
            expected="stereo/depth_maps/<picture>.geometric.bin",
            todo="Run stereo or write depth into it first",
        )
    return DepthViews(dense, names)


def require_pinhole(scene: Scene) -> None:
    """Raise :class:`CapabilityError` where a registered frame's camera has distortion, or is none of COLMAP's."""
    for frame in scene.registered:
        camera = scene.camera_of(frame)
        if not isinstance(camera, ColmapCamera) or not camera.is_pinhole:
            found = camera.model if isinstance(camera, ColmapCamera) else type(camera).__name__
            raise CapabilityError(
                f"The camera of frame '{frame.name}' is no pinhole camera",
                expected="PINHOLE or SIMPLE_PINHOLE",
                found=found,
                todo="Take the distortion out of the pictures first (toolkit.poses.undistort)",
            )


def frame_size(scene: Scene, frame: Frame, longest: int) -> tuple[int, int]:
    """Return width and height of a picture made smaller until its longest side is at most ``longest``."""
    camera = scene.camera_of(frame)
    scale = min(1.0, longest / max(camera.width, camera.height))
    return max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
