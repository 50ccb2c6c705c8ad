"""What a feed-forward network says of a set of pictures: cameras, depth, confidence and points."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError
from toolkit.geometry.alignment import Similarity
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform

Array = NDArray[np.float64]
Maps = NDArray[np.float32]

#: A rotation of single precision is orthonormal to 1e-6; what is farther off is none.
_ORTHONORMAL = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Cameras, depth, confidence and points of F pictures, in a world of unknown scale.

    Depth, confidence, points and colours are maps of one size (H, W), that of the network's input. The map of a
    picture shows it scaled and shifted: the point (x, y) of a map, centres of its pixels at +0.5, is the point
    ``(sx x + ox, sy y + oy)`` of the picture. Pixels of a map that show nothing (padding, sky, masked) have
    confidence 0.

    Attributes
    ----------
    provider:
        Network and weights, as a result is to be recorded.
    names:
        (F,) of the pictures, as frames are named.
    cameras:
        (F,) PINHOLE cameras of the whole pictures, in their own pixels.
    cam_from_world:
        (F,) poses.
    depth:
        (F, H, W) float32 camera depth (z) in units of the world; above 0 where the confidence is.
    confidence:
        (F, H, W) float32, from 0. Its meaning is the network's; higher is surer.
    points:
        (F, H, W, 3) float32 places in the world, as the network says or as its depth gives.
    picture_from_map:
        (F, 4) float64 ``sx, sy, ox, oy`` in pixels.
    colours:
        (F, H, W, 3) uint8, or None.

    Raises
    ------
    DataError
        For shapes that contradict each other, NaN or infinity where the confidence is above 0, depth that is not
        positive there, rotations that are none, or two pictures of one name.
    """

    provider: str
    names: tuple[str, ...]
    cameras: tuple[ColmapCamera, ...]
    cam_from_world: tuple[RigidTransform, ...]
    depth: Maps
    confidence: Maps
    points: Maps
    picture_from_map: Array
    colours: NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        for name, kind in (("depth", np.float32), ("confidence", np.float32), ("points", np.float32)):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=kind))
        object.__setattr__(self, "picture_from_map", np.asarray(self.picture_from_map, dtype=np.float64))
        _check_shapes(self)
        _check_cameras(self)
        _check_values(self)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(F, H, W) where there is a prediction."""
        return self.confidence > 0

    def map_camera(self, index: int) -> ColmapCamera:
        """Return the camera of a picture in pixels of its map."""
        fx, fy, cx, cy = self.cameras[index].params
        sx, sy, ox, oy = self.picture_from_map[index]
        height, width = self.depth.shape[1:]
        return ColmapCamera("PINHOLE", width, height, (fx / sx, fy / sy, (cx - ox) / sx, (cy - oy) / sy))

    def to_picture(self, index: int, pixels: ArrayLike) -> Array:
        """Return pixels (N, 2) of the picture at pixels (N, 2) of its map."""
        row = self.picture_from_map[index]
        moved: Array = np.asarray(pixels, dtype=np.float64).reshape(-1, 2) * row[:2] + row[2:]
        return moved

    def to_map(self, index: int, pixels: ArrayLike) -> Array:
        """Return pixels (N, 2) of the map at pixels (N, 2) of the picture."""
        row = self.picture_from_map[index]
        moved: Array = (np.asarray(pixels, dtype=np.float64).reshape(-1, 2) - row[2:]) / row[:2]
        return moved

    def depth_at(self, index: int, pixels: ArrayLike) -> Array:
        """Return the depth (N,) at pixels (N, 2) of a picture: of the map's pixel that it falls into.

        NaN outside the map and where there is no prediction. Depths are not mixed across edges.
        """
        place = np.floor(self.to_map(index, pixels))
        height, width = self.depth.shape[1:]
        inside: NDArray[np.bool_] = np.all((place >= 0) & (place < (width, height)), axis=1)
        column, row = np.where(inside[:, None], place, 0).astype(np.int64).T
        known = inside & (self.confidence[index, row, column] > 0)
        found: Array = np.where(known, self.depth[index, row, column].astype(np.float64), np.nan)
        return found

    def chosen(self, indices: Sequence[int]) -> Prediction:
        """Return the prediction of some of the pictures, in this order."""
        rows = list(indices)
        return dataclasses.replace(
            self,
            names=tuple(self.names[i] for i in rows),
            cameras=tuple(self.cameras[i] for i in rows),
            cam_from_world=tuple(self.cam_from_world[i] for i in rows),
            depth=self.depth[rows],
            confidence=self.confidence[rows],
            points=self.points[rows],
            picture_from_map=self.picture_from_map[rows],
            colours=None if self.colours is None else self.colours[rows],
        )

    def with_points_from_depth(self) -> Prediction:
        """Return the prediction with the points that depth, cameras and poses give."""
        return dataclasses.replace(
            self,
            points=unproject(
                self.depth, [self.map_camera(i) for i in range(len(self))], self.cam_from_world, self.valid
            ),
        )

    def transformed(self, target_from_world: Similarity) -> Prediction:
        """Return the prediction in another world. Far origins cost precision: points are float32."""
        return dataclasses.replace(
            self,
            cam_from_world=tuple(target_from_world.apply_to_pose(pose) for pose in self.cam_from_world),
            depth=(self.depth * np.float64(target_from_world.scale)).astype(np.float32),
            points=target_from_world.apply(self.points.astype(np.float64)).astype(np.float32),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return what it is, without the maps, ready for JSON."""
        valid = self.valid
        return {
            "provider": self.provider,
            "names": list(self.names),
            "map_size": [int(self.depth.shape[2]), int(self.depth.shape[1])],
            "focal": [float(camera.params[0]) for camera in self.cameras],
            "share_predicted": float(valid.mean()),
            "confidence_median": float(np.median(self.confidence[valid])),
        }


def unproject(
    depth: Maps,
    cameras: Sequence[ColmapCamera],
    cam_from_world: Sequence[RigidTransform],
    valid: NDArray[np.bool_],
) -> Maps:
    """Return the points (F, H, W, 3), float32, of depth maps (F, H, W) at the centres of their pixels.

    Parameters
    ----------
    depth:
        Camera depth z.
    cameras:
        PINHOLE, in pixels of the maps.
    cam_from_world:
        Poses.
    valid:
        (F, H, W); elsewhere points are 0.
    """
    points = np.zeros((*depth.shape, 3), dtype=np.float32)
    rows, columns = np.indices(depth.shape[1:]) + 0.5
    for i, (camera, pose) in enumerate(zip(cameras, cam_from_world, strict=True)):
        fx, fy, cx, cy = camera.params
        z = depth[i].astype(np.float64)
        in_camera = np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], axis=-1)
        points[i] = np.where(valid[i][..., None], pose.inverse().apply(in_camera), 0.0)
    return points


def _check_shapes(prediction: Prediction) -> None:
    count = len(prediction.names)
    if count == 0:
        raise DataError("The prediction has no pictures", expected="at least one")
    if len(set(prediction.names)) != count:
        raise DataError("Two pictures of the prediction have the same name", expected="different names")
    shape = prediction.depth.shape
    if len(shape) != 3 or shape[0] != count or 0 in shape:
        raise DataError(
            "The depth maps of the prediction do not fit its pictures",
            expected=f"({count}, H, W)",
            found=str(shape),
        )
    wanted: dict[str, tuple[int, ...]] = {
        "confidence": shape,
        "points": (*shape, 3),
        "picture_from_map": (count, 4),
        "colours": (*shape, 3),
    }
    for name, size in wanted.items():
        array = getattr(prediction, name)
        if array is not None and array.shape != size:
            raise DataError(
                f"The array '{name}' of the prediction does not fit its depth maps",
                expected=str(size),
                found=str(array.shape),
            )
    if prediction.colours is not None and prediction.colours.dtype != np.uint8:
        raise DataError(
            "The colours of the prediction are no colours", expected="uint8", found=str(prediction.colours.dtype)
        )
    for name in ("cameras", "cam_from_world"):
        if len(getattr(prediction, name)) != count:
            raise DataError(
                f"The prediction has {count} pictures but {len(getattr(prediction, name))} {name}",
                expected="one for each picture",
            )


def _check_cameras(prediction: Prediction) -> None:
    rows = zip(
        prediction.names,
        prediction.cameras,
        prediction.cam_from_world,
        prediction.picture_from_map,
        strict=True,
    )
    for name, camera, pose, row in rows:
        if camera.model != "PINHOLE":
            raise DataError(f"The camera of '{name}' is not PINHOLE", expected="PINHOLE", found=camera.model)
        finite = bool(np.isfinite(pose.matrix).all())
        off = np.abs(pose.rotation @ pose.rotation.T - np.eye(3)).max() if finite else np.inf
        if not off < _ORTHONORMAL or np.linalg.det(pose.rotation) < 0:
            raise DataError(
                f"The pose of '{name}' is no rigid motion",
                expected="a finite translation and an orthonormal rotation of determinant 1",
                found=str(np.round(pose.matrix[:3], 4).tolist()),
            )
        if not np.isfinite(row).all() or row[0] <= 0 or row[1] <= 0:
            raise DataError(
                f"The map of '{name}' has no place in its picture",
                expected="finite numbers sx, sy, ox, oy with sx and sy above 0",
                found=str(row.tolist()),
            )


def _check_values(prediction: Prediction) -> None:
    confidence, depth = prediction.confidence, prediction.depth
    if not np.isfinite(confidence).all() or confidence.min() < 0:
        raise DataError("The confidence of the prediction is none", expected="finite values from 0 on")
    valid = prediction.valid
    if not valid.any():
        raise DataError("The prediction is empty", expected="pixels with a confidence above 0", found="none")
    bad = valid & ~(np.isfinite(depth) & (depth > 0) & np.isfinite(prediction.points).all(axis=-1))
    if bad.any():
        where = int(np.flatnonzero(bad.any(axis=(1, 2)))[0])
        raise DataError(
            f"The prediction has no sound depth or points for '{prediction.names[where]}'",
            expected="finite points and depth above 0 where the confidence is above 0",
            found=f"{int(bad.sum())} pixels that are not",
            todo="Set the confidence of pixels without depth to 0",
        )
