"""Satellite views: from RPCs as they come to cameras that agree with each other, and to local affine cameras.

Every view has its camera from the start. What is missing is agreement: the RPCs of one place are off by pixels, so
that rays of one point miss each other by metres. Tie points between the pictures tell these shifts.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from toolkit.errors import StageError
from toolkit.files import atomic_path
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.geometry.rpc_correct import RpcRefinement, refine_rpcs
from toolkit.geometry.rpc_fit import LocalCamera, fit_affine_camera
from toolkit.geometry.rpc_settings import RpcRefinementSettings
from toolkit.progress import Progress, silent, track
from toolkit.scene import Points, Scene
from toolkit.scene.pictures import load_mask, load_picture
from toolkit.scene.raster import read_raster, stretched
from toolkit.scene.raster_io import RASTER_ENDINGS
from toolkit.scene.scene import Tracks

Array = NDArray[np.float64]

#: Focal length, in widths, of the pinhole that stands in for a telescope while features are matched.
_LONG = 50.0
#: Of the tie points' heights, how much is left out at either end where a range of heights is made from them.
_ODD = 1.0


@dataclass(frozen=True)
class SatellitePoses:
    """Views whose cameras agree, and the points that they agree on.

    Attributes
    ----------
    scene:
        The frames with corrected RPC cameras, and tie points with their observations.
    refinement:
        What was estimated, with residuals and sigmas.
    """

    scene: Scene
    refinement: RpcRefinement

    def to_dict(self) -> dict[str, Any]:
        """Return residuals, corrections and sigmas as JSON values."""
        return self.refinement.to_dict()


def require_rpc_cameras(scene: Scene) -> tuple[RpcCamera, ...]:
    """Return the RPC camera of each frame, in order.

    Raises
    ------
    StageError
        Where a frame has another camera.
    """
    cameras = []
    for frame in scene.frames:
        camera = scene.camera_of(frame)
        if not isinstance(camera, RpcCamera):
            raise StageError(
                f"Frame '{frame.name}' has no RPC camera",
                expected="satellite pictures with an RPC in their tags or beside them",
                found=type(camera).__name__,
            )
        cameras.append(camera)
    return tuple(cameras)


def pictures_to_match(scene: Scene, folder: Path, *, progress: Progress = silent) -> Scene:
    """Write satellite pictures as PNG of eight bits and return them as a scene that features can be found in.

    Contrast is stretched to the whole range. What holds no data (the collar of a turned picture) is masked, and so
    is what the scene's masks leave out. The cameras of the new scene stand in while matching: pinholes of long
    focal length, which is not known, so that pairs are verified by fundamental matrices.

    Parameters
    ----------
    folder:
        For ``images/`` and, where something is masked, ``masks/``.

    Raises
    ------
    DataError
        Where a picture is missing or damaged.
    RunError
        When the disk is full or may not be written.
    """
    cameras, frames, masked = {}, [], False
    for number, frame in enumerate(track(scene.frames, "satellite.pictures", progress), start=1):
        path = scene.image_path(frame)
        seen = load_mask(scene, frame)
        if path.suffix.lower() in RASTER_ENDINGS:
            raster = read_raster(path)
            picture = stretched(raster)
            seen = raster.valid if seen is None else raster.valid & seen
        else:
            picture = load_picture(path)
        height, width = picture.shape[:2]
        name = f"{Path(frame.name).with_suffix('')}.png"
        _write_png(folder / "images" / name, picture)
        if seen is not None and not seen.all():
            _write_png(folder / "masks" / f"{name}.png", np.where(seen, 255, 0).astype(np.uint8))
            masked = True
        cameras[number] = ColmapCamera.pinhole(width, height, _LONG * width)
        frames.append(dataclasses.replace(frame, name=name, camera_id=number, cam_from_world=None, prior=None))
    masks = folder / "masks" if masked else None
    return Scene(folder / "images", cameras, tuple(frames), mask_dir=masks)


def _write_png(path: Path, picture: NDArray[np.uint8]) -> None:
    with atomic_path(path) as temporary:
        Image.fromarray(picture).save(temporary, format="PNG")


def refine_satellite(scene: Scene, ties: Tracks, settings: RpcRefinementSettings) -> SatellitePoses:
    """Return the scene with RPC cameras that agree on the tie points, and with these points.

    Parameters
    ----------
    scene:
        Every frame with an RPC camera.
    ties:
        Which pixels of which frames are one point.

    Raises
    ------
    StageError
        As :func:`toolkit.geometry.rpc_correct.refine_rpcs`, and where a frame has no RPC camera.
    """
    cameras = require_rpc_cameras(scene)
    found = refine_rpcs(cameras, ties.frame, ties.point, ties.pixel, settings)
    known = np.isfinite(found.points[:, 0])
    agreeing = np.flatnonzero(found.inlier & known[ties.point])
    often = np.bincount(ties.point[agreeing], minlength=len(known)) > 1
    agreeing = agreeing[often[ties.point[agreeing]]]
    left, number = np.unique(ties.point[agreeing], return_inverse=True)
    points = Points(
        xyz=found.points[left],
        rgb=np.full((len(left), 3), 128, np.uint8),
        error=np.bincount(number, found.residual[agreeing]) / np.bincount(number),
        tracks=Tracks(number.astype(np.int64), ties.frame[agreeing], ties.pixel[agreeing]),
    )
    frames = tuple(
        dataclasses.replace(frame, camera_id=i, cam_from_world=RigidTransform.identity())
        for i, frame in enumerate(scene.frames, start=1)
    )
    corrected = dict(enumerate(found.cameras, start=1))
    return SatellitePoses(scene.replace(cameras=corrected, frames=frames, points=points), found)


def ground_box(scene: Scene, *, heights: tuple[float, float] | None = None, margin: float = 15.0) -> Array:
    """Return the box (2, 3) between the median edges of the views' footprints, in metres of the scene's world.

    One picture that was cut elsewhere does not move it; a view need not see all of it.

    Parameters
    ----------
    heights:
        Lowest and highest; by default those of the scene's points, a few odd ones left out, with the margin.
    margin:
        Metres that are added below and above the points.

    Raises
    ------
    StageError
        Where neither heights nor points are there, or the footprints lie apart.
    """
    cameras = require_rpc_cameras(scene)
    if heights is None:
        if scene.points is None or not len(scene.points):
            raise StageError("The range of heights is not known", expected="heights, or points of the scene")
        low, high = np.percentile(scene.points.xyz[:, 2], [_ODD, 100 - _ODD])
        heights = (float(low) - margin, float(high) + margin)
    altitude = cameras[0].origin[2]
    middle = 0.5 * sum(heights)
    footprints = [_footprint(camera, altitude + middle) for camera in cameras]
    edges = np.array([[rows.min(axis=0), rows.max(axis=0)] for rows in footprints])
    lower, upper = np.median(edges[:, 0], axis=0), np.median(edges[:, 1], axis=0)
    if not (lower < upper).all():
        raise StageError(
            "The views' footprints lie apart",
            expected="pictures of one place",
            found=f"footprints from {edges[:, 0].min(axis=0)} to {edges[:, 1].max(axis=0)} m",
        )
    return np.array([[*lower, heights[0]], [*upper, heights[1]]])


def _footprint(camera: RpcCamera, height: float) -> Array:
    """Return east and north (4, 2) of the picture's corners."""
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]], float)
    return camera.locate(corners, np.full(4, height))[:, :2]


def with_affine_cameras(
    scene: Scene, box: Array, pictures: Scene | None = None
) -> tuple[Scene, Sequence[LocalCamera]]:
    """Return the scene with the affine camera that fits each RPC camera over a box, and how well it does.

    Parameters
    ----------
    box:
        (2, 3) lower and upper corner in metres of the scene's world.
    pictures:
        Of :func:`pictures_to_match`: the new scene has these pictures and masks in the place of the scene's own.

    Raises
    ------
    StageError
        Where a frame has no RPC camera.
    """
    fitted = [fit_affine_camera(camera, box) for camera in require_rpc_cameras(scene)]
    names = [frame.name for frame in (scene if pictures is None else pictures).frames]
    frames = tuple(
        dataclasses.replace(frame, name=name, camera_id=i, cam_from_world=local.cam_from_world)
        for i, (frame, name, local) in enumerate(zip(scene.frames, names, fitted, strict=True), start=1)
    )
    cameras = {i: local.camera for i, local in enumerate(fitted, start=1)}
    places = {} if pictures is None else {"image_dir": pictures.image_dir, "mask_dir": pictures.mask_dir}
    return scene.replace(cameras=cameras, frames=frames, **places), fitted
