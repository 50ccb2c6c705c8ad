"""The mesh of a run to be drawn beside its camera path, with as many faces as a browser turns smoothly."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from toolkit.errors import RunError
from toolkit.geometry.decimate import decimate
from toolkit.geometry.surface import Mesh
from toolkit.recipes.surface_files import MESH_FILE
from toolkit.runs.folder import RunFolder
from toolkit.scene.mesh_files import read_mesh

#: Most faces of all runs in one drawing.
MOST_FACES = 60_000


def read_run_mesh(run: RunFolder, *, most: int = MOST_FACES) -> tuple[Mesh, int]:
    """Return a run's mesh with at most about ``most`` faces, in the run's own world, and how many its file has.

    Raises
    ------
    RunError
        Where the run has no mesh.
    DataError
        Where its file is damaged.
    MissingDependencyError
        Where there are more faces and Open3D, which takes some away, is missing.
    """
    path = run.artifacts / MESH_FILE
    if not path.is_file():
        raise RunError(f"Run {run.id} has no mesh", expected="a finished run of a method that makes one")
    return _decimated(path, path.stat().st_mtime_ns, most)


# Fewer faces cost a second or two, and pages are drawn again and again.
@lru_cache(maxsize=8)
def _decimated(path: Path, written: int, most: int) -> tuple[Mesh, int]:
    mesh = read_mesh(path)
    return decimate(mesh, most), len(mesh.faces)
