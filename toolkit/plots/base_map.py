"""The cameras of a capture from above, over a grid in metres."""

from __future__ import annotations

import math

import numpy as np
import plotly.graph_objects as go

from toolkit.plots.scene_map import scene_map
from toolkit.plots.style import NEUTRAL
from toolkit.scene import Scene

#: Lines of the grid along the longer side, at least, and the share of that side that the scale bar takes at most.
_LINES, _BAR = 5, 0.3
#: Room around the cameras, of the longer side.
_MARGIN = 0.12


def base_map(scene: Scene, *, reference: Scene | None = None, points: bool = True) -> go.Figure:
    """Draw the top view of a scene over grid lines at round metres, with a scale bar and an arrow to the north.

    Without a georeference the world's axes mean nothing: then there are grid lines in its own units, and neither
    bar nor arrow.

    Parameters
    ----------
    scene, reference, points:
        As for :func:`toolkit.plots.scene_map.scene_map`.
    """
    drawn = scene_map(scene, reference=reference, points=points, top_view=True)
    if scene.georeference is None:
        return drawn
    places = _places(drawn)
    if not len(places):
        return drawn
    low, high = places.min(axis=0), places.max(axis=0)
    side = max(float((high - low).max()), 1.0)
    step = round_length(side / _LINES)
    line = {"dtick": step, "tick0": 0, "showgrid": True, "griddash": "dot"}
    margin = _MARGIN * side
    drawn.update_xaxes(**line, range=[low[0] - margin, high[0] + margin])
    drawn.update_yaxes(**line, range=[low[1] - 2 * margin, high[1] + margin])
    _add_scale_bar(drawn, (float(low[0]), float(low[1]) - 1.4 * margin), round_length(_BAR * side), 0.02 * side)
    drawn.add_annotation(
        text="N ↑", x=1, y=1, xref="paper", yref="paper", showarrow=False, font={"size": 16}, xanchor="right"
    )
    return drawn


def round_length(metres: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is not above ``metres``, which is above 0."""
    power = 10.0 ** math.floor(math.log10(metres))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= metres * (1 + 1e-9))


def _add_scale_bar(drawn: go.Figure, corner: tuple[float, float], length: float, tick: float) -> None:
    x, y = corner
    drawn.add_scatter(
        x=[x, x, None, x, x + length, None, x + length, x + length],
        y=[y - tick, y + tick, None, y, y, None, y - tick, y + tick],
        mode="lines",
        line={"color": NEUTRAL, "width": 2},
        name="scale bar",
        showlegend=False,
        hoverinfo="skip",
    )
    drawn.add_annotation(text=f"{length:g} m", x=x + length, y=y, xanchor="left", showarrow=False, xshift=6)


def _places(drawn: go.Figure) -> np.ndarray:
    """Return where everything is that is drawn, (N, 2), without gaps."""
    parts = [
        np.stack([np.asarray(trace.x, dtype=np.float64), np.asarray(trace.y, dtype=np.float64)], axis=1)
        for trace in drawn.data
        if trace.name != "points" and trace.x is not None
    ]
    places = np.concatenate([np.empty((0, 2)), *parts])
    return places[np.isfinite(places).all(axis=1)]
