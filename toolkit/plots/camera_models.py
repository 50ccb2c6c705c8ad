"""Camera models beside each other: residuals, distortion and scores."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from numpy.typing import ArrayLike, NDArray

from toolkit.geometry.cameras import Camera, ColmapCamera
from toolkit.plots.style import GRID, NEUTRAL, colour, dash, figure, shown

Array = NDArray[np.float64]

_STEPS = 120
_COLUMNS = 4
# Lines of the distortion grid, and samples along each.
_LINES, _SAMPLES = 13, 60
# Rays farther off the axis than this are not drawn: their tangent runs away.
_WIDEST = 80.0
_CHOSEN = "#14b8a6"


@dataclass(frozen=True, slots=True)
class ModelScore:
    """What is drawn of one camera model.

    Attributes
    ----------
    model:
        Its name.
    held_out, held_out_error:
        RMS error of withheld observations in pixels, and the standard error of its difference from the best one.
    bic, bic_error:
        Difference of BIC from the least, and its standard error.
    free_parameters:
        Number of intrinsics that were found.
    """

    model: str
    held_out: float
    held_out_error: float
    bic: float
    bic_error: float
    free_parameters: int


def residual_radius_figure(
    residuals: Mapping[str, tuple[ArrayLike, ArrayLike]], centre: tuple[float, float], *, bins: int = 12
) -> go.Figure:
    """Draw the radial part of the residuals against the distance from the picture's centre.

    A line is the median of the points in a ring, its band the middle half of them. A lens that a model cannot
    describe bends the line; noise widens the band only. Rings hold equally many points.

    Parameters
    ----------
    residuals:
        By model, where the observations are (N, 2) and projected minus seen (N, 2), in pixels; NaN is left out.
    centre:
        Principal point in pixels.
    bins:
        Number of rings, at most; a ring holds ten points or more.
    """
    drawn = figure("Residual along the radius (out is positive)", 380, hovermode="closest", margin={"r": 24})
    drawn.add_hline(y=0.0, line={"color": NEUTRAL, "width": 1})
    for position, (label, (pixels, values)) in enumerate(residuals.items()):
        radius, radial = _radial(np.asarray(pixels, dtype=np.float64), np.asarray(values, dtype=np.float64), centre)
        if len(radius) < 10:
            continue
        edges = np.quantile(radius, np.linspace(0.0, 1.0, min(bins, len(radius) // 10) + 1))
        ring = np.clip(np.searchsorted(edges, radius, side="right") - 1, 0, len(edges) - 2)
        used = np.unique(ring)
        middle = [float(np.median(radius[ring == each])) for each in used]
        low, median, high = np.array([np.quantile(radial[ring == each], (0.25, 0.5, 0.75)) for each in used]).T
        shade = colour(position)
        drawn.add_scatter(
            x=[*middle, *middle[::-1]],
            y=[*high, *low[::-1]],
            fill="toself",
            fillcolor=_faint(shade),
            line={"width": 0},
            mode="lines",
            legendgroup=label,
            showlegend=False,
            hoverinfo="skip",
        )
        drawn.add_scatter(
            x=middle,
            y=median,
            name=shown(label),
            legendgroup=label,
            mode="lines+markers",
            line={"color": shade, "width": 2, "dash": dash(position)},
            marker={"size": 5},
        )
    drawn.update_xaxes(title_text="distance from the principal point [px]", rangemode="tozero")
    drawn.update_yaxes(title_text="radial residual [px]")
    return drawn


def distortion_curves_figure(cameras: Mapping[str, Camera], truth: Camera | None = None) -> go.Figure:
    """Draw the angle of the ray against the distance from the principal point, and its difference from the truth.

    Without a truth the difference is that from the first model. A curve ends where a model has no rays any more.
    """
    drawn = figure("Angle of the ray", 520, hovermode="x unified", legend={"y": -0.14})
    drawn.set_subplots(2, 1, shared_xaxes=True, vertical_spacing=0.08, row_heights=[0.6, 0.4])
    if not cameras:
        return drawn
    first = next(iter(cameras))
    radius, reference = _angles(truth if truth is not None else cameras[first])
    if truth is not None:
        _add_curve(drawn, 1, radius, reference, "truth", NEUTRAL, "solid", 5)
    for position, (label, camera) in enumerate(cameras.items()):
        shade, style = colour(position), dash(position)
        at, angle = _angles(camera)
        _add_curve(drawn, 1, at, angle, label, shade, style, 2)
        off = angle - np.interp(at, radius, reference, right=np.nan)
        _add_curve(drawn, 2, at, off, label, shade, style, 2, legend=False)
    drawn.update_yaxes(title_text="angle [°]", row=1, col=1)
    whose = "truth" if truth is not None else first
    drawn.update_yaxes(title_text=f"minus {shown(whose)} [°]", row=2, col=1)
    drawn.update_xaxes(title_text="distance from the principal point [px]", row=2, col=1)
    return drawn


def distortion_grids_figure(cameras: Mapping[str, Camera], truth: Camera | None = None) -> go.Figure:
    """Draw how each camera sees one grid of straight lines; where the truth is known, its picture lies beneath.

    The grid fills the view of the truth, or of the first camera: all models are shown the same lines.
    """
    count = len(cameras)
    columns = min(_COLUMNS, max(count, 1))
    rows = -(-max(count, 1) // columns)
    drawn = figure("A grid of straight lines", 90 + 210 * rows, margin={"l": 16, "t": 64}, showlegend=False)
    drawn.set_subplots(
        rows,
        columns,
        subplot_titles=[shown(label) for label in cameras],
        horizontal_spacing=0.02,
        vertical_spacing=0.12 / rows,
    )
    drawn.update_annotations(font={"size": 12})
    if not cameras:
        return drawn
    lines = _grid(truth if truth is not None else next(iter(cameras.values())))
    for position, camera in enumerate(cameras.values()):
        row, column = divmod(position, columns)
        place = {"row": row + 1, "col": column + 1}
        if truth is not None:
            _add_lines(drawn, truth, lines, NEUTRAL, 1.0, place)
        _add_lines(drawn, camera, lines, colour(position), 1.2, place)
        drawn.add_shape(
            type="rect",
            x0=0,
            y0=0,
            x1=camera.width,
            y1=camera.height,
            line={"color": GRID},
            **place,
        )
        drawn.update_xaxes(range=[-5, camera.width + 5], visible=False, constrain="domain", **place)
        axis = "x" if position == 0 else f"x{position + 1}"
        drawn.update_yaxes(range=[camera.height + 5, -5], visible=False, scaleanchor=axis, **place)
    return drawn


def model_scores_figure(scores: list[ModelScore], chosen: str | None) -> go.Figure:
    """Draw held-out error and BIC of each model as bars, the chosen one in another colour.

    Parameters
    ----------
    scores:
        In the order in which they are drawn, from above.
    chosen:
        Name of the chosen model, or None where none was.
    """
    title = f"Chosen: {chosen}" if chosen is not None else "No model was chosen: the observations do not decide"
    drawn = figure(title, 130 + 28 * len(scores), showlegend=False, margin={"t": 64, "r": 24})
    drawn.set_subplots(
        1,
        2,
        shared_yaxes=True,
        horizontal_spacing=0.05,
        subplot_titles=["held-out error, RMS [px]", "BIC above the least (root scale)"],
    )
    drawn.update_annotations(font={"size": 13})
    names = [shown(f"{score.model} ({score.free_parameters})") for score in scores]
    shades = [_CHOSEN if score.model == chosen else "#64748b" for score in scores]
    # Differences run from a few to tens of thousands, and to zero, which a logarithm does not reach.
    root = [float(np.sqrt(max(score.bic, 0.0))) for score in scores]
    # Errors end where the bars do, so their numbers stand at the other end.
    for column, lengths, texts, errors in (
        (
            1,
            [s.held_out for s in scores],
            [f"{s.held_out:.3f}" for s in scores],
            [s.held_out_error for s in scores],
        ),
        (2, root, [f"{s.bic:,.0f} ± {s.bic_error:,.0f}" for s in scores], None),
    ):
        drawn.add_bar(
            x=lengths,
            y=names,
            orientation="h",
            marker={"color": shades},
            text=texts,
            textposition="outside" if errors is None else "inside",
            insidetextanchor="start",
            cliponaxis=False,
            error_x=None if errors is None else {"array": errors, "color": NEUTRAL, "thickness": 1.5},
            hovertemplate="%{y}: %{text}<extra></extra>",
            row=1,
            col=column,
        )
        longest = max([*lengths, 1e-9])
        drawn.update_xaxes(range=[0.0, (1.15 if errors else 1.7) * longest], row=1, col=column)
    drawn.update_xaxes(showticklabels=False, row=1, col=2)
    drawn.update_yaxes(autorange="reversed", row=1, col=1)
    drawn.update_yaxes(autorange="reversed", row=1, col=2)
    return drawn


def _radial(pixels: Array, residuals: Array, centre: tuple[float, float]) -> tuple[Array, Array]:
    """Return the distance from the centre (N,) and the part of the residual away from it (N,), finite ones only."""
    out = pixels - np.array(centre)
    radius = np.linalg.norm(out, axis=1)
    radial = np.sum(residuals * out, axis=1) / np.maximum(radius, 1e-9)
    sound = np.isfinite(radial)
    return radius[sound], radial[sound]


def _principal_point(camera: Camera) -> Array:
    if isinstance(camera, ColmapCamera):
        return camera.intrinsics[:2, 2]
    return np.array([camera.width / 2.0, camera.height / 2.0])


def _angles(camera: Camera) -> tuple[Array, Array]:
    """Return distances from the principal point (N,), up to the farthest corner, and the angles in degrees."""
    middle = _principal_point(camera)
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]], dtype=float)
    farthest = corners[int(np.argmax(np.linalg.norm(corners - middle, axis=1)))]
    part = np.linspace(0.0, 1.0, _STEPS)[:, None]
    _, rays = camera.ray(middle + part * (farthest - middle))
    angle = np.degrees(np.arctan2(np.linalg.norm(rays[:, :2], axis=1), rays[:, 2]))
    return part[:, 0] * float(np.linalg.norm(farthest - middle)), angle


def _add_curve(
    drawn: go.Figure,
    row: int,
    x: Array,
    y: Array,
    label: str,
    shade: str,
    style: str,
    width: int,
    *,
    legend: bool = True,
) -> None:
    drawn.add_scatter(
        x=x,
        y=y,
        name=shown(label),
        legendgroup=label,
        showlegend=legend,
        mode="lines",
        line={"color": shade, "width": width, "dash": style},
        hovertemplate="%{y:.2f}°",
        row=row,
        col=1,
    )


def _grid(camera: Camera) -> list[Array]:
    """Return the directions (N, 3) along each line of a flat grid before the camera that fills its picture."""
    border = np.linspace(0.0, 1.0, 41)
    nothing, whole = np.zeros(41), np.ones(41)
    edge = np.concatenate(
        [
            np.stack(side, axis=1)
            for side in ((border, nothing), (border, whole), (nothing, border), (whole, border))
        ]
    ) * [camera.width, camera.height]
    _, rays = camera.ray(edge)
    limit = np.tan(np.radians(_WIDEST))
    with np.errstate(invalid="ignore", divide="ignore"):
        flat = np.clip(np.abs(rays[:, :2] / rays[:, 2:]), 0.0, limit)
    reach = np.nanmax(flat, axis=0)
    made = []
    for axis in (0, 1):
        # Lines at equal angles, so that the middle of a wide view has some, too.
        for place in np.tan(np.linspace(-1.0, 1.0, _LINES) * np.arctan(reach[axis])):
            line = np.ones((_SAMPLES, 3))
            line[:, axis] = place
            line[:, 1 - axis] = np.tan(np.linspace(-1.0, 1.0, _SAMPLES) * np.arctan(reach[1 - axis]))
            made.append(line)
    return made


def _add_lines(
    drawn: go.Figure, camera: Camera, lines: list[Array], shade: str, width: float, place: Mapping[str, int]
) -> None:
    gap = np.full((1, 2), np.nan)
    parts = []
    for line in lines:
        seen = camera.project(line)
        outside = ~((seen >= 0) & (seen <= (camera.width, camera.height))).all(axis=1)
        seen[outside] = np.nan
        parts += [seen, gap]
    path = np.concatenate(parts)
    drawn.add_scatter(
        x=path[:, 0],
        y=path[:, 1],
        mode="lines",
        line={"color": shade, "width": width},
        hoverinfo="skip",
        **place,
    )


def _faint(shade: str) -> str:
    red, green, blue = (int(shade[start : start + 2], 16) for start in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.15)"
