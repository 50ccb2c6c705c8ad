"""Cameras on a circle: from above and from the side, their angles, and how far they are off."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.metrics.circle import CircleFit, fit_circle
from toolkit.plots.style import NEUTRAL, colour, dash, figure, shown
from toolkit.scene import Scene

Array = NDArray[np.float64]


def circle_figure(
    found: Mapping[str, Scene], reference: Scene | None = None, *, expected_turn: float | None = None
) -> go.Figure:
    """Draw camera centres from above and from the side, each in its own circle's axes, in radii.

    The circle is grey, the first camera at the right. A dotted line joins the last camera with the place where the
    expected turn would have brought the first one: the gap. Paths without a circle are named in the title with the
    reason.

    Parameters
    ----------
    found:
        Scenes by label, for example before and after; frames in order of capture.
    reference:
        True poses, drawn in grey.
    expected_turn:
        True angle from the first to the last frame in degrees; None for open arcs.
    """
    fits, remarks = _fits(found, reference, expected_turn)
    drawn = figure("", 640, showlegend=True, legend={"y": -0.09})
    drawn.set_subplots(2, 1, row_heights=[0.76, 0.24], vertical_spacing=0.12, shared_xaxes=True)
    around = np.radians(np.linspace(0.0, 360.0, 181))
    _line(drawn, np.cos(around), np.sin(around), "circle", NEUTRAL, 1, "dot", legend=True)
    _line(drawn, np.array([-1.0, 1.0]), np.zeros(2), "circle", NEUTRAL, 2, "dot", legend=False)
    for position, (label, fit, shade) in enumerate(fits):
        angle = np.radians(fit.angles)
        x, y = (1 + fit.radial) * np.cos(angle), (1 + fit.radial) * np.sin(angle)
        name = f"{label}: {fit.arc_degrees:.2f}°" + (
            "" if fit.closure_gap is None else f", gap {100 * fit.closure_gap:.2g} % of the circumference"
        )
        for row, height in ((1, y), (2, fit.axial)):
            drawn.add_scatter(
                x=x,
                y=height,
                name=shown(name),
                legendgroup=label,
                showlegend=row == 1,
                mode="lines+markers",
                line={"color": shade, "width": 1.5, "dash": dash(position)},
                marker={"color": shade, "size": 4},
                customdata=fit.angles,
                hovertemplate="%{customdata:.1f}°: %{x:.4f}, %{y:.4f}<extra>%{fullData.name}</extra>",
                row=row,
                col=1,
            )
        if expected_turn is not None:
            _gap(drawn, label, fit, expected_turn, shade, x[-1], y[-1])
    drawn.update_yaxes(title_text="across [radii]", scaleanchor="x", scaleratio=1, row=1, col=1)
    drawn.update_yaxes(title_text="along the axis [radii]", row=2, col=1)
    drawn.update_xaxes(title_text="towards the first camera [radii]", constrain="domain", row=2, col=1)
    drawn.update_xaxes(constrain="domain", showticklabels=True, row=1, col=1)
    return _remarked(drawn, remarks)


def circle_angles_figure(found: Mapping[str, Scene], reference: Scene | None = None) -> go.Figure:
    """Draw the angle about the axis of every frame and, with true poses, its error below.

    Angles begin at 0 with the first frame of a scene that has a pose; errors have a mean of 0.

    Parameters
    ----------
    found:
        Scenes by label; frames in order of capture, matched with the reference by name.
    reference:
        True poses, drawn in grey.
    """
    fits, remarks = _fits(found, reference, None)
    drawn = figure("", 470, showlegend=True, legend={"y": -0.14})
    rows = 1 if reference is None else 2
    drawn.set_subplots(rows, 1, shared_xaxes=True, vertical_spacing=0.07)
    scenes = {**found, **({} if reference is None else {"truth": reference})}
    true = None if reference is None else _angles_by_name(fits, "truth", reference)
    for position, (label, fit, shade) in enumerate(fits):
        index = [i for i, frame in enumerate(scenes[label].frames) if frame.cam_from_world is not None]
        _line(drawn, np.array(index), fit.angles, label, shade, 1, dash(position), legend=True)
        if true and label != "truth":
            names = [scenes[label].frames[i].name for i in index]
            off = np.array([a - true.get(name, np.nan) for name, a in zip(names, fit.angles, strict=True)])
            off -= np.nanmean(off)
            _line(drawn, np.array(index), off, label, shade, 2, dash(position), legend=False)
    drawn.update_yaxes(title_text="angle about the axis [°]", row=1, col=1)
    if rows == 2:
        drawn.update_yaxes(title_text="error [°]", row=2, col=1)
    drawn.update_xaxes(title_text="frame", row=rows, col=1)
    return _remarked(drawn, remarks)


def circle_residuals_figure(found: Mapping[str, Scene], reference: Scene | None = None) -> go.Figure:
    """Draw how far every camera is off its own circle, outwards and along the axis, in per cent of the radius."""
    fits, remarks = _fits(found, reference, None)
    drawn = figure("", 470, showlegend=True, legend={"y": -0.14})
    drawn.set_subplots(2, 1, shared_xaxes=True, vertical_spacing=0.07)
    scenes = {**found, **({} if reference is None else {"truth": reference})}
    for position, (label, fit, shade) in enumerate(fits):
        index = [i for i, frame in enumerate(scenes[label].frames) if frame.cam_from_world is not None]
        for row, values in ((1, fit.radial), (2, fit.axial)):
            rms = f"{label}: RMS {100 * fit.radius_spread:.2g} % outwards, {100 * fit.out_of_plane_rms:.2g} % along"
            _line(drawn, np.array(index), 100 * values, rms, shade, row, dash(position), legend=row == 1)
    drawn.update_yaxes(title_text="outwards [% of radius]", row=1, col=1)
    drawn.update_yaxes(title_text="along the axis [% of radius]", row=2, col=1)
    drawn.update_xaxes(title_text="frame", row=2, col=1)
    return _remarked(drawn, remarks)


def _fits(
    found: Mapping[str, Scene], reference: Scene | None, expected_turn: float | None
) -> tuple[list[tuple[str, CircleFit, str]], list[str]]:
    """Return label, circle and colour of each scene that has one, the truth first, and why others have none."""
    fits, remarks = [], []
    scenes = [(label, scene, colour(position)) for position, (label, scene) in enumerate(found.items())]
    if reference is not None:
        scenes.insert(0, ("truth", reference, NEUTRAL))
    for label, scene, shade in scenes:
        try:
            fits.append((label, fit_circle(scene.centres(), expected_turn=expected_turn), shade))
        except StageError as error:
            # What was expected and found would not fit on a line.
            remarks.append(f"{label}: {str(error).partition(';')[0]}")
    return fits, remarks


def _angles_by_name(fits: list[tuple[str, CircleFit, str]], label: str, scene: Scene) -> dict[str, float]:
    angles = [fit.angles for name, fit, _ in fits if name == label]
    return dict(zip((frame.name for frame in scene.registered), angles[0].tolist(), strict=True)) if angles else {}


def _line(
    drawn: go.Figure, x: Array, y: Array, label: str, shade: str, row: int, stroke: str, *, legend: bool
) -> None:
    drawn.add_scatter(
        x=x,
        y=y,
        name=shown(label),
        legendgroup=label,
        showlegend=legend,
        mode="lines",
        line={"color": shade, "width": 1.5, "dash": stroke},
        row=row,
        col=1,
    )


def _gap(
    drawn: go.Figure, label: str, fit: CircleFit, expected_turn: float, shade: str, x: float, y: float
) -> None:
    turned = np.radians(expected_turn)
    reach = 1 + float(fit.radial[0])
    drawn.add_scatter(
        x=[x, reach * np.cos(turned)],
        y=[y, reach * np.sin(turned)],
        legendgroup=label,
        showlegend=False,
        mode="lines+markers",
        line={"color": shade, "width": 2, "dash": "dot"},
        marker={"color": shade, "size": 10, "symbol": ["circle-open", "x-thin-open"]},
        hoverinfo="skip",
        row=1,
        col=1,
    )


def _remarked(drawn: go.Figure, remarks: list[str]) -> go.Figure:
    if remarks:
        drawn.update_layout(title={"text": "<br>".join(map(shown, remarks)), "font": {"size": 12}})
        drawn.update_layout(margin={"t": 30 + 18 * len(remarks)})
    else:
        drawn.update_layout(margin={"t": 24})
    return drawn
