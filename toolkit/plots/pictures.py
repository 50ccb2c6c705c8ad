"""Photos beside what was made of them, pixel by pixel."""

from __future__ import annotations

import base64
import io

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from PIL import Image

from toolkit.errors import DataError
from toolkit.plots.style import figure
from toolkit.scene.pictures import area_resize

#: Longer sides are averaged down to this before they are drawn: a screen shows no more, and pages stay light.
LONGEST_SIDE = 1280

_JPEG_QUALITY = 92
# Pixels that the pictures together take across a notebook's page.
_WIDTH = 950


def photo_against_render(
    photo: NDArray[np.generic],
    render: NDArray[np.generic],
    *,
    error: bool = True,
    psnr: float | None = None,
    name: str = "",
) -> go.Figure:
    """Draw a photo, its render and how far apart they are; zooming one zooms all.

    Parameters
    ----------
    photo, render:
        (H, W, 3) of the same size, floats in 0..1 or uint8.
    error:
        Whether to draw the absolute difference, the mean of the three channels in levels of 255.
    psnr:
        In dB, for the title.
    name:
        Of the picture, for the title.

    Raises
    ------
    DataError
        For pictures of other or different shapes.
    """
    first, second = eight_bit(photo), eight_bit(render)
    if first.shape != second.shape:
        raise DataError("Photo and render have different sizes", expected=str(first.shape), found=str(second.shape))
    height, width = first.shape[:2]
    titles = ["photo", "render", "absolute error"][: 3 if error else 2]
    title = " · ".join(part for part in (name, "" if psnr is None else f"PSNR {psnr:.2f} dB") if part)
    tall = 110 + round(_WIDTH / len(titles) * height / width)
    drawn = figure(title, min(tall, 720), margin={"l": 8, "r": 8, "t": 76, "b": 12})
    drawn.set_subplots(
        1, len(titles), shared_xaxes="all", shared_yaxes="all", subplot_titles=titles, horizontal_spacing=0.015
    )
    drawn.update_annotations(font_size=13)
    drawn.add_trace(picture_trace(first), row=1, col=1)
    drawn.add_trace(picture_trace(second), row=1, col=2)
    if error:
        difference = np.abs(first.astype(np.float32) - second).mean(axis=2)
        small = shrunk(difference)
        rows, columns = small.shape
        drawn.add_trace(
            go.Heatmap(
                # A byte a pixel keeps the figure light; the mean of three channels is hardly worth more.
                z=np.rint(small).astype(np.uint8),
                x0=0.5 * width / columns,
                dx=width / columns,
                y0=0.5 * height / rows,
                dy=height / rows,
                zmin=0,
                zmax=max(16.0, float(np.percentile(small, 99))),
                colorscale="Inferno",
                colorbar={"title": {"text": "levels"}, "thickness": 12, "len": 0.9},
                hovertemplate="(%{x:.0f}, %{y:.0f}): %{z} of 255<extra></extra>",
            ),
            row=1,
            col=3,
        )
    # Only the first pair of axes has ranges: the others match it.
    drawn.update_xaxes(range=[0, width], constrain="domain", visible=False)
    drawn.update_yaxes(range=[height, 0], constrain="domain", visible=False, scaleanchor="x")
    return drawn


def picture_trace(picture: NDArray[np.uint8], left: float = 0.0) -> go.Image:
    """Return a picture (H, W, 3) uint8 as a trace: its top-left pixel's centre is at (``left`` + 0.5, 0.5)."""
    height, width = picture.shape[:2]
    small = shrunk(picture)
    memory = io.BytesIO()
    Image.fromarray(small).save(memory, "JPEG", quality=_JPEG_QUALITY, subsampling=0)
    source = "data:image/jpeg;base64," + base64.b64encode(memory.getvalue()).decode("ascii")
    rows, columns = small.shape[:2]
    return go.Image(
        source=source,
        x0=left + 0.5 * width / columns,
        dx=width / columns,
        y0=0.5 * height / rows,
        dy=height / rows,
        hoverinfo="skip",
    )


def eight_bit(picture: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) as uint8; floats in 0..1 are scaled, and clipped as a screen does.

    Raises
    ------
    DataError
        For another shape or type, or values that are not finite.
    """
    values = np.asarray(picture)
    if values.ndim != 3 or values.shape[2] != 3 or values.size == 0:
        raise DataError("Picture has the wrong shape", expected="(H, W, 3)", found=str(values.shape))
    if values.dtype == np.uint8:
        return values
    if not np.issubdtype(values.dtype, np.floating):
        raise DataError("Picture has the wrong type", expected="uint8, or floats in 0..1", found=str(values.dtype))
    if not np.isfinite(values).all():
        raise DataError("Picture is not finite", expected="floats in 0..1", found="NaN or infinity")
    made: NDArray[np.uint8] = np.rint(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)
    return made


def shrunk(picture: NDArray) -> NDArray:
    """Return a picture (H, W) or (H, W, C) averaged down to :data:`LONGEST_SIDE`, or as it is."""
    height, width = picture.shape[:2]
    factor = LONGEST_SIDE / max(height, width)
    if factor >= 1:
        return picture
    return area_resize(picture, max(1, round(width * factor)), max(1, round(height * factor)))
