"""Digital surface models as shaded relief, beside each other and beside their difference; errors over views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.plots.pictures import picture_trace
from toolkit.plots.style import colour, figure, shown
from toolkit.scene.dsm_files import SurfaceModel

#: Cells along the longer side of a drawn model; finer ones are thinned.
LONGEST_SIDE = 512
# Light falls from the north-west, 45 degrees above the horizon: what maps use, and what eyes take for up.
_LIGHT = np.array([-0.5, 0.5, np.sqrt(0.5)])
# Share of the height's colour over the grey of the relief.
_TINT = 0.6
_UNKNOWN = 225  # grey of cells without height
_WIDTH = 950
_ABOVE, _BELOW = 40, 92


def surface_models_figure(
    models: Mapping[str, SurfaceModel],
    difference: SurfaceModel | None = None,
    *,
    most: float = 5.0,
    title: str = "",
) -> go.Figure:
    """Draw surface models side by side as relief lit from the north-west, coloured by height in one scale.

    What lies beyond any of them is left out: at the edges of a found one, where few pictures meet, anything may be.

    Parameters
    ----------
    models:
        By label, over one map.
    difference:
        Metres found minus true, drawn as the last panel: blue too low, red too high.
    most:
        Metres at the ends of the difference's scale.

    Raises
    ------
    DataError
        Without models, for models over different maps or apart from each other, and where no height is known.
    """
    maps = [*models.values(), *([] if difference is None else [difference])]
    west, south, width, depth = _common(maps)
    drawn_models = {label: _thinned(_cropped(model, west, south, width, depth)) for label, model in models.items()}
    values = np.concatenate([model.heights[np.isfinite(model.heights)] for model in drawn_models.values()])
    if not len(values):
        raise DataError("Surface models have nothing to draw", expected="known heights", found="none in common")
    titles = [shown(label) for label in models] + ([] if difference is None else ["found minus true"])
    panel = _WIDTH / len(titles) * depth / width
    above = _ABOVE + (32 if title else 0)
    drawn = figure(
        title, round(above + min(panel, 640) + _BELOW), margin={"l": 50, "r": 8, "t": above, "b": _BELOW}
    )
    drawn.set_subplots(
        1, len(titles), shared_xaxes="all", shared_yaxes="all", subplot_titles=titles, horizontal_spacing=0.02
    )
    for column, model in enumerate(drawn_models.values(), start=1):
        corner = (model.origin[0] - west, model.origin[1] - south)
        drawn.add_layout_image(_relief(model, corner), row=1, col=column)
        drawn.add_trace(_colours(model, corner, "coloraxis", opacity=_TINT), row=1, col=column)
    low, high = np.percentile(values, [1, 99])
    bar = min(0.3, 0.9 / len(titles))
    middle = 0.5 * len(models) / len(titles)
    drawn.update_layout(coloraxis=_axis("viridis", float(low), float(high), "height in m", middle, bar))
    if difference is not None:
        off = _thinned(_cropped(difference, west, south, width, depth))
        corner = (off.origin[0] - west, off.origin[1] - south)
        drawn.add_trace(_colours(off, corner, "coloraxis2"), row=1, col=len(titles))
        middle = 1 - 0.5 / len(titles)
        drawn.update_layout(coloraxis2=_axis("RdBu_r", -most, most, "difference in m", middle, bar))
    drawn.update_annotations(font_size=13)
    drawn.update_xaxes(range=[0, width], constrain="domain", showgrid=False, title_text="east in m")
    drawn.update_yaxes(range=[0, depth], constrain="domain", constraintoward="top", scaleanchor="x", showgrid=False)
    drawn.update_yaxes(title_text="north in m", row=1, col=1)
    return drawn


def view_count_figure(
    errors: Mapping[str, Mapping[int, float]], *, measure: str = "mean absolute error in m", title: str = ""
) -> go.Figure:
    """Draw an error over the number of views, a line for each way to choose them.

    Raises
    ------
    DataError
        Without errors.
    """
    if not any(errors.values()):
        raise DataError("No errors to draw", expected="some by number of views", found=f"{len(errors)} empty lists")
    drawn = figure(title, 360, xaxis_title="views", yaxis_title=measure, hovermode="x unified", showlegend=True)
    for position, (label, by_count) in enumerate(errors.items()):
        counts = sorted(by_count)
        drawn.add_scatter(
            x=counts,
            y=[by_count[count] for count in counts],
            name=shown(label),
            mode="lines+markers",
            line={"color": colour(position), "width": 2},
            marker={"size": 8},
        )
    drawn.update_xaxes(tickvals=sorted({count for by_count in errors.values() for count in by_count}))
    drawn.update_yaxes(rangemode="tozero")
    return drawn


def _common(maps: Sequence[SurfaceModel]) -> tuple[float, float, float, float]:
    """Return west, south, width and depth of what all maps cover."""
    edges = np.array([_edges(model) for model in maps]).reshape(-1, 4)
    names = sorted({model.crs for model in maps})
    if len(names) == 1:
        west, south = (float(value) for value in edges[:, :2].max(axis=0))
        east, north = (float(value) for value in edges[:, 2:].min(axis=0))
        if east > west and north > south:
            return west, south, east - west, north - south
    raise DataError(
        "Surface models cannot be drawn side by side",
        expected="some that overlap on one map",
        found=f"{len(maps)} models on {', '.join(names) or 'no map'}" + (", apart" if len(names) == 1 else ""),
    )


def _cropped(model: SurfaceModel, west: float, south: float, width: float, depth: float) -> SurfaceModel:
    """Return the cells whose centres lie in a rectangle; of small ones the nearest."""
    east, north = model.centres()
    columns = _within(east, west, west + width)
    rows = _within(north, south, south + depth)
    side = model.resolution
    corner = (float(east[columns[0]] - side / 2), float(north[rows[0]] + side / 2))
    return SurfaceModel(model.heights[np.ix_(rows, columns)], corner, side, model.crs)


def _within(centres: NDArray[np.float64], low: float, high: float) -> NDArray[np.int64]:
    inside = np.flatnonzero((centres >= low) & (centres <= high))
    return inside if len(inside) else np.array([int(np.argmin(np.abs(centres - 0.5 * (low + high))))])


def _edges(model: SurfaceModel) -> tuple[float, float, float, float]:
    """Return west, south, east and north of the outer cells' outer edges on the map."""
    rows, columns = model.heights.shape
    west, north = model.origin
    return west, north - rows * model.resolution, west + columns * model.resolution, north


def _thinned(model: SurfaceModel) -> SurfaceModel:
    step = max(1, -(-max(model.heights.shape) // LONGEST_SIDE))
    return SurfaceModel(model.heights[::step, ::step], model.origin, step * model.resolution, model.crs)


def _relief(model: SurfaceModel, corner: tuple[float, float]) -> go.layout.Image:
    """Return the model's shades as a picture below the traces whose top left corner is at ``corner``.

    A trace of the type image, with rows that go south on an axis that goes north, would be drawn upside down.
    """
    if min(model.heights.shape) > 1:
        down, right = np.gradient(model.heights.astype(np.float64), model.resolution)
    else:
        down = right = np.where(np.isfinite(model.heights), 0.0, np.nan)
    normal = np.stack([-right, down, np.ones_like(right)], axis=-1)
    light = np.clip((normal @ _LIGHT) / np.linalg.norm(normal, axis=-1), 0, 1)
    grey = np.where(np.isfinite(light), 255 * light, _UNKNOWN)
    source = picture_trace(np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)).source
    rows, columns = model.heights.shape
    return go.layout.Image(
        source=source,
        x=corner[0],
        y=corner[1],
        sizex=columns * model.resolution,
        sizey=rows * model.resolution,
        sizing="stretch",
        layer="below",
    )


def _colours(model: SurfaceModel, corner: tuple[float, float], axis: str, *, opacity: float = 1.0) -> go.Heatmap:
    side = model.resolution
    return go.Heatmap(
        z=model.heights.astype(np.float32),
        x0=corner[0] + side / 2,
        dx=side,
        y0=corner[1] - side / 2,
        dy=-side,
        coloraxis=axis,
        opacity=opacity,
        hovertemplate="%{x:.1f} m east, %{y:.1f} m north: %{z:.2f} m<extra></extra>",
    )


def _axis(scale: str, low: float, high: float, text: str, middle: float, share: float) -> dict[str, Any]:
    bar = {"orientation": "h", "thickness": 12, "len": share, "x": middle, "y": 0.0, "yanchor": "top", "ypad": 46}
    title = {"text": text, "side": "bottom", "font": {"size": 13}}
    return {"colorscale": scale, "cmin": low, "cmax": high, "colorbar": {**bar, "title": title}}
