"""Matches between pictures, and which pictures they connect."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError
from toolkit.plots.curves import thinned
from toolkit.plots.pictures import eight_bit, picture_trace
from toolkit.plots.style import COLOURS, figure, shown

Array = NDArray[np.float64]

#: Share of the first picture's width that lies between the two.
_GAP = 0.03
_INLIER, _OUTLIER = COLOURS[2], COLOURS[1]


def matches_figure(
    first: NDArray[np.generic],
    second: NDArray[np.generic],
    first_pixels: ArrayLike,
    second_pixels: ArrayLike,
    *,
    inlier: ArrayLike | None = None,
    most: int = 150,
    title: str = "",
) -> go.Figure:
    """Draw two photos side by side with a line from each matched pixel to its partner.

    Parameters
    ----------
    first, second:
        Photos (H, W, 3), floats in 0..1 or uint8; their sizes may differ.
    first_pixels, second_pixels:
        (N, 2) matched pixels, centres at +0.5.
    inlier:
        (N,) whether each match was verified; left out, all have one colour.
    most:
        Most lines drawn, evenly from all; the title says how many there are.
    title:
        What the title begins with.

    Raises
    ------
    DataError
        For pixels or flags that do not correspond.
    """
    left, right = eight_bit(first), eight_bit(second)
    start, end, good = _checked(first_pixels, second_pixels, inlier)
    width = left.shape[1]
    shift = width * (1 + _GAP)
    height = max(left.shape[0], right.shape[0])
    keep = thinned(len(start), most) if len(start) else np.empty(0, np.int64)
    heading = _counts(len(start), good, len(keep))
    drawn = figure(" · ".join(part for part in (title, heading) if part), 420, margin={"l": 8, "r": 8, "t": 44})
    drawn.add_trace(picture_trace(left))
    drawn.add_trace(picture_trace(right, shift))
    kinds = [("matches", _INLIER, "solid", np.ones(len(start), bool))]
    if good is not None:
        # The verified ones come last, so that they are on top.
        kinds = [("not verified", _OUTLIER, "dot", ~good), ("verified", _INLIER, "solid", good)]
    for label, colour, dash, chosen in kinds:
        rows = keep[chosen[keep]]
        if len(rows):
            ends = np.stack([start[rows], end[rows] + [shift, 0.0], np.full((len(rows), 2), np.nan)], axis=1)
            drawn.add_scatter(
                x=ends[:, :, 0].ravel(),
                y=ends[:, :, 1].ravel(),
                name=label,
                mode="lines+markers",
                line={"color": colour, "width": 1, "dash": dash},
                marker={"color": colour, "size": 4},
                opacity=0.8,
                hoverinfo="skip",
            )
    drawn.update_layout(showlegend=good is not None, legend={"y": 0.0})
    drawn.update_xaxes(range=[0, shift + right.shape[1]], visible=False, constrain="domain")
    drawn.update_yaxes(range=[height, 0], visible=False, scaleanchor="x", constrain="domain")
    return drawn


def match_graph_figure(names: Sequence[str], index: ArrayLike, inliers: ArrayLike) -> go.Figure:
    """Draw which frames verified matches connect: a square of all frames against all frames.

    Parameters
    ----------
    names:
        Of the frames, in their order.
    index:
        (P, 2) indices of frames that were tried, each pair once.
    inliers:
        (P,) verified matches of each pair, 0 where its geometry was not found. Pairs that were not tried are blank.

    Raises
    ------
    DataError
        For pairs and counts that do not correspond, or pairs of frames that have no name.
    """
    pairs = np.asarray(index, dtype=np.int64).reshape(-1, 2)
    counts = np.asarray(inliers, dtype=np.int64).ravel()
    if len(pairs) != len(counts):
        raise DataError("Pairs and counts do not correspond", expected=f"{len(pairs)}", found=f"{len(counts)}")
    if len(pairs) and not 0 <= pairs.min() <= pairs.max() < len(names):
        raise DataError("Pairs name frames that there are not", expected=f"indices below {len(names)}")
    square = np.full((len(names), len(names)), np.nan)
    square[pairs[:, 0], pairs[:, 1]] = square[pairs[:, 1], pairs[:, 0]] = counts
    connected = int(np.sum(counts > 0))
    drawn = figure(f"{connected} of {len(pairs)} pairs verified", 480, margin={"l": 16, "r": 16, "b": 56})
    labels = [shown(name) for name in names]
    drawn.add_heatmap(
        # Blank is a gap, and nothing that JSON cannot hold.
        z=[[None if np.isnan(value) else int(value) for value in row] for row in square],
        customdata=[[f"{a} – {b}" for b in labels] for a in labels],
        colorscale="Viridis",
        zmin=0,
        colorbar={"title": {"text": "verified<br>matches"}, "thickness": 14},
        hoverongaps=False,
        hovertemplate="%{customdata}: %{z}<extra></extra>",
    )
    drawn.update_xaxes(title_text="frame", constrain="domain", showgrid=False)
    drawn.update_yaxes(
        title_text="frame", autorange="reversed", scaleanchor="x", constrain="domain", showgrid=False
    )
    return drawn


def _checked(
    first: ArrayLike, second: ArrayLike, inlier: ArrayLike | None
) -> tuple[Array, Array, NDArray[np.bool_] | None]:
    start = np.asarray(first, dtype=np.float64).reshape(-1, 2)
    end = np.asarray(second, dtype=np.float64).reshape(-1, 2)
    good = None if inlier is None else np.asarray(inlier, dtype=np.bool_).ravel()
    if len(start) != len(end) or (good is not None and len(good) != len(start)):
        raise DataError(
            "Matched pixels do not correspond",
            expected="(N, 2), (N, 2) and (N,)",
            found=f"{start.shape}, {end.shape}" + ("" if good is None else f" and {good.shape}"),
        )
    return start, end, good


def _counts(total: int, good: NDArray[np.bool_] | None, drawn: int) -> str:
    text = f"{total} matches"
    if good is not None:
        text += f", {int(good.sum())} verified"
    return text if drawn == total else f"{text}, {drawn} drawn"
