"""What a method renders beside the photo: its picture, its depth, and how wrong that is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.plots.pictures import eight_bit, picture_trace
from toolkit.plots.style import figure, shown

Image = NDArray[np.floating]

_WIDTH = 950
_DEPTH, _ERROR = "viridis", "inferno"


def rendered_depth_figure(
    photo: NDArray[np.generic],
    methods: Mapping[str, tuple[NDArray[np.generic], Image]],
    truth: Image,
    *,
    unit: str = "m",
    title: str = "",
) -> go.Figure:
    """Draw a row for each method: photo, render, depth, and the distance of that from the true depth.

    All depths are in one scale, and all errors; where a depth or the true one is not known, nothing is drawn.

    Parameters
    ----------
    photo:
        (H, W, 3), floats of 0 to 1 or uint8.
    methods:
        Of each by its name the render (H, W, 3) and the depth (H, W).
    truth:
        (H, W) true depth; 0 and what is not finite is not known.
    unit:
        Of the depths.

    Raises
    ------
    DataError
        Without methods, for pictures of different sizes, and where no true depth is known.
    """
    sizes = {photo.shape[:2], truth.shape} | {part.shape[:2] for pair in methods.values() for part in pair}
    true = _known(truth)
    if not methods or len(sizes) != 1 or not np.isfinite(true).any():
        raise DataError(
            "Renders cannot be drawn beside the truth",
            expected="some methods, pictures of one size and true depth",
            found=f"{len(methods)} methods, sizes {sorted(sizes)}, {int(np.isfinite(true).sum())} true depths",
        )
    errors = {name: np.abs(_known(depth) - true) for name, (_, depth) in methods.items()}
    low, high = np.nanpercentile(true, [1, 99])
    wrong = [values[np.isfinite(values)] for values in errors.values()]
    upper = max((float(np.percentile(values, 95)) for values in wrong if len(values)), default=0.0) or 1.0
    height, width = truth.shape
    tall = round(_WIDTH / 4 * height / width) + 28
    drawn = figure(title, 60 + tall * len(methods), margin={"l": 8, "r": 8, "t": 64 if title else 36, "b": 60})
    names = [text for name in methods for text in ("photo", shown(name), "depth", "its error")]
    drawn.set_subplots(
        len(methods),
        4,
        shared_xaxes="all",
        shared_yaxes="all",
        subplot_titles=names,
        horizontal_spacing=0.012,
        vertical_spacing=28 / (tall * len(methods)),
    )
    drawn.update_annotations(font_size=13)
    for row, (name, (render, depth)) in enumerate(methods.items(), start=1):
        drawn.add_trace(picture_trace(eight_bit(photo)), row=row, col=1)
        drawn.add_trace(picture_trace(eight_bit(render)), row=row, col=2)
        for column, values, axis in ((3, _known(depth), "coloraxis"), (4, errors[name], "coloraxis2")):
            map_ = go.Heatmap(z=values.astype(np.float32), x0=0.5, dx=1, y0=0.5, dy=1, coloraxis=axis)
            drawn.add_trace(map_, row=row, col=column)
    bar = {"orientation": "h", "thickness": 12, "len": 0.23, "y": 0.0, "yanchor": "top", "ypad": 6}
    drawn.update_layout(
        coloraxis={
            "colorscale": _DEPTH,
            "reversescale": True,
            "cmin": float(low),
            "cmax": float(high),
            "colorbar": {**bar, "x": 0.62, "title": _below(f"depth in {shown(unit)}")},
        },
        coloraxis2={
            "colorscale": _ERROR,
            "cmin": 0.0,
            "cmax": upper,
            "colorbar": {**bar, "x": 0.88, "title": _below(f"error in {shown(unit)}")},
        },
    )
    drawn.update_xaxes(range=[0, width], constrain="domain", visible=False)
    drawn.update_yaxes(range=[height, 0], constrain="domain", visible=False, scaleanchor="x")
    return drawn


def _below(text: str) -> dict[str, Any]:
    return {"text": text, "side": "bottom", "font": {"size": 13}}


def _known(depth: Image) -> Image:
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
