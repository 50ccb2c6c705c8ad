"""COLMAP's database of keypoints and matches: made from a scene, copied, counted.

Image numbers in it are the frame's place in the scene plus one, camera numbers those of the scene.

COLMAP brings an SQLite of its own. Two SQLite libraries in one process break each other's file locks, up to a
crash, so while COLMAP has a database open only :func:`watch` may look into it.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.files import disk_errors
from toolkit.geometry.cameras import ColmapCamera
from toolkit.scene import Scene

# COLMAP's number of an image pair is (2^31 - 1) * smaller image number + larger one.
_PAIR_FACTOR = 2**31 - 1

_KINDS = pycolmap.TwoViewGeometryConfiguration
#: What COLMAP says of pairs that agree by a watermark only, or by nothing.
NOT_VERIFIED = frozenset(int(kind) for kind in (_KINDS.UNDEFINED, _KINDS.DEGENERATE, _KINDS.WATERMARK))


def create_database(path: Path, scene: Scene, cameras: Mapping[int, ColmapCamera]) -> None:
    """Write a new database with the scene's frames, cameras and position priors. One that was there goes.

    Parameters
    ----------
    path:
        Where to write it.
    scene:
        Its frames; the priors are taken as they are, in the scene's world frame.
    cameras:
        What each camera starts from, by the scene's numbers.
    """
    with disk_errors(path, "writing"):
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove(path)
    with closing(pycolmap.Database.open(path)) as database:
        for camera_id in sorted({frame.camera_id for frame in scene.frames}):
            camera = cameras[camera_id].to_pycolmap(camera_id)
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=camera_id)
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        for number, frame in enumerate(scene.frames, start=1):
            image = pycolmap.Image(name=frame.name, camera_id=frame.camera_id, image_id=number)
            database.write_image(image, use_image_id=True)
            taken = pycolmap.Frame(frame_id=number, rig_id=frame.camera_id)
            taken.add_data_id(image.data_id)
            database.write_frame(taken, use_frame_id=True)
            if frame.prior is not None and frame.prior.position is not None:
                sigma = frame.prior.position_sigma
                prior = pycolmap.PosePrior(
                    corr_data_id=image.data_id,
                    position=frame.prior.position,
                    coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
                )
                if sigma is not None:
                    prior.position_covariance = np.diag(np.square(sigma))
                database.write_pose_prior(prior)


def copy_database(source: Path, target: Path) -> None:
    """Copy a database, with whatever is still in its write-ahead log. One that was there goes.

    Raises
    ------
    DataError
        Where ``source`` is missing or no database.
    RunError
        Where ``target`` may not be written or the disk is full.
    """
    with closing(_open(source)) as old, disk_errors(target, "writing"):
        target.parent.mkdir(parents=True, exist_ok=True)
        _remove(target)
        with closing(sqlite3.connect(target)) as new:
            old.backup(new)


def keypoint_counts(path: Path) -> dict[str, int | None]:
    """Return the number of keypoints of each image by its name, None where it was not looked at.

    Raises
    ------
    DataError
        Where there is no database of COLMAP's.
    """
    rows = _read(path, "SELECT name, rows FROM images LEFT JOIN keypoints USING (image_id) ORDER BY image_id")
    return {str(name): None if count is None else int(count) for name, count in rows}


def require_same_frames(path: Path, scene: Scene) -> None:
    """Check that a database has the frames of a scene, in their order.

    It is read before COLMAP opens it: two SQLite libraries must not have it open at the same time.

    Raises
    ------
    DataError
        Where it has others, or is missing or damaged.
    """
    if list(keypoint_counts(path)) != [frame.name for frame in scene.frames]:
        raise DataError(
            f"{path} does not belong to this scene",
            expected=f"its {len(scene.frames)} frames in their order",
            todo="Extract and match the features of this scene first",
        )


def match_counts(path: Path) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return pairs (P, 2) of frame indices that were matched, their matches (P,) and verified inliers (P,).

    Pairs that agree by a watermark only, or by nothing, have no inliers.

    Raises
    ------
    DataError
        Where there is no database of COLMAP's.
    """
    rows = _read(
        path,
        "SELECT pair_id, matches.rows, two_view_geometries.rows, config "
        "FROM matches LEFT JOIN two_view_geometries USING (pair_id) ORDER BY pair_id",
    )
    table = np.array(
        [
            (pair, count, 0 if config is None or config in NOT_VERIFIED else inliers)
            for pair, count, inliers, config in rows
        ],
        dtype=np.int64,
    ).reshape(-1, 3)
    pairs = np.stack([table[:, 0] // _PAIR_FACTOR, table[:, 0] % _PAIR_FACTOR], axis=1) - 1
    return pairs, table[:, 1], table[:, 2]


def pair_numbers(pairs: NDArray[np.int64]) -> list[int]:
    """Return COLMAP's numbers of pairs (P, 2) of frame indices."""
    ordered = np.sort(pairs, axis=1) + 1
    numbers: list[int] = (ordered[:, 0] * _PAIR_FACTOR + ordered[:, 1]).tolist()
    return numbers


def settle(path: Path) -> None:
    """Put what is in the write-ahead log into the database, so that it is one file that can be copied as such."""
    with closing(_open(path, write=True)) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")


@contextmanager
def watch(path: Path) -> Iterator[pycolmap.Database]:
    """Yield a connection that can count what COLMAP writes meanwhile in another thread."""
    with closing(pycolmap.Database.open(path)) as database:
        yield database


@contextmanager
def names_without_spaces(path: Path) -> Iterator[list[str]]:
    """Yield names of the images, in order of their numbers, that a COLMAP pair list can hold.

    Its format has a space between two names, so where a name has one, all are replaced inside the block.
    """
    names = dict(_read(path, "SELECT image_id, name FROM images ORDER BY image_id"))
    if not any(" " in name for name in names.values()):
        yield list(names.values())
        return
    # No frame's name starts with a slash, so these cannot meet one that is not replaced yet.
    plain = {number: f"/{number}" for number in names}
    _rename(path, plain)
    try:
        yield list(plain.values())
    finally:
        _rename(path, names)


def _remove(path: Path) -> None:
    """Delete a database with its logs: an old log beside a new database would be played into it."""
    for ending in ("", "-wal", "-shm", "-journal"):
        path.with_name(path.name + ending).unlink(missing_ok=True)


def _rename(path: Path, names: Mapping[int, str]) -> None:
    with closing(_open(path, write=True)) as connection, connection:
        connection.executemany("UPDATE images SET name = ? WHERE image_id = ?", [(n, i) for i, n in names.items()])


def _open(path: Path, *, write: bool = False) -> sqlite3.Connection:
    if not path.is_file():
        raise DataError(f"{path} is missing", expected="a COLMAP database", todo="Extract features first")
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode={'rw' if write else 'ro'}", uri=True, timeout=30)


def _read(path: Path, query: str) -> list[tuple]:
    try:
        with closing(_open(path)) as connection:
            return connection.execute(query).fetchall()
    except sqlite3.DatabaseError as error:
        raise DataError(f"Cannot read {path}", expected="a COLMAP database", found=str(error)) from error
