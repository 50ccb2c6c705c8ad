"""Handing a run's splat or scene to other programs."""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Literal, get_args

from toolkit.errors import RunError
from toolkit.files import atomic_path, disk_errors
from toolkit.runs.folder import RunFolder

ExportFormat = Literal["ply", "colmap", "scene"]


def export_run(run: RunFolder, to: Path, format: ExportFormat | None = None) -> ExportFormat:
    """Copy what a run made to ``to`` and return in which format.

    Parameters
    ----------
    run:
        A finished run.
    to:
        File or folder that does not exist yet.
    format:
        ``"ply"``: the splat as INRIA's PLY. ``"scene"``: the scene folder. ``"colmap"``: a COLMAP folder, the same
        without our ``scene.json``. By default a name that ends in .ply means a splat, every other a scene.

    Raises
    ------
    RunError
        Where the run has no such thing, ``to`` is there already, or the disk refuses.
    """
    chosen: ExportFormat = format or ("ply" if to.suffix.lower() == ".ply" else "scene")
    if chosen not in get_args(ExportFormat):
        raise RunError(f"Unknown format '{chosen}'", expected=", ".join(get_args(ExportFormat)))
    if to.exists():
        raise RunError(f"{to} is there already", expected="a new name", todo="Choose another or move it away")
    if chosen == "ply":
        _copy_splat(run, to)
    else:
        _copy_scene(run, to, with_ours=chosen == "scene")
    return chosen
