"""nerfstudio's transforms.json: pictures, poses and cameras in one file, which many programs read.

``transform_matrix`` is ``world_from_cam`` with OpenGL's camera axes (x right, y up, z back); here it becomes
``cam_from_world`` with OpenCV's (x right, y down, z forward). Cameras and the convention of pixel centres:
:mod:`toolkit.scene.transforms_cameras`. Format: https://docs.nerf.studio/quickstart/data_conventions.html.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import CapabilityError, DataError
from toolkit.files import read_json, write_json
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene.colmap_model import check_name
from toolkit.scene.photos import ENDINGS
from toolkit.scene.pictures import picture_size
from toolkit.scene.ply import read_points, write_points
from toolkit.scene.pose_text import nearest_rotations
from toolkit.scene.records import field, finite, finite_array
from toolkit.scene.scene import Frame, Points, Scene, Split
from toolkit.scene.transforms_cameras import CAMERA_KEYS, camera_from_keys, camera_keys

TRANSFORMS_FILE = "transforms.json"
_POINTS_FILE = "sparse_pc.ply"
_LARGEST_FILE = 256 * 2**20
_LAST_ROW_TOLERANCE = 1e-6
#: What file systems take.
_LONGEST_NAME, _LONGEST_PATH = 250, 1000
#: OpenGL's camera axes in OpenCV's and back: y and z turn round.
_FLIP = np.diag([1.0, -1.0, -1.0])

Array = NDArray[np.float64]


def read_transforms(path: Path) -> Scene:
    """Read a transforms.json.

    - Frames come in the file's order; their names are paths below the file's folder. A ``file_path`` that ends like
      no picture and is no file gets ``.png`` (Blender's sets).
    - A frame's own camera keys count before the file's. Where ``w`` and ``h`` are missing the picture tells.
    - ``applied_transform`` (and ``applied_scale``), by which the world was turned when the file was made, is undone
      for poses and points: the world is then that of the COLMAP model or survey that the file was made from.
    - Frames in ``test_filenames`` or ``val_filenames`` are test frames, and so are those that a given
      ``train_filenames`` does not name.
    - Masks (``mask_path``) are read where they lie as ``<some folder>/<file_path>.png``, as scenes keep them.
    - ``ply_file_path`` gives the points. Depths and other keys are not read.

    Raises
    ------
    DataError
        Naming file, frame and key: a damaged file or one above 256 MiB, keys that are missing or of another type,
        a matrix that is no rigid motion (rows not orthonormal within 1e-3, NaN), unknown camera models, no frames,
        two frames of one path, paths that leave the folder, pictures, masks or points that are missing.
    """
    _check_size(path)
    record = read_json(path)
    entries = field(record, "frames", list, str(path))
    if not entries:
        raise DataError(f"{path} has no frames", expected="at least one in 'frames'")
    names = [_picture_name(entry, path, f"{path}, frame {i}") for i, entry in enumerate(entries)]
    labels = [f"{path}, frame {i} ('{name}')" for i, name in enumerate(names)]
    _check_different(names, path)
    splits = _splits(record, names, path)
    world_from_saved, scale = _undo(record, path)
    cameras: dict[ColmapCamera, int] = {}
    frames = []
    for entry, name, where, pose in zip(entries, names, labels, _poses(entries, labels), strict=True):
        camera = _camera(record, entry, path.parent / name, where)
        cam_from_world = _cam_from_world(pose, world_from_saved, scale, where)
        number = cameras.setdefault(camera, len(cameras) + 1)
        frames.append(Frame(name, number, cam_from_world, splits.get(name, "train")))
    return Scene(
        image_dir=path.parent,
        cameras={number: camera for camera, number in cameras.items()},
        frames=tuple(frames),
        points=_points(record, path, world_from_saved, scale),
        mask_dir=_mask_dir(entries, names, labels, path.parent),
    )


def write_transforms(scene: Scene, path: Path) -> None:
    """Write the frames with a pose as a transforms.json, and the points beside it as ``sparse_pc.ply``.

    Pictures are not copied; they and the masks must lie in or below the folder of ``path``, to which names are
    relative. The world stays as it is (no ``applied_transform``). Splits are written where there are test frames,
    these as ``val`` and as ``test``. Times, priors, tracks, errors of points, the georeference and frames without a
    pose have no place in the file.

    Raises
    ------
    CapabilityError
        Where a camera is none that nerfstudio knows, pictures lie outside the folder, or masks elsewhere than
        :func:`read_transforms` finds them.
    DataError
        Where no frame has a pose, or a pose is not finite.
    RunError
        When the disk is full or the folder may not be written.
    """
    if not scene.registered:
        raise DataError(f"Cannot write {path}", expected="frames with a pose", found=f"none of {len(scene)}")
    prefix = _inside(scene.image_dir, path.parent, "Pictures")
    tables = {number: camera_keys(scene.cameras[number]) for number in {f.camera_id for f in scene.registered}}
    shared = next(iter(tables.values())) if len(tables) == 1 else {}
    frames: list[dict[str, Any]] = []
    for frame in scene.registered:
        check_name(frame.name)
        own = {} if shared else tables[frame.camera_id]
        name = (prefix / frame.name).as_posix()
        frames.append(
            {"file_path": name, "transform_matrix": _matrix(frame), **own, **_mask(scene, frame, path, name)}
        )
    record: dict[str, Any] = {**shared, **_split_lists(scene, prefix)}
    if scene.points is not None and len(scene.points):
        write_points(scene.points, path.parent / _POINTS_FILE)
        record["ply_file_path"] = _POINTS_FILE
    write_json(path, {**record, "frames": frames})


# ------------------------------------------------------------------------------------------------------ writing


def _inside(place: Path, folder: Path, what: str) -> PurePosixPath:
    """Return ``place`` relative to ``folder``, followed through links only where that is needed."""
    for below, above in ((place.absolute(), folder.absolute()), (place.resolve(), folder.resolve())):
        if below.is_relative_to(above) and ".." not in below.parts:
            return PurePosixPath(below.relative_to(above).as_posix())
    raise CapabilityError(
        f"{what} cannot be named in transforms.json",
        expected=f"a folder in {folder}",
        found=str(place),
        todo="Write the file beside them, or copy them",
    )


def _matrix(frame: Frame) -> list[list[float]]:
    assert frame.cam_from_world is not None
    world_from_cam = frame.cam_from_world.inverse().matrix
    if not np.isfinite(world_from_cam).all():
        raise DataError(f"The pose of frame '{frame.name}' is not finite", found=str(world_from_cam.tolist()))
    world_from_cam[:3, :3] = world_from_cam[:3, :3] @ _FLIP
    rows: list[list[float]] = world_from_cam.tolist()
    return rows


def _mask(scene: Scene, frame: Frame, path: Path, name: str) -> dict[str, str]:
    mask = scene.mask_path(frame)
    if mask is None:
        return {}
    place = _inside(mask.parent, path.parent, "Masks") / mask.name
    if not place.as_posix().endswith(f"/{name}.png"):
        raise CapabilityError(
            "Masks cannot be named in transforms.json",
            expected=f"a folder with '{name}.png'",
            found=place.as_posix(),
            todo="Keep masks in folders like those of the pictures",
        )
    return {"mask_path": place.as_posix()}


def _split_lists(scene: Scene, prefix: PurePosixPath) -> dict[str, list[str]]:
    held_out = [(prefix / frame.name).as_posix() for frame in scene.of_split("test")]
    if not held_out:
        return {}
    train = [(prefix / frame.name).as_posix() for frame in scene.of_split("train")]
    # nerfstudio asks for all three as soon as it sees one.
    return {"train_filenames": train, "val_filenames": held_out, "test_filenames": held_out}


# ------------------------------------------------------------------------------------------------------ reading


def _check_size(path: Path) -> None:
    if path.is_file() and path.stat().st_size > _LARGEST_FILE:
        raise DataError(
            f"{path} is too large",
            expected=f"at most {_LARGEST_FILE // 2**20} MiB",
            found=f"{path.stat().st_size / 2**20:.0f} MiB",
        )


def _local_name(text: str, where: str) -> str:
    """Return a path below the folder without ``./``. Raises DataError where it leaves the folder."""
    check_name(text)
    name = PurePosixPath(text)
    if name.is_absolute() or ".." in text.replace("\\", "/").split("/") or not name.parts:
        raise DataError(
            f"A path in {where} leaves the folder of the file", expected="a path below it", found=repr(text[:80])
        )
    if max(len(part.encode()) for part in name.parts) > _LONGEST_NAME or len(text) > _LONGEST_PATH:
        raise DataError(f"A path in {where} is too long", found=repr(text[:80]))
    return name.as_posix()


def _with_ending(name: str, folder: Path) -> str:
    named = PurePosixPath(name).suffix.lower() in ENDINGS or (folder / name).is_file()
    return name if named else f"{name}.png"


def _picture_name(entry: Any, path: Path, where: str) -> str:
    name = _local_name(field(entry, "file_path", str, where), f"'file_path' of {where}")
    return _with_ending(name, path.parent)


def _check_different(names: list[str], path: Path) -> None:
    seen: dict[str, int] = {}
    for i, name in enumerate(names):
        if name in seen:
            raise DataError(
                f"{path} has two frames of one 'file_path'",
                expected="different paths",
                found=f"'{name}' in frames {seen[name]} and {i}",
            )
        seen[name] = i


def _poses(entries: list[Any], labels: list[str]) -> list[RigidTransform]:
    """Return world_from_cam with OpenCV's axes, in the file's world."""
    matrices = np.stack(
        [_motion(entry, "transform_matrix", (4, 4), where) for entry, where in zip(entries, labels, strict=True)]
    )
    rotations = nearest_rotations(matrices[:, :3, :3], lambda i: f"'transform_matrix' of {labels[i]}")
    return [
        RigidTransform(rotation @ _FLIP, position)
        for rotation, position in zip(rotations, matrices[:, :3, 3], strict=True)
    ]


def _cam_from_world(
    saved_from_cam: RigidTransform, world_from_saved: RigidTransform, scale: float, where: str
) -> RigidTransform:
    with np.errstate(over="ignore", invalid="ignore"):
        moved = RigidTransform(saved_from_cam.rotation, saved_from_cam.translation / scale)
        cam_from_world = (world_from_saved @ moved).inverse()
    if not np.isfinite(cam_from_world.translation).all():
        raise DataError(
            f"The 'transform_matrix' of {where} is too large", found=str(saved_from_cam.translation.tolist())
        )
    return cam_from_world


def _motion(record: Any, key: str, shape: tuple[int, int], where: str) -> Array:
    matrix = finite_array(field(record, key, list, where), shape, f"'{key}' of {where}")
    assert matrix is not None
    if shape[0] == 4 and np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > _LAST_ROW_TOLERANCE:
        raise DataError(
            f"The '{key}' of {where} is no rigid motion",
            expected="a last row 0 0 0 1",
            found=str(matrix[3].tolist()),
        )
    return matrix[:3]


def _undo(record: dict[str, Any], path: Path) -> tuple[RigidTransform, float]:
    """Return the motion and scale that lead from the saved world back: ``world_from_saved @ (saved / scale)``."""
    scale = record.get("applied_scale")
    size = 1.0 if scale is None else finite(scale, f"'applied_scale' of {path}")
    if not size > 0:
        raise DataError(f"Impossible 'applied_scale' in {path}", expected="a positive number", found=f"{size:g}")
    applied = record.get("applied_transform")
    if applied is None:
        return RigidTransform.identity(), size
    rows = 4 if isinstance(applied, list) and len(applied) == 4 else 3
    matrix = _motion(record, "applied_transform", (rows, 4), str(path))
    rotation = nearest_rotations(matrix[None, :, :3], lambda _: f"'applied_transform' of {path}")[0]
    return RigidTransform(rotation, matrix[:, 3]).inverse(), size


def _camera(record: dict[str, Any], entry: dict[str, Any], picture: Path, where: str) -> ColmapCamera:
    table = {key: entry[key] if entry.get(key) is not None else record.get(key) for key in CAMERA_KEYS}
    if entry.get("fl_x") is None and entry.get("fl_y") is None and _has_angle(entry):
        # The frame's own view counts before the file's focal length.
        table["fl_x"] = table["fl_y"] = None
    known = table["w"] is not None and table["h"] is not None
    return camera_from_keys(table, None if known else picture_size(picture), where)


def _has_angle(entry: dict[str, Any]) -> bool:
    return entry.get("camera_angle_x") is not None or entry.get("camera_angle_y") is not None


def _splits(record: dict[str, Any], names: list[str], path: Path) -> dict[str, Split]:
    """Return which frames are test frames."""
    lists: dict[str, set[str]] = {}
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        given = field(record, key, list, str(path), optional=True)
        if given is not None:
            lists[key] = set(_listed(given, key, path))
            unknown = sorted(lists[key] - set(names))
            if unknown:
                raise DataError(
                    f"'{key}' in {path} names pictures that are in no frame", found=", ".join(unknown[:5])
                )
    held_out = lists.get("val_filenames", set()) | lists.get("test_filenames", set())
    train = lists.get("train_filenames", set(names) - held_out)
    both = sorted(train & held_out)
    if both:
        raise DataError(
            f"{path} has frames to train on and to test with",
            expected="'train_filenames' without those of 'val_filenames' and 'test_filenames'",
            found=", ".join(both[:5]),
            todo="Take them out of one of the lists",
        )
    return {name: "test" for name in names if name not in train}


def _listed(given: Iterable[Any], key: str, path: Path) -> Iterable[str]:
    for text in given:
        if not isinstance(text, str):
            raise DataError(f"Cannot read '{key}' in {path}", expected="a list of paths", found=repr(text)[:80])
        yield _with_ending(_local_name(text, f"'{key}' of {path}"), path.parent)


def _points(record: dict[str, Any], path: Path, world_from_saved: RigidTransform, scale: float) -> Points | None:
    text = field(record, "ply_file_path", str, str(path), optional=True)
    if text is None:
        return None
    saved = read_points(path.parent / _local_name(text, f"'ply_file_path' of {path}"))
    with np.errstate(over="ignore", invalid="ignore"):
        return Points(world_from_saved.apply(saved.xyz / scale), saved.rgb)


def _mask_dir(entries: list[dict[str, Any]], names: list[str], labels: list[str], folder: Path) -> Path | None:
    """Return the folder in which every mask lies under its picture's name and ``.png``."""
    found: str | None = None
    for entry, name, where in zip(entries, names, labels, strict=True):
        text = field(entry, "mask_path", str, where, optional=True)
        if text is None:
            continue
        mask = _local_name(text, f"'mask_path' of {where}")
        place = mask.removesuffix(f"/{name}.png")
        if place == mask or (found is not None and place != found):
            raise DataError(
                f"Cannot use the 'mask_path' of {where}",
                expected=f"'{found or 'masks'}/{name}.png'",
                found=repr(mask),
                todo="Rename the masks so, or take 'mask_path' out of the file",
            )
        if not (folder / mask).is_file():
            raise DataError(f"The mask of {where} is missing", expected=str(folder / mask))
        found = place
    return None if found is None else folder / found
