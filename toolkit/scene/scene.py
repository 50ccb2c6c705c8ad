"""The Scene: the one thing that flows between stages. It is never changed; stages return a new one."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.cameras import Camera
from toolkit.geometry.rigid import RigidTransform

Split = Literal["train", "test"]


@dataclass(frozen=True, slots=True)
class PosePrior:
    """What sensors said about a frame's pose, in the scene's world frame.

    Attributes
    ----------
    position:
        (3,) camera centre in metres, or None.
    position_sigma:
        (3,) standard deviation per world axis in metres, or None where unknown.
    rotation:
        (3, 3) ``cam_from_world`` rotation, or None.
    rotation_sigma:
        Standard deviation of the rotation about each camera axis in radians (3,), or None where unknown.
    """

    position: NDArray[np.float64] | None = None
    position_sigma: NDArray[np.float64] | None = None
    rotation: NDArray[np.float64] | None = None
    rotation_sigma: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True)
class Frame:
    """One picture.

    Attributes
    ----------
    name:
        Path below the scene's image folder, with forward slashes.
    camera_id:
        Key into the scene's cameras.
    cam_from_world:
        The pose, or None where it is not known.
    split:
        ``"train"`` or ``"test"``. Test frames are never trained on.
    time:
        Seconds since the start of the capture, or None.
    prior:
        What sensors said, or None.
    """

    name: str
    camera_id: int
    cam_from_world: RigidTransform | None = None
    split: Split = "train"
    time: float | None = None
    prior: PosePrior | None = None


@dataclass(frozen=True, slots=True)
class Tracks:
    """Which frames saw which points; row ``i`` of the three arrays is one observation.

    Attributes
    ----------
    point:
        (T,) int64 row in the points.
    frame:
        (T,) int64 index in the scene's frames.
    pixel:
        (T, 2) float64 where the point was seen, in pixels.
    """

    point: NDArray[np.int64]
    frame: NDArray[np.int64]
    pixel: NDArray[np.float64]

    def __post_init__(self) -> None:
        count = len(self.point)
        if self.point.shape != (count,) or self.frame.shape != (count,) or self.pixel.shape != (count, 2):
            raise DataError(
                "Tracks contradict themselves",
                expected="(T,), (T,) and (T, 2)",
                found=f"{self.point.shape}, {self.frame.shape} and {self.pixel.shape}",
            )


@dataclass(frozen=True, slots=True)
class Points:
    """Coloured points of the world.

    Attributes
    ----------
    xyz:
        (P, 3) float64 world coordinates.
    rgb:
        (P, 3) uint8.
    error:
        (P,) float64 mean reprojection error in pixels, or None where there is none.
    tracks:
        The observations, or None.
    """

    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    error: NDArray[np.float64] | None = None
    tracks: Tracks | None = None

    def __post_init__(self) -> None:
        count = len(self.xyz)
        if self.xyz.shape != (count, 3) or self.rgb.shape != (count, 3):
            raise DataError(
                "Points and colours do not fit together",
                expected="(P, 3) and (P, 3)",
                found=f"{self.xyz.shape} and {self.rgb.shape}",
            )
        if not np.all(np.isfinite(self.xyz)):
            bad = int(np.sum(~np.isfinite(self.xyz).all(axis=1)))
            raise DataError(
                "Points are not finite",
                expected="finite coordinates",
                found=f"{bad} of {count} points with NaN or infinity",
            )

    def __len__(self) -> int:
        return len(self.xyz)

    def observed(self, rows: NDArray[np.bool_]) -> Points:
        """Return the points with only these rows (T,) of their tracks, without those that have none left.

        Raises
        ------
        ValueError
            Where there are no tracks.
        """
        if self.tracks is None:
            raise ValueError("points without tracks have no observations to choose from")
        left, number = np.unique(self.tracks.point[rows], return_inverse=True)
        return dataclasses.replace(
            self,
            xyz=self.xyz[left],
            rgb=self.rgb[left],
            error=None if self.error is None else self.error[left],
            tracks=Tracks(number.astype(np.int64), self.tracks.frame[rows], self.tracks.pixel[rows]),
        )


@dataclass(frozen=True, slots=True)
class Georeference:
    """Where a local east-north-up frame lies on the WGS84 ellipsoid.

    Attributes
    ----------
    latitude, longitude:
        Of the origin, in degrees.
    altitude:
        Of the origin above the ellipsoid, in metres.
    """

    latitude: float
    longitude: float
    altitude: float


@dataclass(frozen=True)
class Scene:
    """Frames, cameras, points and what else is known of a capture.

    Attributes
    ----------
    image_dir:
        Folder that frame names are relative to.
    cameras:
        Camera by its number.
    frames:
        In order of capture.
    points:
        Sparse or dense points, or None.
    mask_dir:
        Folder with one mask ``<frame name>.png`` a frame (0: ignore), or None.
    georeference:
        Origin of the world frame on the ellipsoid, or None where the world frame is arbitrary.

    Raises
    ------
    DataError
        For a frame without camera, two frames of one name, a name that leaves the image folder, or tracks that
        point outside.
    """

    image_dir: Path
    cameras: Mapping[int, Camera]
    frames: tuple[Frame, ...]
    points: Points | None = None
    mask_dir: Path | None = None
    georeference: Georeference | None = None
    _index: Mapping[str, int] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_index", {frame.name: i for i, frame in enumerate(self.frames)})
        if len(self._index) != len(self.frames):
            raise DataError(
                "Two frames have the same name",
                expected="different names",
                found=f"{len(self.frames)} frames with {len(self._index)} names",
            )
        for frame in self.frames:
            path = PurePosixPath(frame.name)
            if path.is_absolute() or ".." in path.parts or not path.parts:
                raise DataError(f"Frame name '{frame.name}' leaves the image folder", expected="a relative path")
            if frame.camera_id not in self.cameras:
                raise DataError(
                    f"Frame '{frame.name}' has no camera",
                    expected=f"one of {sorted(self.cameras)}",
                    found=str(frame.camera_id),
                )
        tracks = self.points.tracks if self.points is not None else None
        if self.points is not None and tracks is not None and len(tracks.point):
            inside = 0 <= tracks.point.min() <= tracks.point.max() < len(
                self.points
            ) and 0 <= tracks.frame.min() <= tracks.frame.max() < len(self.frames)
            if not inside:
                raise DataError("Tracks name points or frames that are not in the scene")

    def __len__(self) -> int:
        return len(self.frames)

    def frame(self, name: str) -> Frame:
        """Return the frame of this name. Raises :class:`DataError` where there is none."""
        if name not in self._index:
            raise DataError(f"No frame '{name}' in the scene", found=f"{len(self.frames)} other frames")
        return self.frames[self._index[name]]

    def camera_of(self, frame: Frame) -> Camera:
        """Return the camera that took ``frame``."""
        return self.cameras[frame.camera_id]

    def image_path(self, frame: Frame) -> Path:
        """Return the path of the frame's picture."""
        return self.image_dir / frame.name

    def mask_path(self, frame: Frame) -> Path | None:
        """Return the path of the frame's mask where the scene has masks and this one exists."""
        if self.mask_dir is None:
            return None
        path = self.mask_dir / f"{frame.name}.png"
        return path if path.is_file() else None

    @property
    def registered(self) -> tuple[Frame, ...]:
        """The frames with a pose."""
        return tuple(frame for frame in self.frames if frame.cam_from_world is not None)

    @property
    def poses(self) -> dict[str, RigidTransform]:
        """The poses ``cam_from_world`` of the frames that have one, by name."""
        return {frame.name: frame.cam_from_world for frame in self.frames if frame.cam_from_world is not None}

    def of_split(self, split: Split) -> tuple[Frame, ...]:
        """Return the frames with a pose that belong to ``split``."""
        return tuple(frame for frame in self.registered if frame.split == split)

    def centres(self, frames: Iterable[Frame] | None = None) -> NDArray[np.float64]:
        """Return camera centres (F, 3) of ``frames``, by default of all that have a pose."""
        chosen = self.registered if frames is None else frames
        poses = [frame.cam_from_world for frame in chosen]
        return np.array([pose.centre for pose in poses if pose is not None]).reshape(-1, 3)

    def to_pycolmap(self) -> pycolmap.Reconstruction:
        """Return what is registered as COLMAP's reconstruction: :func:`toolkit.scene.colmap.scene_to_pycolmap`."""
        from toolkit.scene.colmap import scene_to_pycolmap

        return scene_to_pycolmap(self)

    def replace(self, **changes: object) -> Scene:
        """Return a copy with some fields changed."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]

    def without_poses(self) -> Scene:
        """Return the scene as a camera gave it: no poses, no points. Priors, cameras and the split stay."""
        frames = tuple(dataclasses.replace(frame, cam_from_world=None) for frame in self.frames)
        return self.replace(frames=frames, points=None)

    def with_every_nth_as_test(self, every: int = 8) -> Scene:
        """Return the scene with frames 0, ``every``, 2 ``every``, ... as test and all others as train.

        This is the split of Mip-NeRF 360 and 3DGS (``llffhold = 8``), over the frames in order of their names;
        0 makes all frames train.
        """
        order = {name: i for i, name in enumerate(sorted(frame.name for frame in self.frames))}
        frames = tuple(
            dataclasses.replace(frame, split="test" if every > 0 and order[frame.name] % every == 0 else "train")
            for frame in self.frames
        )
        return self.replace(frames=frames)
