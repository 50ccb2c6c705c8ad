"""Handing a run's splat or scene to other programs."""

from __future__ import annotations

import shutil
import uuid
from pathlib import Path
from typing import Literal, get_args

from toolkit.errors import RunError
from toolkit.files import atomic_path, disk_errors
from toolkit.progress import Progress, silent
from toolkit.runs.folder import RunFolder

ExportFormat = Literal["ply", "colmap", "scene"]


def export_run(
    run: RunFolder, to: Path, format: ExportFormat | None = None, *, progress: Progress = silent
) -> ExportFormat:
    """Copy what a run made to ``to``, whole or not at all, and return in which format.

    Parameters
    ----------
    run:
        A finished run.
    to:
        File or folder that does not exist yet.
    format:
        ``"ply"``: the splat as INRIA's PLY. ``"scene"``: a scene folder with its pictures. ``"colmap"``: the same
        without our ``scene.json``. By default a name that ends in .ply means a splat, every other a scene.
    progress:
        Told of every copied picture.

    Raises
    ------
    RunError
        Where the run has no such thing, ``to`` is there already, or the disk refuses.
    DataError
        Where the run's scene is damaged or its pictures are gone.
    """
    chosen: ExportFormat = format or ("ply" if to.suffix.lower() == ".ply" else "scene")
    if chosen not in get_args(ExportFormat):
        raise RunError(f"Unknown format '{chosen}'", expected=", ".join(get_args(ExportFormat)))
    if to.exists():
        raise RunError(f"{to} is there already", expected="a new name", todo="Choose another or move it away")
    if chosen == "ply":
        _copy_splat(run, to)
    else:
        _copy_scene(run, to, chosen, progress)
    return chosen


def _copy_splat(run: RunFolder, to: Path) -> None:
    if not run.splat_file.is_file():
        raise RunError(
            f"Run {run.id} has no splat",
            expected="a finished run of a method that makes one",
            todo="Export its scene",
        )
    with disk_errors(to, "writing"), atomic_path(to) as temporary:
        shutil.copyfile(run.splat_file, temporary)


def _copy_scene(run: RunFolder, to: Path, format: ExportFormat, progress: Progress) -> None:
    from toolkit.scene.folder import SCENE_FILE, read_scene, write_scene

    if not (run.scene_folder / SCENE_FILE).is_file():
        raise RunError(f"Run {run.id} has no scene", expected="a finished run")
    scene = read_scene(run.scene_folder)
    temporary = to.with_name(f".{to.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        with disk_errors(to, "writing"):
            write_scene(scene, temporary, copy_images=True, progress=progress)
            if format == "colmap":
                (temporary / SCENE_FILE).unlink()
            temporary.rename(to)
    finally:
        if temporary.exists():
            shutil.rmtree(temporary)
