"""Which frames were matched with which: inliers as a picture, frame by frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import plotly.graph_objects as go
from numpy.typing import ArrayLike, NDArray
from plotly.colors import sample_colorscale

from toolkit.errors import DataError
from toolkit.plots.style import COLOURS, figure, shown

Integers = NDArray[np.int64]

#: Viridis without its darkest part, which dark pages swallow.
_SCALE = [
    [place, sample_colorscale("Viridis", [0.12 + 0.88 * place])[0]] for place in np.linspace(0, 1, 12).tolist()
]
#: Colours that Viridis does not have.
_OUTLINES = ((COLOURS[6], "solid"), (COLOURS[1], "dot"))
_BAND = COLOURS[3]
_TICKS = (1, 3, 6, 15, 30, 60, 100, 200, 400, 1000, 2000, 5000, 10000)
#: With more frames than this, lines between the cells would cover them.
_MOST_WITH_GAPS = 60


def match_heat_figure(
    names: Sequence[str],
    index: ArrayLike,
    inliers: ArrayLike,
    *,
    window: int | None = None,
    closed: bool = False,
    outlined: Mapping[str, ArrayLike] | None = None,
) -> go.Figure:
    """Draw the inliers of each pair of frames, colours by their logarithm; pairs without a match stay empty.

    Right matches of a sequence lie in a band along the diagonal, and in two corners where it closes. Stripes beside
    it are frames that look alike (Blade inspection, section 4.2).

    Parameters
    ----------
    names:
        Of the frames, in their order.
    index:
        (P, 2) indices of the frames of verified pairs.
    inliers:
        (P,) verified matches of each.
    window:
        Frames so far apart at most are expected to match: drawn as lines along the diagonal; None: not drawn.
    closed:
        The band goes on from the last frame to the first.
    outlined:
        Pairs (K, 2) by what the legend calls them, for example those that were found to be wrong; drawn with a line
        around neighbouring ones. At most two kinds.

    Raises
    ------
    DataError
        For pairs and counts that do not correspond, and pairs of frames that there are not.
    """
    pairs, counts = _pairs(index, len(names)), np.asarray(inliers, dtype=np.int64).ravel()
    if len(pairs) != len(counts):
        raise DataError("Pairs and counts do not correspond", expected=f"{len(pairs)}", found=f"{len(counts)}")
    pairs, counts = pairs[counts > 0], counts[counts > 0]
    drawn = figure(
        f"{len(pairs):,} verified pairs of {len(names)} frames",
        640,
        legend={"y": -0.1},
        margin={"r": 24, "b": 72},
        hovermode="closest",
    )
    drawn.add_trace(_heat(names, pairs, counts))
    if window is not None:
        _add_band(drawn, len(names), window, closed)
    for (label, marked), (colour, dash) in zip((outlined or {}).items(), _OUTLINES, strict=False):
        chosen = _pairs(marked, len(names))
        x, y = _outline(chosen, pairs, len(names))
        drawn.add_scatter(
            x=x,
            y=y,
            mode="lines",
            name=f"{shown(label)}: {len(chosen):,}",
            showlegend=True,
            line={"color": colour, "width": 1.6, "dash": dash},
            hoverinfo="skip",
        )
    side = {"constrain": "domain", "showgrid": False, "title": {"text": "frame"}}
    drawn.update_xaxes(range=[-0.5, len(names) - 0.5], **side)
    drawn.update_yaxes(range=[len(names) - 0.5, -0.5], scaleanchor="x", **side)
    return drawn


def _heat(names: Sequence[str], pairs: Integers, counts: Integers) -> go.Heatmap:
    count = len(names)
    # None rather than NaN, which a FigureWidget cannot send to the page in a matrix.
    values = np.full((count, count), None, dtype=object)
    texts = np.full((count, count), None, dtype=object)
    for (i, j), found in zip(pairs.tolist(), counts.tolist(), strict=True):
        values[i, j] = values[j, i] = float(np.log10(found))
        texts[i, j] = texts[j, i] = f"{i} {shown(names[i])}<br>{j} {shown(names[j])}<br>{found:,} inliers"
    low, high = (int(counts.min()), int(counts.max())) if len(counts) else (1, 10)
    ticks = [value for value in _TICKS if low <= value <= high] or [low]
    gap = 1 if count <= _MOST_WITH_GAPS else 0
    return go.Heatmap(
        z=values,
        text=texts,
        hovertemplate="%{text}<extra></extra>",
        hoverongaps=False,
        xgap=gap,
        ygap=gap,
        colorscale=_SCALE,
        zmin=float(np.log10(low)),
        # One value alone would leave the scale without length.
        zmax=float(np.log10(max(high, low + 1))),
        colorbar={
            "title": {"text": "inliers"},
            "thickness": 14,
            "tickvals": np.log10(ticks).tolist(),
            "ticktext": [f"{value:,}" for value in ticks],
        },
    )


def _add_band(drawn: go.Figure, count: int, window: int, closed: bool) -> None:
    """Draw the borders of the band: half a cell beyond the last frame that is expected to match."""
    off, first, last = window + 0.5, -0.5, count - 0.5
    x: list[float | None] = []
    y: list[float | None] = []
    for shift in (off, *((count - off,) if closed and count > 2 * off else ())):
        if shift < count:
            x += [first + shift, last, None, first, last - shift, None]
            y += [first, last - shift, None, first + shift, last, None]
    drawn.add_scatter(
        x=x,
        y=y,
        mode="lines",
        name=f"expected: {window} frames apart" + (", around" if closed else ""),
        showlegend=True,
        line={"color": _BAND, "width": 2, "dash": "dash"},
        hoverinfo="skip",
    )


def _outline(chosen: Integers, matched: Integers, count: int) -> tuple[list[float | None], list[float | None]]:
    """Return lines around the cells of chosen pairs: edges between a cell that is marked and one that is not."""
    marked, empty = _cells(chosen, count), ~_cells(matched, count)
    # Pairs without a match are holes in a large region of marked ones: a line around each would hide it.
    for _ in range(2):
        beside = sum(np.roll(marked, step, axis).astype(int) for step in (-1, 1) for axis in (0, 1))
        marked |= empty & (beside >= 3)
    x: list[float | None] = []
    y: list[float | None] = []
    # Edges above rows, then left of columns; cells begin at -0.5, the frame of zeros around them one before.
    for row, column in np.argwhere(marked[1:, :] != marked[:-1, :]).tolist():
        x += [column - 1.5, column - 0.5, None]
        y += [row - 0.5, row - 0.5, None]
    for row, column in np.argwhere(marked[:, 1:] != marked[:, :-1]).tolist():
        x += [column - 0.5, column - 0.5, None]
        y += [row - 1.5, row - 0.5, None]
    return x, y


def _cells(pairs: Integers, count: int) -> NDArray[np.bool_]:
    """Return (count + 2, count + 2) where pairs are, with a border of cells that are none."""
    cells = np.zeros((count + 2, count + 2), dtype=np.bool_)
    cells[pairs[:, 0] + 1, pairs[:, 1] + 1] = cells[pairs[:, 1] + 1, pairs[:, 0] + 1] = True
    return cells


def _pairs(index: ArrayLike, count: int) -> Integers:
    pairs = np.asarray(index, dtype=np.int64).reshape(-1, 2)
    if len(pairs) and not 0 <= pairs.min() <= pairs.max() < count:
        raise DataError("Pairs name frames that there are not", expected=f"indices below {count}")
    return pairs
