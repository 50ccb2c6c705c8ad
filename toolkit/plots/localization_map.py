"""Where queries were found, seen from above."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.rigid import RigidTransform
from toolkit.plots.curves import thinned
from toolkit.plots.style import COLOURS, NEUTRAL, figure, shown
from toolkit.scene import Points

Array = NDArray[np.float64]

_MOST_POINTS: Final = 20_000
#: Share of the drawing that the median error arrow takes, where errors are too small to be seen.
_ARROW: Final = 0.04


def found_positions_figure(
    found: Mapping[str, RigidTransform | None],
    truth: Mapping[str, RigidTransform],
    *,
    starts: Mapping[str, RigidTransform] | None = None,
    points: Points | None = None,
    title: str = "",
) -> go.Figure:
    """Draw from above where queries were found, an arrow from each true position to the found one.

    Arrows are stretched where they would be too short to be seen, all by the same factor, which the title tells.
    A query that was not found is a cross where it truly was.

    Parameters
    ----------
    found:
        ``cam_from_world`` by the name of the query, None where it was not found.
    truth:
        True ``cam_from_world``; queries are those that ``found`` names.
    starts:
        Where the search began, drawn faintly.
    points:
        Of the map, drawn below all else.
    title:
        What the title begins with.

    Raises
    ------
    DataError
        For a query without true pose.
    """
    unknown = [name for name in found if name not in truth]
    if unknown:
        raise DataError(
            f"Query '{unknown[0]}' has no true pose", expected="one for each query", found=f"{len(unknown)} without"
        )
    placed = {name: pose.centre for name, pose in found.items() if pose is not None}
    lost = [name for name in found if name not in placed]
    true = np.array([truth[name].centre for name in placed]).reshape(-1, 3)
    off = np.array(list(placed.values())).reshape(-1, 3) - true
    everything = np.array([truth[name].centre for name in found]).reshape(-1, 3)
    factor = _stretch(off, everything)
    heading = [title, f"{len(placed)} of {len(found)} found"]
    if factor > 1:
        heading.append(f"arrows {factor:g} times as long as the errors")
    drawn = figure(" · ".join(part for part in heading if part), 560, showlegend=True)
    if points is not None and len(points):
        drawn.add_trace(_ground(points))
    if starts:
        begun = np.array([starts[name].centre for name in found if name in starts]).reshape(-1, 3)
        drawn.add_scatter(
            x=begun[:, 0],
            y=begun[:, 1],
            name="starts",
            mode="markers",
            hoverinfo="skip",
            marker={"color": NEUTRAL, "size": 6},
            opacity=0.6,
        )
    _add_arrows(drawn, true, off, factor)
    drawn.add_scatter(
        x=true[:, 0],
        y=true[:, 1],
        name="true, found",
        mode="markers",
        marker={"color": COLOURS[0], "size": 6},
        text=[shown(name) for name in placed],
        customdata=np.linalg.norm(off, axis=1),
        hovertemplate="%{text}: %{customdata:.3f} m off<extra></extra>",
    )
    if lost:
        where = np.array([truth[name].centre for name in lost])
        drawn.add_scatter(
            x=where[:, 0],
            y=where[:, 1],
            name="not found",
            mode="markers",
            marker={"color": COLOURS[6], "size": 9, "symbol": "x"},
            text=[shown(name) for name in lost],
            hovertemplate="%{text}<extra>not found</extra>",
        )
    drawn.update_xaxes(title_text="east [m]", constrain="domain")
    drawn.update_yaxes(title_text="north [m]", scaleanchor="x", scaleratio=1)
    return drawn


def _stretch(off: Array, everything: Array) -> float:
    """Return by how much arrows are drawn longer than errors (N, 3): 1, 2, 5, 10, ..., so that they can be seen."""
    lengths = np.linalg.norm(off[:, :2], axis=1)
    median = float(np.median(lengths)) if len(lengths) else 0.0
    extent = float(np.linalg.norm(np.ptp(everything[:, :2], axis=0))) if len(everything) else 0.0
    if not (median > 0 and extent > 0):
        return 1.0
    wanted = _ARROW * extent / median
    steps = np.array([m * 10.0**power for power in range(7) for m in (1, 2, 5)])
    return float(steps[steps <= wanted].max(initial=1.0))


def _ground(points: Points) -> go.Scattergl:
    keep = thinned(len(points), _MOST_POINTS)
    # From the lowest to the highest, as they hide each other from above.
    keep = keep[np.argsort(points.xyz[keep, 2], kind="stable")]
    return go.Scattergl(
        x=points.xyz[keep, 0].astype(np.float32),
        y=points.xyz[keep, 1].astype(np.float32),
        name="map",
        mode="markers",
        hoverinfo="skip",
        opacity=0.35,
        marker={"size": 2.5, "color": [f"rgb({r},{g},{b})" for r, g, b in points.rgb[keep].tolist()]},
    )


def _add_arrows(drawn: go.Figure, true: Array, off: Array, factor: float) -> None:
    if not len(true):
        return
    tips = true[:, :2] + factor * off[:, :2]
    lines = np.stack([true[:, :2], tips, np.full_like(tips, np.nan)], axis=1).reshape(-1, 2)
    angles = np.degrees(np.arctan2(off[:, 0], off[:, 1]))
    drawn.add_scatter(
        x=lines[:, 0],
        y=lines[:, 1],
        name="error",
        mode="lines+markers",
        hoverinfo="skip",
        line={"color": COLOURS[1], "width": 1.5},
        # A head at the tip only.
        marker={
            "color": COLOURS[1],
            "symbol": "arrow",
            "size": [0, 9, 0] * len(true),
            "angle": np.repeat(angles, 3),
        },
    )
