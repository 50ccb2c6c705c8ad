"""Handing a run's splat, scene or trajectory to other programs."""

from __future__ import annotations

import dataclasses
import shutil
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from toolkit.errors import RunError
from toolkit.files import atomic_folder, atomic_path, disk_errors
from toolkit.progress import Progress, silent
from toolkit.runs.folder import RunFolder

if TYPE_CHECKING:
    from toolkit.scene import Scene
    from toolkit.scene.timed_poses import TimedPoses

ExportFormat = Literal["ply", "spz", "colmap", "scene", "transforms", "tum", "kitti"]

_BY_ENDING: dict[str, ExportFormat] = {".ply": "ply", ".spz": "spz", ".txt": "tum", ".tum": "tum"}


def export_run(
    run: RunFolder, to: Path, format: ExportFormat | None = None, *, progress: Progress = silent
) -> ExportFormat:
    """Copy what a run made to ``to``, whole or not at all, and return in which format.

    Parameters
    ----------
    run:
        A finished run.
    to:
        File or folder that does not exist yet. Where it is called ``transforms.json``, the folder around it must
        not exist yet.
    format:
        By default the ending of the name tells.

        - ``"ply"`` (.ply): the splat as INRIA's PLY.
        - ``"spz"`` (.spz): the splat, compressed with loss (see :mod:`toolkit.splat.spz`).
        - ``"scene"`` (any other name): a scene folder with its pictures.
        - ``"colmap"``: the same without our ``scene.json``.
        - ``"transforms"`` (transforms.json): a folder for nerfstudio with ``transforms.json``, the pictures in
          ``images/`` and the points. Frames without a pose are left out.
        - ``"tum"`` (.txt, .tum): the registered frames in order, as a TUM trajectory. Their times are the frames'
          own where all have one and they increase; otherwise the frame's number in the scene, from 0, is its time.
        - ``"kitti"``: the registered frames in order, as a KITTI trajectory, which has no times: where frames are
          not registered, line numbers are not frame numbers.
    progress:
        Told of every copied picture and of the pieces of SPZ files.

    Raises
    ------
    RunError
        Where the run has no such thing, or no poses, ``to`` is there already, or the disk refuses.
    DataError
        Where the run's scene or splat is damaged or does not fit into the format, or its pictures are gone.
    CapabilityError
        Where the format cannot hold the scene's cameras.
    """
    chosen = format or _by_name(to)
    if chosen not in get_args(ExportFormat):
        raise RunError(f"Unknown format '{chosen}'", expected=", ".join(get_args(ExportFormat)))
    target = to.parent if chosen == "transforms" and _is_transforms(to) else to
    if target.exists():
        raise RunError(f"{target} is there already", expected="a new name", todo="Choose another or move it away")
    if chosen in ("ply", "spz"):
        _copy_splat(run, target, chosen, progress)
    elif chosen in ("tum", "kitti"):
        _write_trajectory(run, target, chosen)
    elif chosen == "transforms":
        _copy_transforms(run, target, progress)
    else:
        _copy_scene(run, target, chosen, progress)
    return chosen


def _by_name(to: Path) -> ExportFormat:
    return "transforms" if _is_transforms(to) else _BY_ENDING.get(to.suffix.lower(), "scene")


def _is_transforms(to: Path) -> bool:
    from toolkit.scene.transforms import TRANSFORMS_FILE

    return to.name == TRANSFORMS_FILE


def _copy_splat(run: RunFolder, to: Path, format: ExportFormat, progress: Progress) -> None:
    if not run.splat_file.is_file():
        raise RunError(
            f"Run {run.id} has no splat",
            expected="a finished run of a method that makes one",
            todo="Export its scene",
        )
    if format == "spz":
        from toolkit.splat.ply import read_splats
        from toolkit.splat.spz import write_spz

        write_spz(read_splats(run.splat_file), to, progress=progress)
        return
    with disk_errors(to, "writing"), atomic_path(to) as temporary:
        shutil.copyfile(run.splat_file, temporary)


def _scene_of(run: RunFolder) -> Scene:
    from toolkit.scene.folder import SCENE_FILE, read_scene

    if not (run.scene_folder / SCENE_FILE).is_file():
        raise RunError(f"Run {run.id} has no scene", expected="a finished run")
    return read_scene(run.scene_folder)


def _posed_scene_of(run: RunFolder) -> Scene:
    scene = _scene_of(run)
    if not scene.registered:
        raise RunError(
            f"Run {run.id} has no poses", expected="registered frames", found=f"{len(scene)} frames without a pose"
        )
    return scene


def _write_trajectory(run: RunFolder, to: Path, format: ExportFormat) -> None:
    from toolkit.scene.trajectory_files import write_kitti, write_tum

    poses = _timed_poses(_posed_scene_of(run))
    if format == "tum":
        write_tum(poses, to)
    else:
        write_kitti(poses, to)


def _timed_poses(scene: Scene) -> TimedPoses:
    """Return the registered frames with their times, or numbers where times are missing or do not increase."""
    from toolkit.scene.timed_poses import TimedPoses

    numbers = [float(i) for i, frame in enumerate(scene.frames) if frame.cam_from_world is not None]
    own = [frame.time for frame in scene.registered if frame.time is not None]
    increase = len(own) == len(numbers) and all(after > before for before, after in pairwise(own))
    poses = tuple(frame.cam_from_world for frame in scene.registered if frame.cam_from_world is not None)
    return TimedPoses(np.array(own if increase else numbers), poses)


def _copy_scene(run: RunFolder, to: Path, format: ExportFormat, progress: Progress) -> None:
    from toolkit.scene.folder import SCENE_FILE, write_scene

    scene = _scene_of(run)
    with atomic_folder(to) as temporary:
        write_scene(scene, temporary, copy_images=True, progress=progress)
        if format == "colmap":
            (temporary / SCENE_FILE).unlink()


def _copy_transforms(run: RunFolder, to: Path, progress: Progress) -> None:
    from toolkit.scene.folder import copy_pictures
    from toolkit.scene.transforms import TRANSFORMS_FILE, write_transforms

    full = _posed_scene_of(run)
    # Tracks count all frames, and have no place in the file.
    points = None if full.points is None else dataclasses.replace(full.points, tracks=None)
    scene = full.replace(frames=full.registered, points=points)
    with atomic_folder(to) as temporary:
        # Masks lie below masks/ as the pictures lie below the folder: that is how they are found again.
        copy_pictures(scene, temporary / "images", temporary / "masks" / "images", progress=progress)
        frames = tuple(dataclasses.replace(frame, name=f"images/{frame.name}") for frame in scene.frames)
        moved = scene.replace(image_dir=temporary, mask_dir=temporary / "masks", frames=frames)
        write_transforms(moved, temporary / TRANSFORMS_FILE)
