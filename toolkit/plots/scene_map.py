"""A map of a scene: where cameras are, where they look, and what was found of the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from toolkit.geometry.rigid import RigidTransform
from toolkit.plots.curves import thinned
from toolkit.plots.style import COLOURS, NEUTRAL, figure, shown
from toolkit.plots.trajectories import camera_lines, space
from toolkit.scene import Frame, Points, Scene

Array = NDArray[np.float64]

#: Most points drawn: a browser turns this many smoothly.
MOST_POINTS = 20_000
_MOST_PYRAMIDS = 300
#: A camera whose view has a smaller level part than this looks straight down: its picture's top gives the heading.
_NADIR = 0.1
#: Directions whose mean is longer than this, of 1 where all are the same, agree with each other.
_AGREE = 0.4
#: Points farther from the cameras and the other points than this many extents are left out of the drawing.
_REACH = 1.0

_TRAIN, _TEST, _SENSOR = COLOURS[0], COLOURS[1], COLOURS[3]


@dataclass(frozen=True, slots=True)
class _Place:
    """One frame on the map: (3,) where, how it is turned or None, and (3,) one sigma or None."""

    frame: Frame
    centre: Array
    rotation: Array | None
    sigma: Array | None = None


def scene_map(
    scene: Scene, *, reference: Scene | None = None, points: bool = True, top_view: bool = False
) -> go.Figure:
    """Draw the cameras of a scene with their looking directions, and its points.

    A frame stands where its pose says; without a pose, where its sensors say (a cross, with bars of one standard
    deviation where that is known). Frames with neither are counted in the title. A few points far off all others
    would shrink the rest to nothing and are left out.

    Parameters
    ----------
    scene:
        With poses or position priors.
    reference:
        The same frames with true poses in the same world frame, drawn in grey.
    points:
        Whether to draw the scene's points, at most 20,000 of them.
    top_view:
        Draw a plane map in equal scale instead, with arrows for the headings; x is right and y is up. A camera
        that looks straight down points to where the top of its picture is.
    """
    posed = [
        _Place(f, f.cam_from_world.centre, f.cam_from_world.rotation) for f in scene.frames if f.cam_from_world
    ]
    sensed = [place for frame in scene.frames if (place := _by_sensor(frame)) is not None]
    true = [] if reference is None else reference.registered
    truth = [_Place(f, f.cam_from_world.centre, f.cam_from_world.rotation) for f in true if f.cam_from_world]
    groups = [
        ("true cameras", truth, NEUTRAL, "circle"),
        ("cameras", [place for place in posed if place.frame.split == "train"], _TRAIN, "circle"),
        ("test cameras", [place for place in posed if place.frame.split == "test"], _TEST, "diamond"),
        ("sensor positions", [p for p in sensed if p.frame.split == "train"], _SENSOR, "x"),
        ("sensor positions, test", [p for p in sensed if p.frame.split == "test"], _TEST, "x"),
    ]
    groups = [group for group in groups if group[1]]
    everything = np.array([place.centre for _, places, _, _ in groups for place in places]).reshape(-1, 3)
    cloud = _near(scene.points, everything) if points and scene.points is not None else None
    title = _title(len(scene), len(posed), len(sensed))
    names = ("east [m]", "north [m]", "up [m]") if scene.georeference is not None else ("x", "y", "z")
    if top_view:
        return _draw_plane(title, names, groups, cloud, everything)
    up = None if scene.georeference is not None else _upwards(posed)
    return _draw_space(title, names, groups, cloud, everything, up)


def _by_sensor(frame: Frame) -> _Place | None:
    """Return where the sensors put a frame that has no pose."""
    prior = frame.prior
    if frame.cam_from_world is not None or prior is None or prior.position is None:
        return None
    return _Place(frame, prior.position, prior.rotation, prior.position_sigma)


def _upwards(places: Sequence[_Place]) -> Array | None:
    """Return the direction (3,) that is up by most pictures, for worlds that lie askew, None where they disagree.

    Where their tops point to all sides, as on a flight that looks straight down, it is against the view.
    """
    rotations = np.array([place.rotation for place in places]).reshape(-1, 3, 3)
    for direction in (-rotations[:, 1], -rotations[:, 2]):
        mean = direction.sum(axis=0) / max(1, len(rotations))
        length = float(np.linalg.norm(mean))
        if length > _AGREE:
            upwards: Array = mean / length
            return upwards
    return None


def _title(frames: int, posed: int, sensed: int) -> str:
    parts = [f"{posed} of {frames} frames with a pose"]
    if sensed:
        parts.append(f"{sensed} at their sensor position")
    if frames - posed - sensed and sensed + posed:
        parts.append(f"{frames - posed - sensed} unknown")
    return ", ".join(parts)


_Group = tuple[str, list[_Place], str, str]


def _draw_space(
    title: str,
    names: Sequence[str],
    groups: Sequence[_Group],
    cloud: Points | None,
    everything: Array,
    up: Array | None,
) -> go.Figure:
    drawn = figure(title, 600, margin={"l": 0, "r": 0, "t": 40, "b": 0}, showlegend=True)
    if cloud is not None and len(cloud):
        x, y, z = cloud.xyz.T
        drawn.add_scatter3d(
            x=x,
            y=y,
            z=z,
            name="points",
            mode="markers",
            hoverinfo="skip",
            marker={"size": 1.6, "color": _css(cloud)},
        )
    size = 0.04 * _extent(everything)
    for label, places, shade, symbol in groups:
        centres = np.array([place.centre for place in places])
        bars = _bars(places, ("error_x", "error_y", "error_z"), shade)
        drawn.add_scatter3d(
            **dict(zip("xyz", centres.T, strict=True)),
            **bars,
            name=label,
            legendgroup=label,
            mode="lines+markers" if label == "true cameras" else "markers",
            line={"color": shade, "width": 2},
            marker={"color": shade, "size": 4 if symbol != "x" else 3, "symbol": symbol},
            text=[_hover(place) for place in places],
            hovertemplate="%{text}<br>%{x:.2f}, %{y:.2f}, %{z:.2f}<extra>%{fullData.name}</extra>",
        )
        _add_pyramids(drawn, label, places, shade, size)
    visible = everything if cloud is None else np.concatenate([everything, cloud.xyz])
    drawn.update_layout(legend={"y": 1.0}, scene=space(visible, names, up))
    return drawn


def _add_pyramids(drawn: go.Figure, label: str, places: Sequence[_Place], shade: str, size: float) -> None:
    poses = [RigidTransform(p.rotation, -p.rotation @ p.centre) for p in places if p.rotation is not None]
    if not poses:
        return
    lines = camera_lines([poses[i] for i in thinned(len(poses), _MOST_PYRAMIDS)], size)
    drawn.add_scatter3d(
        **dict(zip("xyz", lines.T, strict=True)),
        legendgroup=label,
        showlegend=False,
        hoverinfo="skip",
        mode="lines",
        line={"color": shade, "width": 2},
        opacity=0.6,
    )


def _draw_plane(
    title: str, names: Sequence[str], groups: Sequence[_Group], cloud: Points | None, everything: Array
) -> go.Figure:
    drawn = figure(title, 560, showlegend=True)
    if cloud is not None and len(cloud):
        # From the lowest to the highest, so that roofs hide what is below them, as they do from above.
        order = np.argsort(cloud.xyz[:, 2], kind="stable")
        colours = _css(cloud)
        drawn.add_scattergl(
            x=cloud.xyz[order, 0],
            y=cloud.xyz[order, 1],
            name="points",
            mode="markers",
            hoverinfo="skip",
            marker={"size": 3, "color": [colours[i] for i in order]},
        )
    length = 0.06 * _extent(everything)
    for label, places, shade, symbol in groups:
        drawn.add_scatter(
            x=[place.centre[0] for place in places],
            y=[place.centre[1] for place in places],
            **_bars(places, ("error_x", "error_y"), shade),
            name=label,
            legendgroup=label,
            mode="markers",
            marker={"color": shade, "size": 7, "symbol": symbol},
            text=[_hover(place) for place in places],
            hovertemplate="%{text}<br>%{x:.2f}, %{y:.2f}<extra>%{fullData.name}</extra>",
        )
        _add_arrows(drawn, label, places, shade, length)
    drawn.update_xaxes(title_text=names[0], constrain="domain")
    drawn.update_yaxes(title_text=names[1], scaleanchor="x", scaleratio=1)
    return drawn


def _add_arrows(drawn: go.Figure, label: str, places: Sequence[_Place], shade: str, length: float) -> None:
    turned = [(place, heading) for place in places if (heading := _heading(place.rotation)) is not None]
    if not turned:
        return
    angles = np.array([heading for _, heading in turned])
    start = np.array([place.centre[:2] for place, _ in turned])
    ahead = np.stack([np.sin(np.radians(angles)), np.cos(np.radians(angles))], axis=1)
    ends = np.stack([start, start + length * ahead, np.full_like(start, np.nan)], axis=1).reshape(-1, 2)
    drawn.add_scatter(
        x=ends[:, 0],
        y=ends[:, 1],
        legendgroup=label,
        showlegend=False,
        hoverinfo="skip",
        mode="lines+markers",
        line={"color": shade, "width": 2},
        # A head at the tip only.
        marker={"color": shade, "symbol": "arrow", "size": [0, 11, 0] * len(turned), "angle": np.repeat(angles, 3)},
    )


def _heading(rotation: Array | None) -> float | None:
    """Return where a camera looks as seen from above, in degrees clockwise from +y, None where that is unknown."""
    if rotation is None:
        return None
    # Rows of cam_from_world are the camera's axes in the world: the third looks ahead, the second down the picture.
    ahead = rotation[2, :2] if np.hypot(*rotation[2, :2]) > _NADIR else -rotation[1, :2]
    return float(np.degrees(np.arctan2(ahead[0], ahead[1])))


def _bars(places: Sequence[_Place], axes: Sequence[str], shade: str) -> dict[str, Any]:
    """Return Plotly's error bars of one sigma; no length where it is unknown."""
    if all(place.sigma is None for place in places):
        return {}
    sigmas = np.array([np.zeros(3) if place.sigma is None else place.sigma for place in places])
    look = {"type": "data", "visible": True, "color": shade, "thickness": 1.5, "width": 2}
    return {axis: {**look, "array": sigmas[:, i]} for i, axis in enumerate(axes)}


def _hover(place: _Place) -> str:
    text = shown(place.frame.name)
    return f"{text} (test)" if place.frame.split == "test" else text


def _near(cloud: Points, cameras: Array) -> Points:
    """Return at most :data:`MOST_POINTS` points, without the few that lie far off."""
    if not len(cloud):
        return cloud
    low, high = np.percentile(cloud.xyz, [2, 98], axis=0)
    corners = np.concatenate([cameras, low[None], high[None]])
    low, high = corners.min(axis=0), corners.max(axis=0)
    reach = _REACH * float(np.linalg.norm(high - low))
    inside = np.flatnonzero(np.all((cloud.xyz >= low - reach) & (cloud.xyz <= high + reach), axis=1))
    kept = inside[thinned(len(inside), MOST_POINTS)]
    return Points(cloud.xyz[kept], cloud.rgb[kept])


def _css(cloud: Points) -> list[str]:
    return [f"rgb({r},{g},{b})" for r, g, b in cloud.rgb.tolist()]


def _extent(centres: Array) -> float:
    """Return the diagonal of the box around centres (F, 3), one where there is none."""
    diagonal = float(np.linalg.norm(np.ptp(centres, axis=0))) if len(centres) else 0.0
    return diagonal if diagonal > 0 else 1.0
