"""Searches for a pose from above, and what a start that is farther off costs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, Literal

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.rigid import RigidTransform
from toolkit.metrics.localization import LocalizationErrors
from toolkit.plots.curves import thinned
from toolkit.plots.style import COLOURS, NEUTRAL, colour, figure, shown
from toolkit.scene import Points

_MOST_POINTS: Final = 8000
_UNITS: Final = {"metres": "start off by [m]", "degrees": "start turned by [°]"}
#: Errors below a tenth of a millimetre are drawn there: a logarithm has no 0.
_LEAST: Final = 1e-4
#: Share of a step by which the dots of methods are moved apart.
_ASIDE: Final = 0.06


def trail_figure(
    trail: Sequence[RigidTransform],
    truth: RigidTransform | None = None,
    *,
    found: bool = True,
    at: int | None = None,
    points: Points | None = None,
    reach: float = 0.0,
    title: str = "",
) -> go.Figure:
    """Draw a search for a pose from above: start, the pose after each round, and where the camera truly was.

    Parameters
    ----------
    trail:
        ``cam_from_world``, in order; the first is the start.
    truth:
        The true one, where it is known.
    found:
        Whether the last one is the answer; else it is drawn as what was not believed.
    at:
        Which one to mark.
    points:
        Of the map, drawn below.
    reach:
        What is drawn reaches so many metres from the true position, or else from the start, or to all of the trail
        where that is farther; 0: the whole map.
    title:
        Of the figure.

    Raises
    ------
    DataError
        Without a start, and for a mark that there is not.
    """
    if not trail:
        raise DataError("A trail without a start cannot be drawn", expected="at least 1 pose", found="0")
    if at is not None and not 0 <= at < len(trail):
        raise DataError("There is no such pose in the trail", expected=f"0 to {len(trail) - 1}", found=f"{at}")
    centres = np.array([pose.centre for pose in trail])
    drawn = figure(title, 420, showlegend=False, margin={"t": 40})
    middle = centres[0] if truth is None else truth.centre
    far = max(reach, 1.1 * float(np.abs(centres - middle)[:, :2].max())) if reach > 0 else np.inf
    if points is not None and len(points):
        drawn.add_trace(_ground(points, middle, far))
    if truth is not None:
        drawn.add_scatter(
            x=truth.centre[:1],
            y=truth.centre[1:2],
            mode="markers",
            marker={"symbol": "circle-open", "size": 16, "color": COLOURS[2], "line": {"width": 3}},
            hovertemplate="true position<extra></extra>",
        )
    texts = ["start", *(f"after round {number}" for number in range(1, len(trail)))]
    last = "diamond" if found and len(trail) > 1 else "x" if len(trail) > 1 else "square"
    drawn.add_scatter(
        x=centres[:, 0],
        y=centres[:, 1],
        mode="lines+markers",
        line={"color": COLOURS[1], "width": 3},
        marker={
            "color": COLOURS[1],
            "size": [15 if number == at else 10 for number in range(len(trail))],
            "line": {"color": "white", "width": 1},
            "symbol": ["square", *["circle"] * (len(trail) - 2), last][: len(trail)],
        },
        text=texts,
        customdata=centres[:, 2],
        hovertemplate="%{text}: %{x:.1f} east, %{y:.1f} north, %{customdata:.1f} up<extra></extra>",
    )
    drawn.update_xaxes(title_text="east [m]", constrain="domain")
    drawn.update_yaxes(title_text="north [m]", scaleanchor="x", scaleratio=1)
    if np.isfinite(far):
        drawn.update_xaxes(range=[middle[0] - far, middle[0] + far])
        drawn.update_yaxes(range=[middle[1] - far, middle[1] + far], constrain="domain")
    return drawn


def _ground(points: Points, middle: NDArray[np.float64], far: float) -> go.Scattergl:
    """Return the map's points that are at most so far from the middle, along either axis."""
    near = np.flatnonzero((np.abs(points.xyz - middle)[:, :2] <= far).all(axis=1))
    keep = near[thinned(len(near), _MOST_POINTS)] if len(near) else near
    return go.Scattergl(
        x=points.xyz[keep, 0].astype(np.float32),
        y=points.xyz[keep, 1].astype(np.float32),
        mode="markers",
        hoverinfo="skip",
        opacity=0.35,
        marker={"size": 3, "color": [f"rgb({r},{g},{b})" for r, g, b in points.rgb[keep].tolist()]},
    )


def offset_errors_figure(
    errors: Mapping[str, Mapping[float, LocalizationErrors]],
    *,
    offset: Literal["metres", "degrees"] = "metres",
    title: str = "",
) -> go.Figure:
    """Draw errors of position over how far the starts were off: a dot a query, a line through the medians.

    Queries that were not found are no dots; below the axis stands how many were found. Where none was, the line has
    a gap. A dashed line is the start's own error.

    Parameters
    ----------
    errors:
        By method and offset.
    offset:
        What the starts were off by.

    Raises
    ------
    DataError
        Without methods or offsets.
    """
    if not errors or not all(errors.values()):
        raise DataError("There are no errors to draw", expected="a method with an offset", found="none")
    offsets = sorted({value for by_offset in errors.values() for value in by_offset})
    step = min(np.diff(offsets)) if len(offsets) > 1 else 1.0
    drawn = figure(title, 420, showlegend=True, margin={"b": 72})
    if offset == "metres" and len(offsets) > 1:
        line = [value for value in offsets if value > 0]
        drawn.add_scatter(
            x=line,
            y=line,
            name="the start",
            mode="lines",
            line={"color": NEUTRAL, "dash": "dash"},
            hoverinfo="skip",
        )
    for position, (method, by_offset) in enumerate(errors.items()):
        known = sorted(by_offset)
        all_x, all_y, names = _dots(by_offset, known, (position - (len(errors) - 1) / 2) * _ASIDE * step)
        drawn.add_scatter(
            x=all_x,
            y=np.maximum(all_y, _LEAST),
            name=shown(method),
            legendgroup=method,
            showlegend=False,
            mode="markers",
            marker={"color": colour(position), "size": 5},
            opacity=0.45,
            text=[shown(name) for name in names],
            customdata=all_y,
            hovertemplate="%{text}: %{customdata:.3f} m<extra>%{fullData.name}</extra>",
        )
        drawn.add_scatter(
            x=known,
            y=[_median(by_offset[value]) for value in known],
            name=shown(method),
            legendgroup=method,
            mode="lines+markers",
            line={"color": colour(position), "width": 2},
            marker={"size": 8},
            hovertemplate="median %{y:.3f} m<extra>%{fullData.name}</extra>",
        )
    drawn.update_xaxes(
        title_text=_UNITS[offset],
        tickvals=offsets,
        ticktext=[f"{value:g}<br>{_found(errors, value)}" for value in offsets],
    )
    drawn.update_yaxes(title_text="position error [m]", type="log", tickformat="~g", dtick="D2")
    # Above: below stand the numbers that were found.
    drawn.update_layout(legend={"y": 1.02, "yanchor": "bottom"})
    return drawn


def _dots(
    by_offset: Mapping[float, LocalizationErrors], known: Sequence[float], aside: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], list[str]]:
    """Return where the dots of queries that were found are, and the queries' names."""
    x, y, names = [], [], []
    for value in known:
        for name, error in zip(by_offset[value].names, by_offset[value].position.tolist(), strict=True):
            if np.isfinite(error):
                x.append(value + aside)
                y.append(error)
                names.append(name)
    return np.array(x, dtype=np.float64), np.array(y, dtype=np.float64), names


def _median(errors: LocalizationErrors) -> float | None:
    found = errors.position[np.isfinite(errors.position)]
    return max(float(np.median(found)), _LEAST) if len(found) else None


def _found(errors: Mapping[str, Mapping[float, LocalizationErrors]], offset: float) -> str:
    """Return how many were found by each method, of how many, in the order of the legend."""
    rows = [by_offset[offset] for by_offset in errors.values() if offset in by_offset]
    return "found " + ", ".join(str(row.found) for row in rows) + f" of {len(rows[0].names)}"
