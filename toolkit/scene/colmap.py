"""Scenes as COLMAP reconstructions, in memory and on the disk."""

from __future__ import annotations

import dataclasses
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.errors import CapabilityError, DataError, RunError
from toolkit.files import disk_errors
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene.colmap_files import read_model
from toolkit.scene.colmap_model import Model, ModelImage, ModelPoints, check_model, check_name, check_rigid
from toolkit.scene.scene import Frame, Points, Scene, Tracks

_MODEL_FILES = tuple(
    f"{kind}{ending}" for ending in (".bin", ".txt") for kind in ("rigs", "cameras", "frames", "images", "points3D")
)


def scene_to_pycolmap(scene: Scene) -> pycolmap.Reconstruction:
    """Return the registered frames, their cameras and the points as a COLMAP reconstruction.

    Image and frame numbers are the frame's place in the scene plus one, point numbers the row plus one, camera
    numbers those of the scene, each camera with a rig of its own. Keypoints are the observations in the tracks,
    in their order; observations in frames without a pose are left out.

    Raises
    ------
    CapabilityError
        Where a registered frame's camera is none of COLMAP's.
    DataError
        Where a pose is no rigid motion, a name has control characters or is no Unicode, or a camera's number
        does not fit into 32 bits.
    """
    made = pycolmap.Reconstruction()
    for camera_id in sorted({frame.camera_id for frame in scene.registered}):
        made.add_camera_with_trivial_rig(colmap_camera(scene, camera_id).to_pycolmap(camera_id))
    points = scene.points
    tracks = points.tracks if points is not None else None
    seen = tracks if tracks is not None else Tracks(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    keypoint = np.full(len(seen.point), -1, dtype=np.int64)
    for index, frame in enumerate(scene.frames):
        if frame.cam_from_world is None:
            continue
        check_name(frame.name)
        rows = np.flatnonzero(seen.frame == index)
        keypoint[rows] = np.arange(len(rows))
        image = pycolmap.Image(
            name=frame.name,
            keypoints=np.ascontiguousarray(seen.pixel[rows], dtype=np.float64),
            camera_id=frame.camera_id,
            image_id=index + 1,
        )
        made.add_image_with_trivial_frame(image, _rigid(frame.cam_from_world, frame.name))
    if points is not None:
        _add_points(made, points, seen, keypoint)
    return made


def colmap_camera(scene: Scene, camera_id: int) -> ColmapCamera:
    """Return a camera of the scene where COLMAP can hold it.

    Raises
    ------
    CapabilityError
        Where it is of another kind.
    DataError
        Where its number does not fit.
    """
    camera = scene.cameras[camera_id]
    if not isinstance(camera, ColmapCamera):
        raise CapabilityError(
            f"Camera {camera_id} cannot be given to COLMAP",
            expected="a central camera of one of COLMAP's models",
            found=type(camera).__name__,
            todo="Fit one of COLMAP's models to it first",
        )
    if not 0 <= camera_id < 2**32 - 1:
        raise DataError(
            f"Camera number {camera_id} cannot be given to COLMAP", expected=f"a number of 0 to {2**32 - 2}"
        )
    return camera


def _rigid(pose: RigidTransform, name: str) -> pycolmap.Rigid3d:
    check_rigid(pose, name)
    w, x, y, z = pose.quaternion
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), pose.translation)


def _add_points(made: pycolmap.Reconstruction, points: Points, seen: Tracks, keypoint: NDArray[np.int64]) -> None:
    """Add points with the elements of their tracks; ``keypoint`` (T,) is -1 where an element is left out."""
    kept = np.flatnonzero(keypoint >= 0)
    kept = kept[np.argsort(seen.point[kept], kind="stable")]
    elements = [
        pycolmap.TrackElement(image_id, index)
        for image_id, index in zip((seen.frame[kept] + 1).tolist(), keypoint[kept].tolist(), strict=True)
    ]
    ends = np.searchsorted(seen.point[kept], np.arange(len(points) + 1)).tolist()
    error = np.full(len(points), -1.0) if points.error is None else np.nan_to_num(points.error, nan=-1.0)
    for row in range(len(points)):
        made.add_point3D_with_id(
            row + 1,
            pycolmap.Point3D(
                xyz=points.xyz[row],
                color=points.rgb[row],
                error=error[row],
                track=pycolmap.Track(elements[ends[row] : ends[row + 1]]),
            ),
        )


def scene_from_pycolmap(
    reconstruction: pycolmap.Reconstruction, image_dir: Path, *, like: Scene | None = None
) -> Scene:
    """Return a reconstruction as a scene: poses, cameras, points with tracks and errors.

    Keypoints that see no point are left out. A point error that is not known is NaN; where none is known
    ``Points.error`` is None.

    Parameters
    ----------
    reconstruction:
        Its images may belong to rigs.
    image_dir:
        Folder that the image names are relative to.
    like:
        Where given, its frames stay in their order with name, split, time and prior, and its masks and
        georeference stay; frames that the reconstruction lacks have no pose. A camera keeps its number where
        both sides group the same frames under it and gets a new one otherwise. Without it, frames come in order
        of their image numbers.

    Raises
    ------
    DataError
        For an image that ``like`` does not know, or a reconstruction that contradicts itself.
    """
    model = _model_of(reconstruction)
    check_model(model, "the reconstruction")
    return _scene_of(model, image_dir) if like is None else scene_like(model, image_dir, like)


def read_colmap(folder: Path, image_dir: Path) -> Scene:
    """Read a sparse model, binary or text, from ``folder``, ``folder/sparse/0`` or ``folder/sparse``.

    Points, tracks and errors are as in :func:`scene_from_pycolmap`.

    Raises
    ------
    DataError
        Where the model is missing, damaged or contradicts itself; the message names the file.
    """
    model = read_model(folder)
    try:
        return _scene_of(model, image_dir)
    except DataError as error:
        raise DataError(f"The model in {folder} is no scene", found=str(error).rstrip(".")) from error


def write_colmap(scene: Scene, folder: Path, binary: bool = True) -> None:
    """Write the registered frames, their cameras and the points as a sparse model into ``folder``.

    Model files that were there go, so that no reader meets old text beside new binary files. What is written
    is that of :func:`scene_to_pycolmap`.

    Raises
    ------
    CapabilityError, DataError
        As :func:`scene_to_pycolmap` and :func:`staged_model`.
    RunError
        When the disk is full or the folder may not be written.
    """
    with staged_model(scene_to_pycolmap(scene), folder, binary) as move_in:
        move_in()


@contextmanager
def staged_model(
    reconstruction: pycolmap.Reconstruction, folder: Path, binary: bool = True
) -> Iterator[Callable[[], None]]:
    """Write a reconstruction beside its place and yield what moves it into ``folder``.

    What is in ``folder`` stays until the new model is whole; then its model files, binary and text, go. No half
    of a model is ever seen as a whole one.

    Raises
    ------
    DataError
        For names with spaces as text: COLMAP reads them only up to the space.
    RunError
        When the disk is full or the folder may not be written.
    """
    for image in reconstruction.images.values():
        if not binary and " " in image.name:
            raise DataError(
                f"COLMAP cannot read the name '{image.name}' from text files", todo="Write binary files"
            )
    with disk_errors(folder, "writing"):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".model.", suffix=".tmp") as name:
            temporary = Path(name)
            if binary:
                reconstruction.write_binary(temporary)
            else:
                reconstruction.write_text(temporary)
            try:
                read_model(temporary)
            except DataError as error:
                # COLMAP's writers do not notice a full disk.
                raise RunError(
                    f"The model in {folder} could not be written to its end",
                    found=f"{shutil.disk_usage(folder).free / 2**20:.1f} MiB free",
                    todo="Free some space, or choose another folder. What was there is kept",
                ) from error
            yield lambda: _move_model(temporary, folder)


def _move_model(source: Path, folder: Path) -> None:
    remove_model(folder)
    # The points come last: without them a half moved model is none.
    for name in _MODEL_FILES:
        if (source / name).exists():
            (source / name).replace(folder / name)


def remove_model(folder: Path) -> None:
    """Delete the model files in ``folder``, binary and text, where there are any."""
    for name in reversed(_MODEL_FILES):
        (folder / name).unlink(missing_ok=True)


def _model_of(reconstruction: pycolmap.Reconstruction) -> Model:
    """Copy what a scene needs out of a reconstruction."""
    cameras = {int(i): ColmapCamera.from_pycolmap(camera) for i, camera in reconstruction.cameras.items()}
    images = {}
    for image_id, image in reconstruction.images.items():
        pose = None
        if image.has_pose:
            cam_from_world = image.cam_from_world()
            x, y, z, w = cam_from_world.rotation.quat
            pose = RigidTransform.from_quaternion([w, x, y, z], np.array(cam_from_world.translation))
        xy = np.array([point.xy for point in image.points2D], dtype=np.float64).reshape(-1, 2)
        ids = np.array([point.point3D_id for point in image.points2D], dtype=np.uint64)
        images[int(image_id)] = ModelImage(image.name, int(image.camera_id), pose, xy, ids)
    ids_points = [(int(i), point) for i, point in reconstruction.points3D.items()]
    points = ModelPoints.collect(
        [i for i, _ in ids_points],
        [point.xyz for _, point in ids_points],
        [point.color for _, point in ids_points],
        [point.error for _, point in ids_points],
        [
            np.array([(e.image_id, e.point2D_idx) for e in point.track.elements], dtype=np.int64).reshape(-1, 2)
            for _, point in ids_points
        ],
    )
    return Model(cameras, images, points)


def _scene_of(model: Model, image_dir: Path) -> Scene:
    order = sorted(model.images)
    images = [model.images[image_id] for image_id in order]
    frames = tuple(Frame(image.name, image.camera_id, image.cam_from_world) for image in images)
    points = _scene_points(model, {image_id: i for i, image_id in enumerate(order)})
    return Scene(image_dir, dict(model.cameras), frames, points)


def scene_like(model: Model, image_dir: Path, like: Scene) -> Scene:
    """Return ``like`` with a model's poses, cameras and points, as :func:`scene_from_pycolmap` tells."""
    index = {frame.name: i for i, frame in enumerate(like.frames)}
    unknown = sorted(image.name for image in model.images.values() if image.name not in index)
    if unknown:
        raise DataError(
            "The reconstruction has images that the scene does not have",
            expected="the scene's frames",
            found=", ".join(unknown[:5]),
        )
    posed = {image.name: image for image in model.images.values() if image.cam_from_world is not None}
    numbers = _camera_numbers(posed, like)
    frames = tuple(
        dataclasses.replace(
            frame, camera_id=numbers[posed[frame.name].camera_id], cam_from_world=posed[frame.name].cam_from_world
        )
        if frame.name in posed
        else dataclasses.replace(frame, cam_from_world=None)
        for frame in like.frames
    )
    cameras = {**like.cameras, **{new: _refined(model.cameras[old], like, new) for old, new in numbers.items()}}
    replaced = {frame.camera_id for frame in like.frames} - {frame.camera_id for frame in frames}
    kept = {camera_id: camera for camera_id, camera in cameras.items() if camera_id not in replaced}
    points = _scene_points(model, {image_id: index[image.name] for image_id, image in model.images.items()})
    return like.replace(image_dir=image_dir, cameras=kept, frames=frames, points=points)


def _refined(camera: ColmapCamera, like: Scene, camera_id: int) -> ColmapCamera:
    """Return a model's camera, remembering what its files forget: that the focal length was measured."""
    known = like.cameras.get(camera_id)
    if isinstance(known, ColmapCamera) and known.prior_focal_length:
        return dataclasses.replace(camera, prior_focal_length=True)
    return camera


def _camera_numbers(posed: dict[str, ModelImage], like: Scene) -> dict[int, int]:
    """Return the number in the scene of every camera of the model that took a registered image.

    Where the registered frames of a camera of ``like`` are those of one camera of the model, that number stays,
    and with it frames that were not registered share the refined camera.
    """
    pairs = {(posed[frame.name].camera_id, frame.camera_id) for frame in like.frames if frame.name in posed}
    olds, news = [old for old, _ in pairs], [new for _, new in pairs]
    numbers = {old: new for old, new in pairs if olds.count(old) == 1 and news.count(new) == 1}
    free = max(like.cameras, default=0) + 1
    for old in sorted(set(olds) - set(numbers)):
        numbers[old] = free
        free += 1
    return numbers


def _scene_points(model: Model, index: dict[int, int]) -> Points:
    """Return the model's points; ``index`` gives the frame of each image number."""
    points = model.points
    pixel = np.zeros((len(points.row), 2))
    frame = np.zeros(len(points.row), dtype=np.int64)
    for image_id, image in model.images.items():
        rows = points.image_id == image_id
        pixel[rows] = image.xy[points.keypoint[rows]]
        frame[rows] = index[image_id]
    known = points.error >= 0
    error = np.where(known, points.error, np.nan) if known.any() else None
    return Points(points.xyz, points.rgb, error, Tracks(points.row, frame, pixel))
