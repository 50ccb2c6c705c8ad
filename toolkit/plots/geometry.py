"""How far surfaces are from the truth: coloured clouds, histograms, precision and recall, depth side by side."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.metrics.geometry import SurfaceErrors
from toolkit.plots.style import colour, figure, shown
from toolkit.plots.trajectories import space

Array = NDArray[np.float64]

#: Most points drawn: a browser turns this many smoothly.
MOST_POINTS = 20_000
#: Longest side of a drawn depth map in pixels.
LONGEST_SIDE = 480
# Even steps of it look even, in print and to the colour-blind, too (Smith and van der Walt, 2015).
_SCALE = "viridis"
_WIDTH = 950
#: Least distance of a histogram, in the largest.
_SPAN = 1e-4


def error_cloud(
    points: Array, errors: Array, *, unit: str = "m", most: float = 0.0, title: str = "", seed: int = 0
) -> go.Figure:
    """Draw points coloured by their distance to the other surface.

    Parameters
    ----------
    points, errors:
        (n, 3) and (n,), for example ``found`` and ``accuracy``, or ``truth`` and ``completeness`` of
        :class:`~toolkit.metrics.geometry.SurfaceErrors`. Thinned by chance to ``MOST_POINTS``.
    unit:
        Of the errors, for the colour bar.
    most:
        Error at the upper end of the scale; 0: that of 95 points in 100.

    Raises
    ------
    DataError
        Without points, or for another number of errors.
    """
    if not len(points) or len(points) != len(errors):
        raise DataError("No errors to draw", expected="one for each point", found=f"{len(errors)} of {len(points)}")
    upper = most or float(np.percentile(errors, 95)) or 1.0
    if len(points) > MOST_POINTS:
        chosen = np.sort(np.random.default_rng(seed).choice(len(points), MOST_POINTS, replace=False))
        points, errors = points[chosen], errors[chosen]
    small = points.astype(np.float32)
    drawn = figure(title, 560, margin={"l": 0, "r": 0, "t": 40 if title else 0, "b": 0})
    drawn.add_scatter3d(
        x=small[:, 0],
        y=small[:, 1],
        z=small[:, 2],
        mode="markers",
        marker={
            "size": 2,
            "color": errors.astype(np.float32),
            "colorscale": _SCALE,
            "cmin": 0.0,
            "cmax": upper,
            "colorbar": {"title": {"text": f"distance in {shown(unit)}", "side": "right"}, "thickness": 14},
        },
        hovertemplate=f"%{{marker.color:.4g}} {shown(unit)}<extra></extra>",
    )
    drawn.update_layout(scene=space(points))
    return drawn


def error_histogram(errors: Mapping[str, Array], *, unit: str = "m", title: str = "", bins: int = 60) -> go.Figure:
    """Draw how the distances of several surfaces are spread, over bins that grow with the distance.

    Methods differ by tens: in even bins the better ones would share the first. Distances below the first in a
    hundred, and beyond the 99th, of all surfaces are in the first and the last bin.

    Raises
    ------
    DataError
        Without errors.
    """
    known = {label: values for label, values in errors.items() if len(values)}
    if not known:
        raise DataError("No errors to draw", expected="distances", found=f"{len(errors)} empty lists")
    upper = max(float(np.percentile(values, 99)) for values in known.values()) or 1.0
    lower = min(*(float(np.percentile(values, 1)) for values in known.values()), upper / 2)
    edges = np.geomspace(max(lower, upper * _SPAN), upper, bins + 1)
    drawn = figure(title, 360, xaxis_title=f"distance in {shown(unit)}", yaxis_title="share of points")
    for position, (label, values) in enumerate(errors.items()):
        if label in known:
            counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
            drawn.add_scatter(
                x=np.sqrt(edges[:-1] * edges[1:]),
                y=counts / len(values),
                name=shown(label),
                mode="lines",
                line={"shape": "hvh", "color": colour(position)},
            )
    drawn.update_xaxes(type="log")
    drawn.update_yaxes(rangemode="tozero", tickformat=".0%")
    return drawn


def threshold_curves(
    errors: Mapping[str, SurfaceErrors], *, unit: str = "m", factor: float = 1.0, title: str = ""
) -> go.Figure:
    """Draw precision (dashed), recall (dotted) and F-score (solid) over the threshold, up to twice the largest one.

    Parameters
    ----------
    unit, factor:
        What thresholds are drawn in, and how many of it are in a unit of the errors.

    Raises
    ------
    DataError
        Without surfaces.
    """
    if not errors:
        raise DataError("No surfaces to draw", expected="errors of at least one", found="none")
    upper = 2 * max(max(item.thresholds) for item in errors.values())
    thresholds = np.linspace(upper / 100, upper, 100)
    drawn = figure(title, 400, xaxis_title=f"threshold in {shown(unit)}", yaxis_title="share")
    for position, (label, item) in enumerate(errors.items()):
        curves = {
            "F-score": (item.f_score, "solid"),
            "precision": (item.precision, "dash"),
            "recall": (item.recall, "dot"),
        }
        for name, (measure, line) in curves.items():
            drawn.add_scatter(
                x=factor * thresholds,
                y=[measure(float(threshold)) for threshold in thresholds],
                name=f"{shown(label)}: {name}",
                mode="lines",
                line={"color": colour(position), "dash": line, "width": 2.5 if line == "solid" else 1.5},
            )
    drawn.update_xaxes(range=[0, factor * upper])
    drawn.update_yaxes(range=[0, 1.02], tickformat=".0%")
    return drawn


def depth_maps(maps: Mapping[str, NDArray[np.floating]], *, unit: str = "m", title: str = "") -> go.Figure:
    """Draw depth maps (H, W) of one size side by side in one scale; 0 and what is not finite stays empty.

    Raises
    ------
    DataError
        For maps of different sizes, none, or without any depth.
    """
    known = {name: np.where(np.isfinite(depth) & (depth > 0), depth, np.nan) for name, depth in maps.items()}
    sizes = {depth.shape for depth in known.values()}
    values = np.concatenate([np.empty(0), *(depth[np.isfinite(depth)] for depth in known.values())])
    if len(sizes) != 1 or not len(values):
        raise DataError(
            "Depth maps cannot be drawn side by side", expected="some of one size, with depth", found=str(sizes)
        )
    low, high = np.percentile(values, [1, 99])
    height, width = next(iter(sizes))
    step = max(1, -(-max(height, width) // LONGEST_SIDE))
    tall = 110 + round(_WIDTH / len(known) * height / width)
    drawn = figure(title, min(tall, 720), margin={"l": 8, "r": 8, "t": 76 if title else 40, "b": 12})
    names = [shown(name) for name in known]
    drawn.set_subplots(
        1, len(known), shared_xaxes="all", shared_yaxes="all", subplot_titles=names, horizontal_spacing=0.015
    )
    for column, depth in enumerate(known.values(), start=1):
        drawn.add_heatmap(z=depth[::step, ::step].astype(np.float32), coloraxis="coloraxis", row=1, col=column)
    drawn.update_layout(
        coloraxis={
            "colorscale": _SCALE,
            "reversescale": True,
            "cmin": float(low),
            "cmax": float(high),
            "colorbar": {"title": {"text": f"depth in {shown(unit)}", "side": "right"}, "thickness": 14},
        }
    )
    drawn.update_annotations(font_size=13)
    # Panels stay below their titles, however wide the page leaves them.
    drawn.update_xaxes(visible=False, constrain="domain")
    drawn.update_yaxes(
        visible=False, autorange="reversed", scaleanchor="x", constrain="domain", constraintoward="top"
    )
    return drawn
