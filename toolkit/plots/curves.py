"""Measurements over steps or time."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import plotly.graph_objects as go
from numpy.typing import ArrayLike, NDArray

from toolkit.plots.style import colour, dash, figure, shown

#: Most points drawn of one curve: more cannot be told apart on a screen and make pages heavy.
MOST_POINTS = 1500


def curve_figure(
    curves: Mapping[str, tuple[ArrayLike, ArrayLike]], *, title: str, x_title: str, log: bool = False
) -> go.Figure:
    """Draw one line a run.

    Parameters
    ----------
    curves:
        By label, x (N,) ascending and y (N,). A label without points keeps its colour for the next figure.
    title, x_title:
        What is measured, and over what.
    log:
        Whether the values are drawn on a logarithmic axis.
    """
    drawn = figure(title, 300, showlegend=len(curves) > 1, hovermode="x unified")
    for position, (label, (x, y)) in enumerate(curves.items()):
        xs, ys = np.asarray(x), np.asarray(y, dtype=np.float64)
        if not len(xs):
            continue
        keep = thinned(len(xs))
        drawn.add_scatter(
            x=xs[keep],
            y=ys[keep],
            name=shown(label),
            mode="lines" if len(xs) > 1 else "markers",
            line={"color": colour(position), "width": 2, "dash": dash(position)},
            marker={"color": colour(position), "size": 8},
        )
    drawn.update_xaxes(title_text=x_title)
    if log:
        drawn.update_yaxes(type="log", dtick=_log_ticks(drawn), tickformat="~g")
    return drawn


def _log_ticks(drawn: go.Figure) -> str:
    """Return Plotly's code for labels at 1, 2, 5, or at every digit where that might leave an axis without any."""
    values = np.concatenate([np.empty(0), *(np.asarray(line.y, dtype=np.float64) for line in drawn.data)])
    values = values[np.isfinite(values) & (values > 0)]
    return "D2" if len(values) and values.max() > 10 * values.min() else "D1"


def thinned(count: int, most: int = MOST_POINTS) -> NDArray[np.int64]:
    """Return at most ``most`` evenly spread positions of ``count``, first and last included."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))
