"""A mask over a frame, and what a video's pixels do over time beside it."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.plots.pictures import eight_bit, picture_trace
from toolkit.plots.style import COLOURS, figure

# Left out, and neither static nor moving: orange and blue, told apart by all, and seen on grey metal.
_MASKED, _UNDECIDED = COLOURS[1], COLOURS[0]
_COVER = 0.55
_WIDTH = 950


def mask_figure(
    frame: NDArray[np.generic],
    masked: NDArray[np.bool_],
    *,
    undecided: NDArray[np.bool_] | None = None,
    mean: NDArray[np.float64] | None = None,
    deviation: NDArray[np.float64] | None = None,
    name: str = "",
) -> go.Figure:
    """Draw a mask over a frame, and the statistics that it was made of beside it; zooming one zooms all.

    Parameters
    ----------
    frame:
        (H, W, 3), floats in 0..1 or uint8.
    masked:
        (H, W) True where the frame is left out: covered in orange.
    undecided:
        (H, W) True where nothing tells whether it moves: covered in blue.
    mean, deviation:
        (H, W) of each pixel over time in levels of 255, each a panel of its own where it is given.
    name:
        For the title.

    Raises
    ------
    DataError
        For arrays of different sizes.
    """
    picture = eight_bit(frame)
    height, width = picture.shape[:2]
    for what, array in (("mask", masked), ("undecided", undecided), ("mean", mean), ("deviation", deviation)):
        if array is not None and array.shape != (height, width):
            raise DataError(
                f"Frame and {what} have different sizes", expected=str((height, width)), found=str(array.shape)
            )
    covered = _covered(picture, masked, _MASKED)
    if undecided is not None:
        covered = _covered(covered, undecided & ~masked, _UNDECIDED)
    panels = [("mask over the frame", covered)]
    panels += [
        (title, np.repeat(_grey(array, top)[..., None], 3, axis=2))
        for title, array, top in (("mean over time", mean, 255.0), ("deviation over time", deviation, None))
        if array is not None
    ]
    share = f"{100 * float(masked.mean()):.1f} % left out"
    if undecided is not None:
        share += f", {100 * float((undecided & ~masked).mean()):.1f} % undecided"
    title = f"{name} · {share}" if name else share
    tall = 110 + round(_WIDTH / len(panels) * height / width)
    drawn = figure(title, min(tall, 720), margin={"l": 8, "r": 8, "t": 76, "b": 12})
    drawn.set_subplots(
        1,
        len(panels),
        shared_xaxes="all",
        shared_yaxes="all",
        subplot_titles=[label for label, _ in panels],
        horizontal_spacing=0.015,
    )
    drawn.update_annotations(font_size=13)
    for column, (_, shown) in enumerate(panels, start=1):
        drawn.add_trace(picture_trace(shown), row=1, col=column)
    # Only the first pair of axes has ranges: the others match it.
    drawn.update_xaxes(range=[0, width], constrain="domain", visible=False)
    drawn.update_yaxes(range=[height, 0], constrain="domain", visible=False, scaleanchor="x")
    return drawn


def _covered(picture: NDArray[np.uint8], where: NDArray[np.bool_], colour: str) -> NDArray[np.uint8]:
    paint = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)], dtype=np.float64)
    mixed = np.where(where[..., None], (1 - _COVER) * picture + _COVER * paint, picture)
    return np.rint(mixed).astype(np.uint8)


def _grey(array: NDArray[np.float64], top: float | None) -> NDArray[np.uint8]:
    """Return an array as grey levels; without a fixed top the hundredth part that is brightest is white."""
    white = float(np.quantile(array, 0.99)) if top is None else top
    return np.rint(255 * np.clip(array / max(white, 1e-9), 0, 1)).astype(np.uint8)
