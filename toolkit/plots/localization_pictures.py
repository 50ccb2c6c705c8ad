"""A query beside what a map renders from its pose: the two, how they fit, and what was matched."""

from __future__ import annotations

from typing import Final

import numpy as np
import plotly.graph_objects as go
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError
from toolkit.plots.matches import matches_figure
from toolkit.plots.pictures import eight_bit, picture_trace
from toolkit.plots.style import figure

# Pixels that the pictures together take across a notebook's page.
_WIDTH: Final = 950
#: What is left of the colour of pixels that may not be back-projected, and the shade that the rest becomes.
_KEPT, _SHADE = 0.35, np.array([200.0, 60.0, 60.0])
_NAMES: Final = {"verified": "inliers of PnP", "not verified": "outliers", "matches": "matches"}


def render_against_query(
    query: NDArray[np.generic],
    render: NDArray[np.generic],
    *,
    reliable: NDArray[np.bool_] | None = None,
    tiles: int = 8,
    title: str = "",
) -> go.Figure:
    """Draw a query, the render from its pose, and both in turn as a chessboard; zooming one zooms all.

    Where the pose is right, edges run on from field to field of the chessboard.

    Parameters
    ----------
    query, render:
        (H, W, 3) of the same size, floats in 0..1 or uint8.
    reliable:
        (H, W) pixels of the render that may be back-projected; the others are shaded red in it.
    tiles:
        Fields across the longer side.
    title:
        Of the figure.

    Raises
    ------
    DataError
        For pictures or masks of other or different shapes, and fewer than two fields.
    """
    photo, seen = eight_bit(query), eight_bit(render)
    if photo.shape != seen.shape:
        raise DataError("Query and render have different sizes", expected=str(photo.shape), found=str(seen.shape))
    height, width = photo.shape[:2]
    board = _chessboard(height, width, tiles)
    both = np.where(board[:, :, None], photo, seen)
    if reliable is not None:
        seen = _shaded(seen, reliable)
    names = ["query", "render" if reliable is None else "render, unreliable pixels red", "in turn"]
    drawn = figure(
        title, min(110 + round(_WIDTH / 3 * height / width), 720), margin={"l": 8, "r": 8, "t": 76, "b": 12}
    )
    drawn.set_subplots(1, 3, shared_xaxes="all", shared_yaxes="all", subplot_titles=names, horizontal_spacing=0.015)
    drawn.update_annotations(font_size=13)
    for column, picture in enumerate((photo, seen, both)):
        drawn.add_trace(picture_trace(picture), row=1, col=column + 1)
    # Only the first pair of axes has ranges: the others match it. Rows count downwards.
    drawn.update_xaxes(range=[0, width], constrain="domain", visible=False)
    drawn.update_yaxes(range=[height, 0], constrain="domain", visible=False, scaleanchor="x")
    return drawn


def localization_matches_figure(
    query: NDArray[np.generic],
    render: NDArray[np.generic],
    query_pixels: ArrayLike,
    render_pixels: ArrayLike,
    *,
    inlier: ArrayLike | None = None,
    most: int = 150,
    title: str = "",
) -> go.Figure:
    """Draw a query and a render side by side, with a line for each match: inliers of PnP, and outliers.

    Parameters
    ----------
    query, render:
        (H, W, 3), floats in 0..1 or uint8; their sizes may differ.
    query_pixels, render_pixels:
        (N, 2) matched pixels, centres at +0.5.
    inlier:
        (N,) whether each match agrees with the pose that was found; left out, all have one colour.
    most:
        Most lines drawn.
    title:
        What the title begins with; how many matches there are follows.

    Raises
    ------
    DataError
        For pixels or flags that do not correspond.
    """
    flags = None if inlier is None else np.asarray(inlier, dtype=np.bool_).ravel()
    drawn = matches_figure(query, render, query_pixels, render_pixels, inlier=flags, most=most, title=title)
    for trace in drawn.select_traces(selector={"type": "scatter"}):
        trace.name = _NAMES[trace.name]
    drawn.update_layout(title_text=drawn.layout.title.text.replace(" verified", " inliers"))
    for text, axis in (("query", 0.0), ("render", 1.0)):
        drawn.add_annotation(
            text=text,
            x=axis,
            y=1.0,
            xref="x domain",
            yref="y domain",
            showarrow=False,
            yanchor="bottom",
            xanchor="left" if axis == 0.0 else "right",
        )
    return drawn


def _chessboard(height: int, width: int, tiles: int) -> NDArray[np.bool_]:
    """Return (H, W) which fields show the first picture; fields are square."""
    if tiles < 2:
        raise DataError(
            "A chessboard needs fields of both pictures", expected="at least 2 across", found=str(tiles)
        )
    side = max(height, width) / tiles
    row, column = (np.arange(count) // side for count in (height, width))
    white: NDArray[np.bool_] = (row[:, None] + column) % 2 == 0
    return white


def _shaded(picture: NDArray[np.uint8], reliable: NDArray[np.bool_]) -> NDArray[np.uint8]:
    mask = np.asarray(reliable, dtype=np.bool_)
    if mask.shape != picture.shape[:2]:
        raise DataError(
            "Render and its reliable pixels have different sizes",
            expected=str(picture.shape[:2]),
            found=str(mask.shape),
        )
    red = np.rint(_KEPT * picture + (1 - _KEPT) * _SHADE).astype(np.uint8)
    return np.where(mask[:, :, None], picture, red)
