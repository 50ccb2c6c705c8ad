"""What a dense folder was made from, so that no map of other settings is taken for one of these."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.depth.dense_folder import DenseFolder
from toolkit.errors import DataError, StageError
from toolkit.files import disk_errors, read_json, write_json
from toolkit.geometry.cameras import ColmapCamera
from toolkit.scene import Frame, Scene
from toolkit.settings import Settings
from toolkit.workspace import code_version, fingerprint

_RECORD = "made_from.json"


def scene_key(scene: Scene, settings: Settings, seed: int) -> str:
    """Return a hash of poses, cameras, points, sizes and times of pictures and masks, settings, seed and code."""
    from toolkit import depth

    points = scene.points
    facts: dict[str, Any] = {
        "frames": [_facts(scene, frame) for frame in scene.registered],
        "points": None if points is None else fingerprint(np.round(points.xyz, 9).tolist()),
        "settings": settings.to_dict(),
        "seed": seed,
        "code": code_version(depth),
    }
    return fingerprint(facts)


def _facts(scene: Scene, frame: Frame) -> list[Any]:
    camera, pose = scene.camera_of(frame), frame.cam_from_world
    assert pose is not None
    files = [scene.image_path(frame), scene.mask_path(frame)]
    stats = [path.stat() if path is not None and path.is_file() else None for path in files]
    return [
        frame.name,
        [camera.width, camera.height, list(camera.params) if isinstance(camera, ColmapCamera) else None],
        pose.matrix.tolist(),
        [None if stat is None else [stat.st_size, stat.st_mtime_ns] for stat in stats],
    ]


def begin_record(folder: Path, key: str) -> None:
    """Make ``folder`` ready for maps with this key: keep it where it has them, else empty it.

    Raises
    ------
    StageError
        Where the folder holds something that is no dense folder of ours.
    """
    record = folder / _RECORD
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        if not record.is_file():
            raise StageError(
                f"{folder} is in the way",
                expected="a new or an empty folder, or a dense folder that this stage made",
                todo="Choose another folder or move it away",
            )
        try:
            known = read_json(record)
        except DataError:  # half of it was written, or it was damaged since: nothing in the folder counts
            known = None
        if isinstance(known, dict) and known.get("key") == key:
            return
        with disk_errors(folder, "emptying"):
            for name in ("images", "masks", "sparse", "stereo"):
                shutil.rmtree(folder / name, ignore_errors=True)
    with disk_errors(folder, "making"):
        folder.mkdir(parents=True, exist_ok=True)
    write_json(record, {"key": key})


def read_record(dense: DenseFolder, name: str) -> dict[str, int]:
    """Return how many pixels of a picture were rejected for which reason, as it was noted beside its maps."""
    path = dense.stereo / "rejected" / f"{name}.json"
    counts = read_json(path)
    if not isinstance(counts, dict) or not all(type(count) is int for count in counts.values()):
        raise DataError(f"{path} is damaged", expected="numbers of pixels", found=repr(counts)[:80])
    return counts
