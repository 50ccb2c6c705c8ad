"""Where the fit of a camera model begins: without distortion, or at the lens that another model has found."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.features import start_cameras
from toolkit.scene import Scene
from toolkit.scene.colmap import colmap_camera

# Steps along the longer side of the grid on which two models are laid onto each other.
_GRID = 16
_STEPS = 200


def plain_cameras(scene: Scene, model: str, focal: float) -> dict[int, ColmapCamera]:
    """Return a scene's cameras as ``model`` without distortion, whatever distortion the scene knows of.

    The focal length of a fish-eye counts as measured, even where it is a guess: otherwise COLMAP takes every pair
    of fish-eyes for degenerate, since a fundamental matrix does not tell their focal length. It is refined all the
    same.

    Parameters
    ----------
    scene:
        Its cameras give the size and, without ``focal``, focal length and principal point.
    model:
        COLMAP's name.
    focal:
        Focal length in pixels, with the principal point in the middle of the picture: nothing of the scene's lenses
        is used then. 0: the mean focal length and the principal point of each camera.

    Raises
    ------
    CapabilityError
        For a camera that is none of COLMAP's.
    """
    bare = {}
    for camera_id in sorted({frame.camera_id for frame in scene.frames}):
        camera = colmap_camera(scene, camera_id)
        known = camera.to_pycolmap()
        start = (known.mean_focal_length(), known.principal_point_x, known.principal_point_y)
        bare[camera_id] = ColmapCamera(
            "SIMPLE_PINHOLE",
            camera.width,
            camera.height,
            (focal, camera.width / 2, camera.height / 2) if focal else start,
            camera.prior_focal_length or "FISHEYE" in model,
        )
    return start_cameras(scene.replace(cameras=bare), model)


def counted_as_measured(cameras: Mapping[int, ColmapCamera], measured: bool) -> dict[int, ColmapCamera]:
    """Return cameras whose focal length counts as measured, or not.

    Pairs of pictures whose focal lengths are not measured are verified by fundamental matrices, which favour no
    lens.
    """
    return {number: dataclasses.replace(each, prior_focal_length=measured) for number, each in cameras.items()}


def nearest_camera(camera: ColmapCamera, model: str) -> ColmapCamera:
    """Return the camera of another model whose pixels see nearly the same rays, with the same principal point.

    Least squares of the pixel distances on a grid over the picture, with a loss that lets the corners go where the
    model cannot follow. Pixels without a ray take no part.
    """
    from scipy.optimize import least_squares

    across = np.linspace(0.0, camera.width, _GRID + 1)
    down = np.linspace(0.0, camera.height, max(2, round(_GRID * camera.height / camera.width)) + 1)
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    _, rays = camera.ray(pixels)
    sound = np.isfinite(rays).all(axis=1)
    pixels, rays = pixels[sound], rays[sound]
    known = camera.to_pycolmap()
    made = pycolmap.Camera.create_from_model_name(1, model, known.mean_focal_length(), camera.width, camera.height)
    params = np.array(made.params)
    params[list(made.principal_point_idxs())] = [known.principal_point_x, known.principal_point_y]
    free = [*made.focal_length_idxs(), *made.extra_params_idxs()]
    # Distortion parameters are about one; focal lengths are searched for in parts of themselves.
    unit = np.where(np.isin(free, list(made.focal_length_idxs())), known.mean_focal_length(), 1.0)

    def full(values: NDArray[np.float64]) -> NDArray[np.float64]:
        whole = params.copy()
        whole[free] = values * unit
        return whole

    def miss(values: NDArray[np.float64]) -> NDArray[np.float64]:
        made.params = full(values).tolist()
        off = np.asarray(made.img_from_cam(rays)) - pixels
        # A trial that throws a ray out of the picture is bad, not fatal.
        return np.clip(np.nan_to_num(off, nan=1e4, posinf=1e4, neginf=-1e4), -1e4, 1e4).ravel()

    found = least_squares(miss, params[free] / unit, loss="soft_l1", f_scale=1.0, x_scale="jac", max_nfev=_STEPS)
    return ColmapCamera(model, camera.width, camera.height, tuple(full(found.x)), camera.prior_focal_length)


def with_cameras(scene: Scene, cameras: Mapping[int, ColmapCamera]) -> Scene:
    """Return the scene with these cameras in the place of those of the same numbers."""
    return scene.replace(cameras={**scene.cameras, **cameras})


def write_cameras(database_path: Path, cameras: Mapping[int, ColmapCamera]) -> None:
    """Put cameras in the place of those of the same numbers in a database of the caller's own."""
    with closing(pycolmap.Database.open(database_path)) as database:
        for number, camera in cameras.items():
            database.update_camera(camera.to_pycolmap(number))
