"""Open a data folder, whatever its layout: pictures for a method, and true poses for its judge."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from toolkit.errors import DataError
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.progress import Progress, silent, track
from toolkit.scene import middlebury, strecha
from toolkit.scene.colmap import scene_like
from toolkit.scene.colmap_files import has_model, read_model
from toolkit.scene.folder import SCENE_FILE, read_scene
from toolkit.scene.photos import scene_from_photos
from toolkit.scene.pictures import check_picture, picture_size
from toolkit.scene.records import camera_record, frame_record, georeference_record
from toolkit.scene.satellite import is_satellite, read_satellite
from toolkit.scene.scene import Frame, Scene
from toolkit.scene.transforms import TRANSFORMS_FILE, read_transforms
from toolkit.workspace import file_fingerprint, fingerprint

_TEST_EVERY = 8

VIDEO_FILE = "video.mp4"
"""Name of a flight's video in its data folder, whatever its format."""


@dataclass(frozen=True, slots=True)
class Capture:
    """An opened data folder.

    Attributes
    ----------
    scene:
        Frames, cameras and priors, without poses and points: what a method may use. Only frames with an RPC camera
        have a pose, the identity: what is known of such a view is all in its camera.
    reference:
        The same frames with known poses, or None. Its world need not be that of the scene's priors.
    warnings:
        What the user should know, a sentence each.
    video:
        File of which the pictures are frames, where it lies beside ``scene.json``.
    """

    scene: Scene
    reference: Scene | None
    warnings: tuple[str, ...] = ()
    video: Path | None = None


def open_capture(folder: Path, *, check: bool = True, progress: Progress = silent) -> Capture:
    """Open a data folder by what lies in it.

    - ``scene.json``: a scene folder; its poses become the reference. ``video.mp4`` beside it is the flight's
      video.
    - ``transforms.json``: a nerfstudio folder; its poses and points become the reference, its pictures, cameras and
      masks are the scene's. Pictures that it does not name are left out.
    - ``images/`` and a COLMAP model in ``sparse/``: its poses become the reference, the one with most images where
      there are several; its cameras are the scene's, too.
    - ``images/`` and ``gt_dense_cameras/``: the EPFL benchmark; its cameras are the reference only.
    - ``images/`` and one ``*_par.txt``: the Middlebury benchmark; its cameras are the reference only.
    - GeoTIFF or NITF pictures with an RPC in their tags or beside them, in ``images/`` or directly: satellite
      views, which have their cameras from the RPCs and no reference.
    - photos, in ``images/`` or directly.

    Every eighth frame is a test frame, unless ``scene.json`` or ``transforms.json`` names test frames of its own.

    Parameters
    ----------
    folder:
        Of the data.
    check:
        Decode every picture now, so that a damaged one is found before hours of work.
    progress:
        Told after each picture.

    Raises
    ------
    DataError
        Where the folder is missing, has no pictures, or anything in it is damaged or contradicts the rest.
    MissingDependencyError
        For satellite pictures where rasterio is not installed.
    """
    if not folder.is_dir():
        raise DataError(f"Folder {folder} is missing", expected="a folder with pictures or a scene")
    if (folder / SCENE_FILE).exists():
        video = folder / VIDEO_FILE
        capture = _whole_scene(read_scene(folder), check, progress)
        return dataclasses.replace(capture, video=video if video.is_file() else None)
    if (folder / TRANSFORMS_FILE).exists():
        return _whole_scene(read_transforms(folder / TRANSFORMS_FILE), check, progress)
    models = _models(folder)
    if not models and is_satellite(folder):
        return _satellite_folder(folder, check, progress)
    photos = scene_from_photos(folder, check=check, progress=progress)
    scene = photos.scene.with_every_nth_as_test(_TEST_EVERY)
    warnings = photos.warnings
    if (folder / "sparse").is_dir() and not models:
        warnings += ("sparse/ holds no COLMAP model (cameras, images and points3D) and was left out",)
    if models and (folder / "images").is_dir():
        return _colmap_folder(scene, models, warnings)
    if (folder / strecha.FOLDER).is_dir():
        return Capture(scene, strecha.with_truth(scene, folder / strecha.FOLDER), warnings)
    if (folder / "images").is_dir() and (cameras := middlebury.parameter_file(folder)) is not None:
        return Capture(scene, middlebury.with_truth(scene, cameras), warnings)
    return Capture(scene, None, warnings)


def _whole_scene(full: Scene, check: bool, progress: Progress) -> Capture:
    """Return a scene that a file describes, with its own poses as the reference."""
    if not any(frame.split == "test" for frame in full.frames):
        full = full.with_every_nth_as_test(_TEST_EVERY)
    _check_sizes(full)
    if check:
        for frame in track(full.frames, "photos", progress):
            check_picture(full.image_path(frame))
    bare = full.without_poses()
    found = [frame for frame in full.registered if not _is_rpc(full, frame)]
    known = tuple(
        whole if _is_rpc(full, whole) else frame for frame, whole in zip(bare.frames, full.frames, strict=True)
    )
    return Capture(bare.replace(frames=known), full if found or full.points is not None else None)


def _is_rpc(scene: Scene, frame: Frame) -> bool:
    return isinstance(scene.camera_of(frame), RpcCamera)


def _satellite_folder(folder: Path, check: bool, progress: Progress) -> Capture:
    """Return the satellite views of a folder. Their RPCs are what a method may use, and no truth."""
    opened = read_satellite(folder)
    if check:
        for frame in track(opened.scene.frames, "photos", progress):
            check_picture(opened.scene.image_path(frame))
    return Capture(opened.scene.with_every_nth_as_test(_TEST_EVERY), None, opened.warnings)


def _colmap_folder(scene: Scene, models: list[Path], warnings: tuple[str, ...]) -> Capture:
    """Return photos with the model that registered most of them as their reference."""
    # COLMAP's world is its own: the priors and the georeference are not in it.
    frames = tuple(dataclasses.replace(frame, prior=None) for frame in scene.frames)
    bare = scene.replace(frames=frames, georeference=None)
    found = [scene_like(read_model(model), scene.image_dir, bare) for model in models]
    best = max(range(len(found)), key=lambda i: len(found[i].registered))
    reference = found[best]
    _check_sizes(reference)
    if len(models) > 1:
        count = f"{len(reference.registered)} of {len(scene)} images"
        warnings += (f"of {len(models)} models in sparse/ {models[best].name} was taken, with {count}",)
    frames = tuple(
        dataclasses.replace(frame, camera_id=known.camera_id)
        for frame, known in zip(scene.frames, reference.frames, strict=True)
    )
    return Capture(scene.replace(frames=frames, cameras=reference.cameras), reference, warnings)


def _models(folder: Path) -> list[Path]:
    """Return the folders with a COLMAP model in the order of their names."""
    sparse = folder / "sparse"
    numbered = sorted(path for path in sparse.iterdir() if path.is_dir()) if sparse.is_dir() else []
    return [place for place in (folder, sparse, *numbered) if has_model(place)]


def _check_sizes(scene: Scene) -> None:
    """Refuse missing pictures and those of another size than their camera."""
    for frame in scene.frames:
        camera, size = scene.camera_of(frame), picture_size(scene.image_path(frame))
        if size != (camera.width, camera.height):
            raise DataError(
                f"Picture {scene.image_path(frame)} does not fit its camera",
                expected=f"{camera.width}x{camera.height} pixels",
                found=f"{size[0]}x{size[1]}",
                todo="Use the pictures that the cameras were found with",
            )


def capture_fingerprint(scene: Scene, *, progress: Progress = silent) -> str:
    """Return a hash of names, contents of pictures and masks, splits, times, priors, cameras and georeference.

    It does not depend on where the pictures lie, and not on poses and points.

    Raises
    ------
    DataError
        Where a picture is missing.
    CapabilityError
        Where a camera is neither one of COLMAP's nor an affine nor an RPC camera.
    """
    frames = []
    for frame in track(scene.frames, "fingerprint", progress):
        path, mask = scene.image_path(frame), scene.mask_path(frame)
        if not path.is_file():
            raise DataError(f"Picture {path} is missing", todo="Put it back or take it out of the scene")
        content = file_fingerprint(path), None if mask is None else file_fingerprint(mask)
        camera = camera_record(scene.camera_of(frame))
        frames.append([{**frame_record(frame), "camera": camera}, frame.camera_id, *content])
    return fingerprint({"frames": frames, "georeference": georeference_record(scene.georeference)})
