"""One cloud from the depth maps of a dense folder, by COLMAP's fusion."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pycolmap

from toolkit.depth.dense_folder import DenseFolder, open_depth_views
from toolkit.depth.stereo_settings import FusionSettings
from toolkit.errors import StageError
from toolkit.files import disk_errors, require_free_space, stand_in
from toolkit.geometry.cameras import Camera, ColmapCamera
from toolkit.geometry.surface import Cloud
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene.colmap import write_colmap
from toolkit.scene.mesh_files import read_cloud


def fuse_depth(folder: Path, settings: FusionSettings, *, progress: Progress = silent) -> Cloud:
    """Return the points that depth maps of several pictures agree on, with colours and normals.

    Schoenberger et al. 2016 (ECCV, section 4.3), by ``pycolmap.stereo_fusion`` on one thread: with more, which
    pixels meet in a point would be left to chance.

    Parameters
    ----------
    folder:
        A dense folder; the pictures that its ``fusion.cfg`` lists and that have final maps.

    Raises
    ------
    DataError
        Where it is no dense folder, or a map is missing, damaged or of the wrong size.
    StageError
        Where not a single point is left.
    """
    dense = DenseFolder(folder)
    progress(ProgressEvent("fusion", 0, 1))
    # All maps are read before COLMAP is, which ends the process on some of those that lie.
    names = [view.name for view in open_depth_views(folder) if (view.depth > 0).any()]
    if not names:
        raise _empty(folder, "no pixel of any depth map has depth")
    dense.write_fusion_list(names)
    options = pycolmap.StereoFusionOptions(
        num_threads=1,
        min_num_pixels=settings.min_pixels,
        max_reproj_error=settings.max_pixels,
        max_depth_error=settings.max_depth / 100,
        max_normal_error=settings.max_normal,
        check_num_images=settings.check_views,
    )
    require_free_space(folder, "fusing depth maps in")
    with disk_errors(folder, "fusing depth maps in"), tempfile.TemporaryDirectory(dir=folder) as place:
        workspace = _colmap_workspace(dense, Path(place))
        path = workspace / "fused.ply"
        with quiet_colmap():
            found = pycolmap.stereo_fusion(path, workspace, options=options, output_type="PLY")
        cloud = read_cloud(path) if found.num_points3D() else None
    progress(ProgressEvent("fusion", 1, 1))
    if cloud is None:
        raise _empty(folder, f"no point has {settings.min_pixels} pixels that agree")
    return cloud


def _colmap_workspace(dense: DenseFolder, place: Path) -> Path:
    """Return a folder with the same pictures and maps, and a model with pixel centres at whole numbers.

    COLMAP's fusion takes column and row of a depth for its pixel, without the half that its cameras count, and
    would move all points by half a pixel.
    """
    scene = dense.scene
    cameras = {number: _half_pixel_less(camera) for number, camera in scene.cameras.items()}
    for name in ("images", "stereo"):
        stand_in(dense.root / name, place / name)
    write_colmap(scene.replace(cameras=cameras), place / "sparse")
    return place


def _half_pixel_less(camera: Camera) -> ColmapCamera:
    assert isinstance(camera, ColmapCamera)
    fx, fy, cx, cy = camera.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
    return ColmapCamera("PINHOLE", camera.width, camera.height, (fx, fy, cx - 0.5, cy - 0.5))


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Keep COLMAP's log off the standard error output; what matters is reported by the stages themselves."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def _empty(folder: Path, why: str) -> StageError:
    return StageError(
        f"Fusion of the depth maps in {folder} gives no point",
        expected="pixels that several pictures agree on",
        found=why,
        todo="Ask for fewer pixels (fusion.min_pixels), reject less, or use more pictures",
    )
