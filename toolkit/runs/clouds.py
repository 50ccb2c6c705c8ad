"""Points of a run to be drawn beside its camera path, as many as a browser turns smoothly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import RunError
from toolkit.runs.folder import RunFolder

#: ``"points"``: the scene's points, from which a splat begins; ``"gaussians"``: the trained centres.
CloudKind = Literal["points", "gaussians"]
#: What is drawn beside camera paths; ``"mesh"``: the surface, see :mod:`toolkit.runs.meshes`.
ShapeKind = Literal["points", "gaussians", "mesh"]

#: Most points of all runs in one drawing.
MOST_POINTS = 20_000
#: Share of points at either end of each axis that is left out: single far points would make the rest a dot.
_TAIL = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Coloured points.

    Attributes
    ----------
    xyz:
        (N, 3) in the run's own world frame.
    rgb:
        (N, 3) uint8.
    total:
        How many the run has.
    """

    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    total: int


def read_cloud(run: RunFolder, kind: CloudKind, *, most: int = MOST_POINTS, seed: int = 0) -> Cloud:
    """Return at most ``most`` points of a run, chosen by chance among those that lie in the middle of all.

    Points in the outer 2 % of an axis, at either end, are left out.

    Raises
    ------
    RunError
        Where the run has no such points.
    DataError
        Where its scene or splat is damaged.
    """
    xyz, rgb = _gaussians(run) if kind == "gaussians" else _points(run)
    total = len(xyz)
    if total > 100:  # a share of few points is none
        low, high = np.quantile(xyz, [_TAIL, 1 - _TAIL], axis=0)
        inside = np.all((xyz >= low) & (xyz <= high), axis=1)
        xyz, rgb = xyz[inside], rgb[inside]
    if len(xyz) > most:
        chosen = np.sort(np.random.default_rng(seed).choice(len(xyz), most, replace=False))
        xyz, rgb = xyz[chosen], rgb[chosen]
    return Cloud(xyz, rgb, total)


def _points(run: RunFolder) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    from toolkit.scene.folder import SCENE_FILE, read_scene

    points = read_scene(run.scene_folder).points if (run.scene_folder / SCENE_FILE).is_file() else None
    if points is None or not len(points):
        raise RunError(f"Run {run.id} has no points", expected="a finished run of a method that makes some")
    return points.xyz, points.rgb


def _gaussians(run: RunFolder) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    if not run.splat_file.is_file():
        raise RunError(f"Run {run.id} has no splat", expected="a finished run of a method that makes one")
    from toolkit.splat.gaussians import SH_C0
    from toolkit.splat.ply import read_splats

    gaussians = read_splats(run.splat_file)
    colours = 0.5 + SH_C0 * gaussians.sh[:, 0].detach().cpu().numpy()
    rgb = np.rint(np.clip(colours, 0.0, 1.0) * 255.0).astype(np.uint8)
    return gaussians.means.detach().cpu().numpy().astype(np.float64), rgb
