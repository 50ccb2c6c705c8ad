"""Camera trajectories in three dimensions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.surface import Mesh
from toolkit.plots.style import NEUTRAL, colour, dash, figure, shown

Array = NDArray[np.float64]

#: Corners of a drawn camera in its own axes (x right, y down, z forward), for a depth of one.
_CORNERS = np.array([[-0.6, -0.45, 1.0], [0.6, -0.45, 1.0], [0.6, 0.45, 1.0], [-0.6, 0.45, 1.0]])
#: Lines of the drawn camera: centre (0) to corners (1 to 4) and around.
_LINES = ((0, 1, 2, 0), (0, 2, 3, 0), (0, 3, 4, 0), (0, 4, 1))
#: Where the viewer stands, in diagonals of the drawn box from its middle.
_EYE = (0.5, -0.62, 0.47)


def trajectory_figure(
    paths: Mapping[str, Mapping[str, RigidTransform]],
    reference: Mapping[str, RigidTransform] | None = None,
    *,
    most_cameras: int = 60,
    clouds: Mapping[str, tuple[Array, NDArray[np.uint8]]] | None = None,
    meshes: Mapping[str, Mesh] | None = None,
) -> go.Figure:
    """Draw camera centres as paths, with small pyramids that show where cameras look.

    Parameters
    ----------
    paths:
        By the run's label, ``cam_from_world`` by frame name in order of capture, all in one world frame.
    reference:
        True poses, drawn in grey.
    most_cameras:
        Most pyramids drawn a path; centres are all drawn.
    clouds:
        By the run's label, points (N, 3) in the same frame and their colours (N, 3).
    meshes:
        By the run's label, surfaces in the same frame; those without colours are grey.
    """
    drawn = figure("", 560, margin={"l": 0, "r": 0, "t": 0, "b": 0}, showlegend=True)
    everything = [_centres(poses) for poses in [*paths.values(), reference or {}] if poses]
    size = 0.04 * _extent(np.concatenate(everything)) if everything else 1.0
    if reference:
        _add_path(drawn, "reference", reference, NEUTRAL, "dot", size, most_cameras)
    for position, (label, poses) in enumerate(paths.items()):
        if poses:
            _add_path(drawn, label, poses, colour(position), dash(position), size, most_cameras)
    for label, (xyz, rgb) in (clouds or {}).items():
        _add_cloud(drawn, label, xyz, rgb)
        everything.append(xyz)
    for label, mesh in (meshes or {}).items():
        _add_mesh(drawn, label, mesh)
        everything.append(mesh.vertices)
    drawn.update_layout(legend={"y": 1.0}, scene=space(np.concatenate([np.empty((0, 3)), *everything])))
    return drawn


def _add_cloud(drawn: go.Figure, label: str, xyz: Array, rgb: NDArray[np.uint8]) -> None:
    # Single precision is enough for a drawing, and half of what the browser has to fetch.
    small = xyz.astype(np.float32)
    drawn.add_scatter3d(
        x=small[:, 0],
        y=small[:, 1],
        z=small[:, 2],
        name=f"{shown(label)}: points",
        mode="markers",
        marker={"size": 1.6, "color": [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in rgb.tolist()]},
        hoverinfo="skip",
    )


def _add_mesh(drawn: go.Figure, label: str, mesh: Mesh) -> None:
    small, (a, b, c) = mesh.vertices.astype(np.float32), mesh.faces.T
    # Photos hold the light already; a surface without colours shows its shape by the drawing's own.
    look: dict[str, Any] = {"color": NEUTRAL, "flatshading": True}
    if mesh.rgb is not None:
        look = {
            "vertexcolor": [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in mesh.rgb.tolist()],
            "lighting": {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0},
        }
    drawn.add_mesh3d(
        x=small[:, 0],
        y=small[:, 1],
        z=small[:, 2],
        i=a,
        j=b,
        k=c,
        name=f"{shown(label)}: mesh",
        showlegend=True,
        hoverinfo="skip",
        **look,
    )


def _add_path(
    drawn: go.Figure,
    label: str,
    poses: Mapping[str, RigidTransform],
    shade: str,
    line: str,
    size: float,
    most_cameras: int,
) -> None:
    centres = _centres(poses)
    drawn.add_scatter3d(
        x=centres[:, 0],
        y=centres[:, 1],
        z=centres[:, 2],
        name=shown(label),
        legendgroup=shown(label),
        mode="lines+markers",
        line={"color": shade, "width": 4, "dash": line},
        marker={"color": shade, "size": 3},
        text=[shown(name) for name in poses],
        hovertemplate="%{text}<br>%{x:.3f}, %{y:.3f}, %{z:.3f}<extra>%{fullData.name}</extra>",
    )
    every = max(1, -(-len(poses) // most_cameras))
    lines = camera_lines(list(poses.values())[::every], size)
    drawn.add_scatter3d(
        x=lines[:, 0],
        y=lines[:, 1],
        z=lines[:, 2],
        legendgroup=shown(label),
        showlegend=False,
        hoverinfo="skip",
        mode="lines",
        line={"color": shade, "width": 2},
        opacity=0.6,
    )


def camera_lines(poses: Sequence[RigidTransform], size: float) -> Array:
    """Return line ends (L, 3) of one pyramid a camera, ``size`` deep; rows of NaN end a line."""
    parts = []
    for cam_from_world in poses:
        corners = cam_from_world.inverse().apply(np.concatenate([np.zeros((1, 3)), size * _CORNERS]))
        for line in _LINES:
            parts += [corners[list(line)], np.full((1, 3), np.nan)]
    return np.concatenate(parts) if parts else np.empty((0, 3))


def space(points: Array, names: Sequence[str] = ("x", "y", "z"), up: Array | None = None) -> dict[str, Any]:
    """Return the layout of a three-dimensional drawing in equal scale, all of it seen obliquely from above.

    Plotly divides the sides of the box around what is drawn by their geometric mean: the flatter the box, the
    larger it is in its units, and the farther the viewer must stand.

    Parameters
    ----------
    points:
        (N, 3) what is drawn.
    names:
        Titles of the axes.
    up:
        (3,) unit vector that is drawn upwards; z where left out.
    """
    sides = np.ptp(points, axis=0) if len(points) else np.ones(3)
    sides = np.maximum(sides, max(1e-3 * float(sides.max()), 1e-12))
    distance = float(np.linalg.norm(sides) / np.prod(sides) ** (1 / 3))
    upwards = np.array([0.0, 0.0, 1.0]) if up is None else up
    right = np.cross([0.0, 1.0, 0.0] if abs(upwards[1]) < 0.9 else [0.0, 0.0, 1.0], upwards)
    right /= np.linalg.norm(right)
    eye = distance * (np.array(_EYE) @ np.stack([right, np.cross(upwards, right), upwards]))
    axis = {"gridcolor": NEUTRAL, "zerolinecolor": NEUTRAL, "showbackground": False, "showspikes": False}
    # A short side has room for few numbers.
    ticks = np.clip(np.rint(10 * sides / sides.max()), 2, 8).astype(int).tolist()
    return {
        "aspectmode": "data",
        "dragmode": "orbit",
        "camera": {"eye": _xyz(eye), "up": _xyz(upwards)},
        **{
            f"{letter}axis": {**axis, "title": {"text": name}, "nticks": most}
            for letter, name, most in zip("xyz", names, ticks, strict=True)
        },
    }


def _xyz(vector: Array) -> dict[str, float]:
    return dict(zip("xyz", vector.tolist(), strict=True))


def _centres(poses: Mapping[str, RigidTransform]) -> Array:
    return np.array([pose.centre for pose in poses.values()]).reshape(-1, 3)


def _extent(centres: Array) -> float:
    """Return the diagonal of the box around centres (F, 3), one where they coincide."""
    diagonal = float(np.linalg.norm(centres.max(axis=0) - centres.min(axis=0)))
    return diagonal if diagonal > 0 else 1.0
