"""A scene as a folder: a COLMAP folder (``images/``, ``masks/``, ``sparse/0/``) with ``scene.json`` beside it.

Poses, points and tracks lie in ``sparse/0``, where COLMAP, nerfstudio and gsplat find them; ``scene.json`` holds
what COLMAP has no place for: the order, split, times and priors of all frames, registered or not, all cameras,
the georeference, and the poses of frames whose camera is none of COLMAP's (affine, RPC). What those frames saw of
the points is in ``observations.safetensors``.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from toolkit.errors import DataError
from toolkit.files import atomic_path, disk_errors, read_json, write_json
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.progress import Progress, silent, track
from toolkit.scene.colmap import remove_model, scene_like, scene_to_pycolmap, staged_model
from toolkit.scene.colmap_files import read_model
from toolkit.scene.observations import with_observations, write_observations
from toolkit.scene.records import (
    camera_from_record,
    camera_record,
    field,
    frame_from_record,
    frame_record,
    georeference_from_record,
    georeference_record,
    pose_from_record,
    pose_record,
)
from toolkit.scene.scene import Frame, Points, Scene, Tracks

SCENE_FILE = "scene.json"
_FORMAT = "sightline-scene"
_VERSION = 1
_SPARSE = "sparse/0"
_OBSERVATIONS = "observations.safetensors"


def write_scene(scene: Scene, folder: Path, *, copy_images: bool = False, progress: Progress = silent) -> None:
    """Write a scene as a folder that :func:`read_scene` and COLMAP open.

    The old ``scene.json`` goes before anything else changes and the new one is written last, so that a folder whose
    writing was cut short is no scene.
    Rotations are stored as quaternions (equal to about 1e-15); all other numbers to the bit. Observations in
    frames without a pose are not kept; those that are kept come in order of their points.

    Parameters
    ----------
    scene:
        With cameras of COLMAP's models, affine and RPC cameras.
    folder:
        Made where it is not there; a scene that is there is replaced, other files stay.
    copy_images:
        Copy pictures and masks to ``images/`` and ``masks/``; otherwise the folder refers to where they lie.
    progress:
        Told of every copied picture.

    Raises
    ------
    CapabilityError
        Where a camera is of another kind.
    DataError
        Where the scene holds what cannot be stored (names with control characters, numbers that are not finite)
        or a picture to copy is missing.
    RunError
        When the disk is full or the folder may not be written.
    """
    record = _record(scene, folder, copy_images)
    others = _other_observations(scene)
    with ExitStack() as staged:
        move_in: Callable[[], None] = partial(remove_model, folder / _SPARSE)
        if record["sparse"]:
            move_in = staged.enter_context(staged_model(scene_to_pycolmap(_for_colmap(scene)), folder / _SPARSE))
        with disk_errors(folder, "writing"):
            folder.mkdir(parents=True, exist_ok=True)
            (folder / SCENE_FILE).unlink(missing_ok=True)
            if copy_images:
                copy_pictures(scene, folder / "images", folder / "masks", progress=progress)
            move_in()
            (folder / _OBSERVATIONS).unlink(missing_ok=True)
            if others is not None:
                write_observations(folder / _OBSERVATIONS, others)
    write_json(folder / SCENE_FILE, record)


def _record(scene: Scene, folder: Path, copy_images: bool) -> dict[str, Any]:
    points = scene.points
    errors = points is not None and points.error is not None
    tracks = points is not None and points.tracks is not None
    images = folder / "images" if copy_images else scene.image_dir
    masks = folder / "masks" if copy_images and scene.mask_dir is not None else scene.mask_dir
    return {
        "format": _FORMAT,
        "version": _VERSION,
        "image_dir": _place(images, folder),
        "mask_dir": None if masks is None else _place(masks, folder),
        "georeference": georeference_record(scene.georeference),
        "sparse": _SPARSE if _for_colmap(scene).registered or points is not None else None,
        "points": None if points is None else {"errors": errors, "tracks": tracks},
        "observations": None if _other_observations(scene) is None else _OBSERVATIONS,
        "cameras": [{"id": int(i), **camera_record(scene.cameras[i])} for i in sorted(scene.cameras)],
        "frames": [_frame_record(scene, frame) for frame in scene.frames],
    }


def _frame_record(scene: Scene, frame: Frame) -> dict[str, Any]:
    record = frame_record(frame)
    if frame.cam_from_world is not None and not _of_colmap(scene, frame):
        record["pose"] = pose_record(frame.cam_from_world, frame.name)
    return record


def _of_colmap(scene: Scene, frame: Frame) -> bool:
    """Return whether ``sparse/0`` can hold a frame."""
    return isinstance(scene.camera_of(frame), ColmapCamera)


def _for_colmap(scene: Scene) -> Scene:
    """Return the scene with poses only for the frames that ``sparse/0`` can hold."""
    frames = [
        frame if _of_colmap(scene, frame) else dataclasses.replace(frame, cam_from_world=None)
        for frame in scene.frames
    ]
    return scene.replace(frames=tuple(frames))


def _other_observations(scene: Scene) -> Tracks | None:
    """Return what was observed in frames that have a pose and that ``sparse/0`` cannot hold, None for nothing."""
    tracks = scene.points.tracks if scene.points is not None else None
    posed = [frame.cam_from_world is not None and not _of_colmap(scene, frame) for frame in scene.frames]
    if tracks is None or not any(posed):
        return None
    rows = np.array(posed)[tracks.frame]
    return Tracks(tracks.point[rows], tracks.frame[rows], tracks.pixel[rows]) if rows.any() else None


def _place(target: Path, folder: Path) -> str:
    """Return ``target`` relative to ``folder`` where it lies inside, else absolute."""
    absolute = target.resolve()
    inside = folder.resolve()
    return (absolute.relative_to(inside) if absolute.is_relative_to(inside) else absolute).as_posix()


def copy_pictures(scene: Scene, images: Path, masks: Path, *, progress: Progress = silent) -> None:
    """Copy the scene's pictures and masks, each in one step, to folders that may be there already.

    Raises
    ------
    DataError
        Where a picture is missing.
    RunError
        When the disk is full or a folder may not be written.
    """
    for frame in track(scene.frames, "scene.copy", progress):
        pairs = [(scene.image_path(frame), images / frame.name)]
        mask = scene.mask_path(frame)
        if mask is not None:
            pairs.append((mask, masks / f"{frame.name}.png"))
        for source, target in pairs:
            if not source.is_file():
                raise DataError(f"Picture {source} is missing", todo="Put it back or take it out of the scene")
            if target.exists() and target.samefile(source):
                continue
            with atomic_path(target) as temporary:
                shutil.copyfile(source, temporary)


def read_scene(folder: Path) -> Scene:
    """Read a scene that :func:`write_scene` wrote. Pictures are not opened.

    Where ``sparse/0`` was changed since (by COLMAP's bundle adjuster, say) its poses, cameras and points count.

    Raises
    ------
    DataError
        Where ``scene.json`` is missing, damaged, of another version or leaves the folder by ``..``, or it does
        not fit to ``sparse/0``, or that is damaged; the message names the file and the key.
    """
    path = folder / SCENE_FILE
    record = read_json(path)
    kind = field(record, "format", str, str(path)), field(record, "version", int, str(path))
    if kind != (_FORMAT, _VERSION):
        raise DataError(
            f"Cannot read {path}",
            expected=f"format '{_FORMAT}', version {_VERSION}",
            found=f"format '{kind[0][:40]}', version {kind[1]}",
            todo="Was it written by a newer version of this program?",
        )
    masks = field(record, "mask_dir", str, str(path), optional=True)
    try:
        scene = Scene(
            image_dir=_from_place(field(record, "image_dir", str, str(path)), folder, path),
            cameras=_cameras(field(record, "cameras", list, str(path)), path),
            frames=tuple(
                frame_from_record(item, f"{path}, frame {i}")
                for i, item in enumerate(field(record, "frames", list, str(path)))
            ),
            mask_dir=None if masks is None else _from_place(masks, folder, path),
            georeference=georeference_from_record(record.get("georeference"), str(path)),
        )
    except DataError as error:
        raise DataError(f"{path} holds no scene", found=str(error).rstrip(".")) from error
    hints = field(record, "points", dict, str(path), optional=True)
    poses = _other_poses(scene, record["frames"], path)
    if field(record, "sparse", str, str(path), optional=True) is None:
        return _with_poses(scene, poses)
    model = read_model(folder / _SPARSE)
    posed = scene_like(model, scene.image_dir, scene)
    points = posed.points
    if points is not None and field(record, "observations", str, str(path), optional=True) is not None:
        points = with_observations(points, model.points.ids, folder / _OBSERVATIONS, len(scene))
    return _with_poses(posed.replace(points=_as_hinted(points, hints)), poses)


def _other_poses(scene: Scene, records: list[Any], path: Path) -> dict[str, RigidTransform]:
    """Return the poses in ``scene.json`` by the frame's name; those of COLMAP's cameras are in ``sparse/0``."""
    poses = {}
    for index, (frame, record) in enumerate(zip(scene.frames, records, strict=True)):
        pose = None if _of_colmap(scene, frame) else pose_from_record(record, f"{path}, frame {index}")
        if pose is not None:
            poses[frame.name] = pose
    return poses


def _with_poses(scene: Scene, poses: Mapping[str, RigidTransform]) -> Scene:
    frames = [
        dataclasses.replace(frame, cam_from_world=poses.get(frame.name, frame.cam_from_world))
        for frame in scene.frames
    ]
    return scene.replace(frames=tuple(frames))


def _as_hinted(points: Points | None, hints: dict[str, Any] | None) -> Points | None:
    """Tell "there are none" from "there is an empty list of them", which COLMAP's files cannot."""
    if points is None or (hints is None and not len(points)):
        return None
    tracks, error = points.tracks, points.error
    if hints is not None and tracks is not None and not len(tracks.point) and not hints.get("tracks"):
        tracks = None
    if hints is not None and error is None and hints.get("errors"):
        error = np.full(len(points), np.nan)
    return dataclasses.replace(points, tracks=tracks, error=error)


def _from_place(text: str, folder: Path, path: Path) -> Path:
    try:
        os.fsencode(text)
    except UnicodeEncodeError as error:
        raise DataError(f"A folder named in {path} cannot be", expected="Unicode", found=ascii(text)) from error
    if ".." in PurePosixPath(text).parts or "\0" in text:
        raise DataError(f"A folder named in {path} leaves it", expected="a path without '..'", found=repr(text))
    return folder / text


def _cameras(records: list[Any], path: Path) -> dict[int, Any]:
    cameras = {}
    for place, record in enumerate(records):
        number = field(record, "id", int, f"{path}, camera {place}")
        if number in cameras:
            raise DataError(f"{path} has camera {number} twice")
        cameras[number] = camera_from_record(record, f"{path}, camera {number}")
    return cameras
