"""Where splat maps leave the surface: distances seen from above, and how far Gaussians moved in training.

How the distances of several maps are spread is drawn by :func:`toolkit.plots.geometry.error_histogram`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.metrics.splat_geometry import Displacements
from toolkit.plots.style import colour, figure, shown

Array = NDArray[np.float64]

#: Most points drawn of one map.
MOST_POINTS = 15_000
_SCALE = "viridis"
_PANEL = 360  # pixels


def distance_maps(
    maps: Mapping[str, tuple[Array, Array]], *, most: float = 0.0, unit: str = "m", seed: int = 0
) -> go.Figure:
    """Draw Gaussians from above, coloured by their distance to the dense cloud: one panel a map, one scale for all.

    The figure of absolute cloud-to-cloud distances of Matzke et al. (Figure 3). Far ones are drawn last, so that a
    few of them are not hidden below many near ones. All panels show the same ground, which one Gaussian in five
    hundred may lie outside of: it would else make the rest of the map small.

    Parameters
    ----------
    maps:
        By label: centres (N, 3), x east and y north, and distances (N,). Thinned by chance to ``MOST_POINTS``.
    most:
        Distance at the upper end of the scale; 0: that of 95 in 100 of the map with the largest.

    Raises
    ------
    DataError
        Without maps, and for one without Gaussians or with another number of distances.
    """
    if not maps:
        raise DataError("There is no map to draw", expected="at least one map", found="none")
    for label, (centres, distances) in maps.items():
        if not len(centres) or centres.shape != (len(distances), 3):
            raise DataError(
                f"The distances of map '{label}' cannot be drawn",
                expected="centres (N, 3) and distances (N,)",
                found=f"{centres.shape} and {distances.shape}",
            )
    upper = most or max(float(np.percentile(distances, 95)) for _, distances in maps.values()) or 1.0
    medians = {label: float(np.median(distances)) for label, (_, distances) in maps.items()}
    drawn = figure("", _PANEL + 80, margin={"t": 40}, showlegend=False)
    drawn.set_subplots(
        1,
        len(maps),
        subplot_titles=[f"{shown(label)}: median {median:.3g} {shown(unit)}" for label, median in medians.items()],
        horizontal_spacing=0.06,
    )
    drawn.update_annotations(font_size=13)
    east, north = (_frame([centres[:, axis] for centres, _ in maps.values()]) for axis in (0, 1))
    for column, (centres, distances) in enumerate(maps.values(), start=1):
        rows = _drawn_rows(distances, seed)
        drawn.add_trace(
            go.Scattergl(
                x=centres[rows, 0].astype(np.float32),
                y=centres[rows, 1].astype(np.float32),
                mode="markers",
                marker={"size": 3, "color": distances[rows].astype(np.float32), "coloraxis": "coloraxis"},
                hovertemplate=f"%{{marker.color:.3g}} {shown(unit)}<extra></extra>",
            ),
            row=1,
            col=column,
        )
        axis = "" if column == 1 else str(column)
        drawn.update_yaxes(scaleanchor=f"x{axis}", scaleratio=1, range=north, row=1, col=column)
        drawn.update_xaxes(title_text=f"east [{shown(unit)}]", range=east, row=1, col=column)
    drawn.update_yaxes(title_text=f"north [{shown(unit)}]", row=1, col=1)
    drawn.update_layout(
        coloraxis={
            "colorscale": _SCALE,
            "cmin": 0.0,
            "cmax": upper,
            "colorbar": {"title": {"text": f"distance [{shown(unit)}]", "side": "right"}, "thickness": 14},
        }
    )
    return drawn


def displacement_histogram(
    maps: Mapping[str, Displacements], *, only_opaque: bool = False, unit: str = "m", bins: int = 60
) -> go.Figure:
    """Draw how far Gaussians moved in training: horizontal in the upper panel, vertical (up positive) in the lower.

    Parameters
    ----------
    maps:
        By label.
    only_opaque:
        Leave out those with an opacity of one half and less.

    Raises
    ------
    DataError
        Without maps, and where no Gaussian of one is left to draw.
    """
    if not maps:
        raise DataError("There is no map to draw", expected="at least one map", found="none")
    chosen = {label: moved.opaque if only_opaque else np.ones_like(moved.opaque) for label, moved in maps.items()}
    for label, rows in chosen.items():
        if not rows.any():
            raise DataError(f"Map '{label}' has no Gaussian to draw", expected="at least one", found="none")
    flat = {label: moved.horizontal[chosen[label]] for label, moved in maps.items()}
    steep = {label: moved.vertical[chosen[label]] for label, moved in maps.items()}
    # What moves farthest would squeeze all others into the first bin.
    far = max(float(np.percentile(np.abs(values), 98)) for part in (flat, steep) for values in part.values()) or 1.0
    drawn = figure("", 520, margin={"t": 40}, barmode="overlay")
    drawn.set_subplots(
        2,
        1,
        subplot_titles=[f"horizontal displacement [{shown(unit)}]", f"vertical displacement [{shown(unit)}]"],
        vertical_spacing=0.18,
    )
    drawn.update_annotations(font_size=13)
    for row, (part, low) in enumerate(((flat, 0.0), (steep, -far)), start=1):
        edges = np.linspace(low, far, bins + 1)
        for position, (label, values) in enumerate(part.items()):
            count, _ = np.histogram(np.clip(values, low, far), edges)
            drawn.add_trace(
                go.Scatter(
                    x=edges,
                    y=np.append(count / len(values), 0.0),
                    name=shown(label),
                    legendgroup=label,
                    showlegend=row == 1,
                    mode="lines",
                    line={"color": colour(position), "shape": "hv"},
                    hovertemplate=f"%{{x:.3g}} {shown(unit)}: %{{y:.1%}}<extra>{shown(label)}</extra>",
                ),
                row=row,
                col=1,
            )
        drawn.update_yaxes(title_text="share", tickformat=".0%", rangemode="tozero", row=row, col=1)
    return drawn


def _frame(values: list[Array]) -> list[float]:
    """Return the least and the largest coordinate, but for a few stray ones, with a margin."""
    low = min(float(np.percentile(each, 0.1)) for each in values)
    high = max(float(np.percentile(each, 99.9)) for each in values)
    margin = 0.03 * (high - low)
    return [low - margin, high + margin]


def _drawn_rows(distances: Array, seed: int) -> NDArray[np.int64]:
    """Return the rows that are drawn, the farthest last."""
    rows = np.arange(len(distances))
    if len(rows) > MOST_POINTS:
        rows = np.random.default_rng(seed).choice(len(rows), MOST_POINTS, replace=False)
    return rows[np.argsort(distances[rows], kind="stable")].astype(np.int64)
