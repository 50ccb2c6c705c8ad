"""Which pictures verified matches connect, drawn where they were taken."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from numpy.typing import ArrayLike, NDArray
from plotly.colors import sample_colorscale

from toolkit.errors import DataError
from toolkit.plots.style import COLOURS, figure, shown

Array = NDArray[np.float64]

_SCALE = "Viridis"
#: Lines of about the same number of inliers are one trace: a browser draws few long ones faster than many short.
_CLASSES = 8
#: Lines drawn at most, those with the most inliers.
MOST_LINES = 4000


def match_map_figure(
    names: Sequence[str], places: ArrayLike | None, index: ArrayLike, inliers: ArrayLike, unit: str = ""
) -> go.Figure:
    """Draw frames from above with a line for each verified pair, coloured by its number of inliers.

    Parameters
    ----------
    names:
        Of the frames, in their order.
    places:
        (F, 2) where they were taken, NaN where that is not known; None: in a circle, in their order.
    index:
        (P, 2) indices of the frames of verified pairs.
    inliers:
        (P,) verified matches of each.
    unit:
        Of the places.

    Raises
    ------
    DataError
        For pairs, counts and places that do not correspond.
    """
    pairs = np.asarray(index, dtype=np.int64).reshape(-1, 2)
    counts = np.asarray(inliers, dtype=np.int64).ravel()
    xy = _circle(len(names)) if places is None else np.asarray(places, dtype=np.float64).reshape(-1, 2)
    _check(names, xy, pairs, counts)
    drawable = np.isfinite(xy[:, 0]) & np.isfinite(xy[:, 1])
    usable = np.flatnonzero(drawable[pairs[:, 0]] & drawable[pairs[:, 1]])
    order = usable[np.argsort(counts[usable], kind="stable")][-MOST_LINES:]
    title = f"{len(pairs):,} verified pairs of {len(names)} photos"
    if len(order) < len(pairs):
        title += f", {len(order):,} drawn"
    drawn = figure(title, 520, showlegend=False)
    _add_lines(drawn, xy, pairs[order], counts[order])
    linked = np.bincount(pairs.ravel(), minlength=len(names)) if len(pairs) else np.zeros(len(names), dtype=int)
    alone = linked == 0
    drawn.add_scatter(
        x=xy[drawable, 0],
        y=xy[drawable, 1],
        mode="markers",
        marker={
            "size": 9,
            "color": [COLOURS[6] if lonely else COLOURS[0] for lonely in alone[drawable]],
            "symbol": ["x" if lonely else "circle" for lonely in alone[drawable]],
            "line": {"width": 1, "color": "rgba(255,255,255,0.7)"},
        },
        text=[f"{shown(names[i])}: {linked[i]} pairs" for i in np.flatnonzero(drawable).tolist()],
        hovertemplate="%{text}<extra></extra>",
    )
    _add_scale(drawn, counts)
    with_unit = f" [{unit}]" if unit else ""
    drawn.update_xaxes(
        title_text=f"east{with_unit}" if unit else "", constrain="domain", visible=places is not None
    )
    drawn.update_yaxes(title_text=f"north{with_unit}" if unit else "", scaleanchor="x", visible=places is not None)
    return drawn


def _add_lines(drawn: go.Figure, xy: Array, pairs: NDArray[np.int64], counts: NDArray[np.int64]) -> None:
    """Add the lines from the fewest inliers to the most, which so lie on top."""
    most = max(1, int(counts.max(initial=1)))
    shares = np.log1p(counts) / np.log1p(most)
    classes = np.minimum((shares * _CLASSES).astype(int), _CLASSES - 1)
    for number in range(_CLASSES):
        chosen = np.flatnonzero(classes == number)
        if not len(chosen):
            continue
        ends = np.full((len(chosen), 3, 2), np.nan)
        ends[:, :2] = xy[pairs[chosen]]
        line = ends.reshape(-1, 2)
        drawn.add_scattergl(
            x=line[:, 0],
            y=line[:, 1],
            mode="lines",
            line={"color": sample_colorscale(_SCALE, [(number + 0.5) / _CLASSES])[0], "width": 1 + number / 4},
            opacity=0.35 + 0.6 * number / _CLASSES,
            hoverinfo="skip",
        )


def _add_scale(drawn: go.Figure, counts: NDArray[np.int64]) -> None:
    """Add the bar that tells the colours, which are by the logarithm of the inliers."""
    most = max(1, int(counts.max(initial=1)))
    ticks = [value for value in (1, 10, 30, 100, 300, 1000, 3000, 10000) if value <= most]
    drawn.add_scatter(
        x=[None],
        y=[None],
        mode="markers",
        hoverinfo="skip",
        marker={
            "colorscale": _SCALE,
            "cmin": 0,
            "cmax": float(np.log1p(most)),
            "color": [0],
            "showscale": True,
            "colorbar": {
                "title": {"text": "inliers"},
                "thickness": 14,
                "tickvals": [float(np.log1p(value)) for value in ticks],
                "ticktext": [f"{value:,}" for value in ticks],
            },
        },
    )


def _circle(count: int) -> Array:
    angles = 2 * np.pi * np.arange(count) / max(1, count)
    return np.stack([np.sin(angles), np.cos(angles)], axis=1)


def _check(names: Sequence[str], xy: Array, pairs: NDArray[np.int64], counts: NDArray[np.int64]) -> None:
    if len(xy) != len(names):
        raise DataError("Frames and places do not correspond", expected=f"{len(names)}", found=f"{len(xy)}")
    if len(pairs) != len(counts):
        raise DataError("Pairs and counts do not correspond", expected=f"{len(pairs)}", found=f"{len(counts)}")
    if len(pairs) and not 0 <= pairs.min() <= pairs.max() < len(names):
        raise DataError("Pairs name frames that there are not", expected=f"indices below {len(names)}")
