"""What came of photos that were localised in a run's map: written into the run, and read back."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from toolkit.errors import DataError
from toolkit.files import atomic_path, disk_errors, read_json, write_json
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.runs.folder import RunFolder
from toolkit.runs.result import plain
from toolkit.scene.pictures import area_resize

if TYPE_CHECKING:
    from toolkit.runs.localize_photo import LocalizedPhoto

Array = NDArray[np.float64]

#: Below the artifacts: what a run's recipe measured, and below that what was asked for later.
FOLDER, PHOTOS = "localize", "photos"
SCHEMA: Final = 1
# Names that may be files' names as they are.
_PLAIN = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,79}")
# Sides of the pictures that are kept of files, in pixels, and matches that are kept to be drawn.
_LARGEST_SIDE, _MOST_LINES = 1600, 200
_QUALITY = 90


@dataclass(frozen=True, slots=True, eq=False)
class MatchLines:
    """Some matches of the last round.

    Attributes
    ----------
    pixels:
        (M, 2) of the photo.
    points:
        (M, 3) of the map.
    inside:
        (M,) which agree with the pose.
    rendered_from:
        ``cam_from_world`` of the render.
    """

    pixels: Array
    points: Array
    inside: NDArray[np.bool_]
    rendered_from: RigidTransform


@dataclass(frozen=True, slots=True, eq=False)
class StoredPose:
    """A photo's pose, or why there is none, as a file says it.

    Attributes
    ----------
    name, method:
        Of the photo, and what the method is called.
    cam_from_world, reason:
        The one or the other.
    start:
        ``cam_from_world`` where the search began, with its standard deviations; None where the file does not say.
    matches, inliers, rounds:
        As in :class:`toolkit.localize.result.Localization`.
    position_sigma, rotation_sigma_deg:
        (3,) each, or None.
    seconds:
        By part.
    camera, picture:
        Of a picture file: its camera, and what is kept of it. None for frames of the run's scene.
    lines:
        Matches, or None.
    """

    name: str
    method: str
    cam_from_world: RigidTransform | None
    reason: str = ""
    start: RigidTransform | None = None
    start_sigmas: tuple[float, float] | None = None
    matches: int = 0
    inliers: int = 0
    rounds: int = 0
    position_sigma: tuple[float, ...] | None = None
    rotation_sigma_deg: tuple[float, ...] | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    camera: ColmapCamera | None = None
    picture: Path | None = None
    lines: MatchLines | None = None

    def __bool__(self) -> bool:
        return self.cam_from_world is not None


@dataclass(frozen=True, slots=True, eq=False)
class ResultFile:
    """One file: its poses, or why it cannot be read.

    Attributes
    ----------
    label:
        The file's name without its ending; that of a photo begins with ``photos/``.
    """

    label: str
    path: Path
    poses: tuple[StoredPose, ...] = ()
    error: str = ""


def photo_file(run: RunFolder, name: str, *, frame: bool) -> Path:
    """Return where the result of a photo lies; names that cannot be files' names get another one."""
    stem = name
    if not _PLAIN.fullmatch(name) or ".." in name:
        told = re.sub(r"[^A-Za-z0-9_-]+", "_", name)[:60]
        stem = f"{told}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    # No frame's file has this sign in its name: a picture file may be called as a frame is.
    return run.artifacts / FOLDER / PHOTOS / f"{stem if frame else f'file={stem}'}.json"


def write_photo_result(run: RunFolder, done: LocalizedPhoto) -> Path:
    """Write what came of a photo, in place of what came of it before, and return the file.

    Of a picture file a smaller copy is kept beside it.

    Raises
    ------
    RunError
        Where the disk refuses.
    """
    query = done.photo.query
    path = photo_file(run, query.name, frame=done.photo.frame)
    picture = None
    if not done.photo.frame:
        picture = path.with_suffix(".jpg")
        scale = min(1.0, _LARGEST_SIDE / max(query.camera.width, query.camera.height))
        width, height = (max(1, round(scale * side)) for side in (query.camera.width, query.camera.height))
        with atomic_path(picture) as temporary:
            Image.fromarray(area_resize(query.picture, width, height)).save(temporary, "JPEG", quality=_QUALITY)
    record = photo_record(done) | {
        "schema": SCHEMA,
        "picture": None if picture is None else picture.name,
        "lines": _lines(done),
    }
    write_json(path, plain(record, []))
    return path


def photo_record(done: LocalizedPhoto) -> dict[str, Any]:
    """Return what came of a photo: question, answer, settings, and the errors where it has a pose."""
    camera, start = done.photo.query.camera, done.start
    error, start_error = (pair or (None, None) for pair in (done.errors, done.start_errors))
    return {
        **done.found.to_dict(),
        "method": done.method,
        "seed": done.seed,
        "frame": done.photo.frame,
        "camera": [camera.model, camera.width, camera.height, list(camera.params)],
        "start": start.cam_from_world.matrix[:3],
        "start_position_sigma": start.position_sigma,
        "start_rotation_sigma_deg": start.rotation_sigma_deg,
        "error_m": error[0],
        "error_deg": error[1],
        "start_error_m": start_error[0],
        "start_error_deg": start_error[1],
        "settings": done.settings,
    }


def _lines(done: LocalizedPhoto) -> dict[str, Any] | None:
    if not done.found.trail:
        return None
    last = done.found.trail[-1]
    rows = np.unique(np.linspace(0, max(last.matches - 1, 0), min(last.matches, _MOST_LINES)).astype(int))
    return {
        "rendered_from": last.rendered_from.matrix[:3],
        "pixels": last.photo_pixels[rows],
        "points": last.points[rows],
        "inside": last.inside[rows],
    }


def list_results(run: RunFolder) -> tuple[ResultFile, ...]:
    """Return what is known of photos in a run: the recipe's files first, then photos by their names.

    A file that is damaged is there with its error.
    """
    folder = run.artifacts / FOLDER
    with disk_errors(folder, "reading"):
        files = [*sorted(folder.glob("*.json")), *sorted((folder / PHOTOS).glob("*.json"))]
    return tuple(_read(path, folder) for path in files if not path.name.startswith("."))


def read_photo_result(path: Path) -> StoredPose:
    """Return what a photo's file says.

    Raises
    ------
    DataError
        Where it is missing or damaged.
    """
    content = _table(read_json(path), path)
    if content.get("schema") != SCHEMA:
        raise _damaged(path, f"schema {SCHEMA}", repr(content.get("schema")))
    return next(_poses([content], path))


def _read(path: Path, folder: Path) -> ResultFile:
    label = path.relative_to(folder).with_suffix("").as_posix()
    try:
        if path.parent.name == PHOTOS:
            return ResultFile(label, path, (read_photo_result(path),))
        content = _table(read_json(path), path)
        rows, method = content.get("queries"), content.get("method")
        if not isinstance(rows, list):
            raise _damaged(path, "a list of queries", type(rows).__name__)
        return ResultFile(label, path, tuple(_poses(rows, path, str(method))))
    except DataError as error:
        return ResultFile(label, path, error=str(error))


def _poses(rows: list[Any], path: Path, method: str = "") -> Iterator[StoredPose]:
    for row in rows:
        values = _table(row, path)
        try:
            yield _pose(values, path, method)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise _damaged(path, "name, pose and start of every photo", str(error)[:80]) from error


def _pose(row: Mapping[str, Any], path: Path, method: str) -> StoredPose:
    name, camera, picture = row["name"], row.get("camera"), row.get("picture")
    if not isinstance(name, str) or not name:
        raise _damaged(path, "a name of every photo", repr(name)[:80])
    if picture is not None and picture != path.with_suffix(".jpg").name:
        raise _damaged(path, f"the picture {path.with_suffix('.jpg').name}", repr(picture)[:80])
    sigmas = (row.get("start_position_sigma"), row.get("start_rotation_sigma_deg"))
    pose = _matrix(row["cam_from_world"])
    reason = str(row.get("reason") or "")
    return StoredPose(
        name=name,
        method=str(row.get("method") or method),
        cam_from_world=pose,
        reason=reason if pose is None else "",
        start=_matrix(row.get("start")),
        start_sigmas=None if None in sigmas else (float(sigmas[0] or 0.0), float(sigmas[1] or 0.0)),
        matches=int(row.get("matches") or 0),
        inliers=int(row.get("inliers") or 0),
        rounds=int(row.get("rounds") or 0),
        position_sigma=_three(row.get("position_sigma")),
        rotation_sigma_deg=_three(row.get("rotation_sigma_deg")),
        seconds={str(part): float(value) for part, value in (row.get("seconds") or {}).items()},
        # A frame's camera is the scene's.
        camera=None if picture is None or camera is None else _camera(camera),
        picture=None if picture is None else path.with_name(picture),
        lines=_read_lines(row.get("lines")),
    )


def _matrix(value: Any) -> RigidTransform | None:
    if value is None:
        return None
    matrix = np.asarray(value, dtype=np.float64)
    if matrix.shape != (3, 4) or not np.isfinite(matrix).all():
        raise ValueError(f"a pose of {matrix.shape} numbers")
    rotation = matrix[:, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0:
        raise ValueError("a pose that is no rotation")
    return RigidTransform.from_matrix(matrix)


def _camera(value: Any) -> ColmapCamera:
    model, width, height, params = value
    return ColmapCamera(str(model), int(width), int(height), tuple(float(one) for one in params))


def _three(value: Any) -> tuple[float, ...] | None:
    if value is None:
        return None
    three = tuple(float(one) for one in value)
    if len(three) != 3 or not all(map(math.isfinite, three)):
        raise ValueError(f"{len(three)} standard deviations")
    return three


def _read_lines(value: Any) -> MatchLines | None:
    if value is None:
        return None
    pixels, points = (
        np.asarray(value[key], dtype=np.float64).reshape(-1, width) for key, width in (("pixels", 2), ("points", 3))
    )
    inside = np.asarray(value["inside"], dtype=np.bool_).ravel()
    rendered_from = _matrix(value["rendered_from"])
    whole = np.isfinite(pixels).all() and np.isfinite(points).all()
    if rendered_from is None or not (whole and len(pixels) == len(points) == len(inside)):
        raise ValueError("matches that do not correspond")
    return MatchLines(pixels, points, inside, rendered_from)


def _table(value: Any, path: Path) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise _damaged(path, "a table", type(value).__name__)
    return value


def _damaged(path: Path, expected: str, found: str) -> DataError:
    return DataError(
        f"{path} cannot be read",
        expected=expected,
        found=found,
        todo="Localise the photo again, or delete the file",
    )
