"""Which views were chosen: where they stand about the focus point, and what each pick gained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import plotly.graph_objects as go
from numpy.typing import ArrayLike, NDArray

from toolkit.plots.curves import thinned
from toolkit.plots.style import COLOURS, NEUTRAL, colour, dash, figure, shown
from toolkit.plots.trajectories import space
from toolkit.views.candidates import checked_directions
from toolkit.views.fisher import ViewSelection
from toolkit.views.scene_views import SceneSelection

Array = NDArray[np.float64]

#: Most views drawn that were not chosen.
MOST_LEFT_OUT = 2000
_CHOSEN = COLOURS[1]
_UP = (0.0, 0.0, 1.0)
# Opaque: in three dimensions half-transparent lines wipe out what is behind them.
_GRID = "rgb(150,158,172)"
# Points along a circle of the grid, and its half circles from pole to rim.
_STEPS, _MERIDIANS = 73, 8


def scene_selection_figure(selected: SceneSelection) -> go.Figure:
    """Draw the chosen and left-out views of a scene: :func:`view_selection_figure`.

    Up, the pole of the hemisphere, is the world's z where the scene is georeferenced, and then north and east are
    marked. Else it is the mean direction to the cameras.
    """
    views = selected.views
    if selected.scene.georeference is not None:
        return view_selection_figure(selected.selection, views.directions, views.names, compass=True)
    mean = -views.directions.mean(axis=0)
    length = float(np.linalg.norm(mean))
    return view_selection_figure(
        selected.selection, views.directions, views.names, up=mean / length if length > 1e-6 else _UP
    )


def view_selection_figure(
    selection: ViewSelection,
    directions: ArrayLike,
    names: Sequence[str] = (),
    *,
    up: ArrayLike = _UP,
    compass: bool = False,
) -> go.Figure:
    """Draw every view as a ray from the focus point to the place of its camera on a unit hemisphere.

    Chosen views carry the number of their pick. The circles are angles from the pole (seen from the ground, zenith
    angles); they go as far as the views do, below the horizon too.

    Parameters
    ----------
    selection:
        What was chosen.
    directions:
        (n, 3) unit, away from the cameras, as the selection was made from.
    names:
        Of the n views, shown under the pointer; by default their numbers.
    up:
        (3,) unit vector to the pole.
    compass:
        Whether x is east and y is north, to be marked.

    Raises
    ------
    DataError
        For directions that are not finite unit vectors.
    ValueError
        Where directions or names do not fit the selection.
    """
    cameras, pole = -checked_directions(directions), np.asarray(up, dtype=np.float64)
    labels = list(names) if len(names) else [f"view {i}" for i in range(len(cameras))]
    if len(cameras) != selection.views or len(labels) != selection.views:
        raise ValueError(f"expected {selection.views} views, got {len(cameras)} and {len(labels)} names")
    chosen, rest = np.array(selection.chosen, dtype=np.int64), np.array(selection.left_out, dtype=np.int64)
    drawn = figure(_title(selection), 600, margin={"l": 0, "r": 0, "t": 40, "b": 0}, showlegend=True)
    angle = np.degrees(np.arccos(np.clip(cameras @ pole, -1.0, 1.0)))
    reach = _add_grid(drawn, pole, float(angle.max(initial=0.0)), compass)
    hover = [
        _hover(label, camera, tilt, compass) for label, camera, tilt in zip(labels, cameras, angle, strict=True)
    ]
    kept = rest[thinned(len(rest), MOST_LEFT_OUT)] if len(rest) else rest
    of = f" ({len(kept)} of {len(rest)} drawn)" if len(kept) < len(rest) else f" ({len(rest)})"
    _add_rays(drawn, f"left out{of}", cameras[kept], [hover[i] for i in kept], NEUTRAL)
    picks = [f"pick {number}: {hover[i]}" for number, i in enumerate(chosen, start=1)]
    _add_rays(drawn, f"chosen ({len(chosen)})", cameras[chosen], picks, _CHOSEN, numbered=True)
    extent = np.concatenate([cameras, reach, np.zeros((1, 3))])
    drawn.update_layout(legend={"y": 1.0}, scene=space(extent, up=None if compass else pole))
    # The lengths mean nothing on a unit sphere; its own grid tells the angles.
    drawn.update_scenes(xaxis_visible=False, yaxis_visible=False, zaxis_visible=False)
    return drawn


def gain_figure(selections: Mapping[str, ViewSelection]) -> go.Figure:
    """Draw the gain curve of selections by label: after every pick, the share of what all views tell together.

    It is of the determinant; the name of a curve says where it is of the angles of pairs, because the determinants
    are zero. The first picks, whose share is zero, have no place on the logarithmic axis.
    """
    drawn = figure("Gain with every view", 340, showlegend=True, hovermode="x unified")
    for position, (label, selection) in enumerate(selections.items()):
        gains = np.array(selection.gains)
        by = " (angles of pairs)" if selection.measure == "pair_angles" else ""
        drawn.add_scatter(
            x=np.arange(1, len(gains) + 1),
            y=np.where(gains > 0, gains, np.nan),
            name=shown(label) + by,
            mode="lines+markers",
            line={"color": colour(position), "width": 2, "dash": dash(position)},
            marker={"color": colour(position), "size": 7},
        )
    drawn.update_xaxes(title_text="views")
    drawn.update_yaxes(title_text="share of all views' determinant", type="log", exponentformat="power")
    return drawn


def _title(selection: ViewSelection) -> str:
    spread = f"{selection.spread} spread by {selection.method.replace('_', ' ')}"
    told = f"determinant {selection.determinant:.3g}" if selection.rank == 3 else "determinant 0"
    return f"{len(selection.chosen)} of {selection.views} views, {spread}, {told}"


def _hover(label: str, camera: Array, tilt: float, compass: bool) -> str:
    text = f"{shown(label)}<br>{tilt:.1f}° from the pole"
    if compass:
        text += f", azimuth {np.degrees(np.arctan2(camera[0], camera[1])) % 360:.1f}°"
    return text


def _add_rays(
    drawn: go.Figure, label: str, cameras: Array, hover: Sequence[str], shade: str, numbered: bool = False
) -> None:
    """Add one line a view from the focus point, and a mark at its end."""
    if not len(cameras):
        return
    ends = np.stack([np.zeros_like(cameras), cameras, np.full_like(cameras, np.nan)], axis=1).reshape(-1, 3)
    drawn.add_scatter3d(
        **dict(zip("xyz", ends.T, strict=True)),
        mode="lines",
        line={"color": shade, "width": 5 if numbered else 1.5},
        hoverinfo="skip",
        legendgroup=label,
        showlegend=False,
    )
    drawn.add_scatter3d(
        **dict(zip("xyz", cameras.T, strict=True)),
        name=label,
        legendgroup=label,
        mode="markers+text" if numbered else "markers",
        marker={"color": shade, "size": 6 if numbered else 3.5},
        text=[str(number) for number in range(1, len(cameras) + 1)] if numbered else None,
        textposition="top center",
        textfont={"color": shade},
        hovertext=hover,
        hovertemplate="%{hovertext}<extra></extra>",
    )


def _add_grid(drawn: go.Figure, pole: Array, farthest: float, compass: bool) -> Array:
    """Add circles about the pole and lines from it, as far as the views reach, and return their points (m, 3)."""
    step = 10.0 if farthest <= 40.0 else 30.0
    angles = np.arange(1, max(1, int(np.ceil(farthest / step - 1e-9))) + 1) * step
    # With the pole at z they are east and north.
    aside = np.array([1.0, 0.0, 0.0]) if abs(pole[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    right = aside - (aside @ pole) * pole
    right /= np.linalg.norm(right)
    ahead = np.cross(pole, right)

    def place(tilt: Array, turn: Array) -> Array:
        around = np.cos(turn)[:, None] * right + np.sin(turn)[:, None] * ahead
        found: Array = np.cos(tilt)[:, None] * pole + np.sin(tilt)[:, None] * around
        return found

    turns, gap = np.linspace(0.0, 2 * np.pi, _STEPS), np.full((1, 3), np.nan)
    lines = [place(np.full(_STEPS, np.radians(angle)), turns) for angle in angles]
    tilts = np.linspace(0.0, np.radians(angles[-1]), _STEPS)
    lines += [place(tilts, np.full(_STEPS, 2 * np.pi * i / _MERIDIANS)) for i in range(_MERIDIANS)]
    broken = np.concatenate([part for line in lines for part in (line, gap)])
    drawn.add_scatter3d(
        **dict(zip("xyz", broken.T, strict=True)),
        mode="lines",
        line={"color": _GRID, "width": 1},
        hoverinfo="skip",
        showlegend=False,
    )
    marks = place(np.radians(angles), np.full(len(angles), np.pi / 4))
    texts = [f"{angle:g}°" for angle in angles]
    if compass:
        marks = np.concatenate([marks, 1.06 * place(np.full(4, np.radians(angles[-1])), np.arange(4) * np.pi / 2)])
        texts += ["E", "N", "W", "S"]
    drawn.add_scatter3d(
        **dict(zip("xyz", marks.T, strict=True)),
        mode="text",
        text=texts,
        textfont={"color": NEUTRAL},
        hoverinfo="skip",
        showlegend=False,
    )
    return np.concatenate(lines)
