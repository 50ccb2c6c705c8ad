"""Poses of queries against a map: success over the start's offset, errors as bars, and from round to round."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal

import numpy as np
import plotly.graph_objects as go
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError
from toolkit.plots.style import NEUTRAL, colour, dash, figure, shown

Array = NDArray[np.float64]

_UNITS: Final = {"metres": "start off by [m]", "degrees": "start turned by [°]"}
_SYMBOLS: Final = ("circle", "diamond", "square", "x", "triangle-up")
#: Two standard deviations.
_NORMAL: Final = 1.96
#: Errors below a tenth of a millimetre, and those of a start that is exact, are drawn there: a logarithm has no 0.
_LEAST: Final = 1e-4


def success_figure(
    curves: Mapping[str, tuple[ArrayLike, ArrayLike]],
    *,
    offset: Literal["metres", "degrees"],
    queries: int | None = None,
    success: str = "",
    title: str = "",
) -> go.Figure:
    """Draw which share of the queries succeeds, over how far their starts were off, one line a method.

    Parameters
    ----------
    curves:
        By method, offsets (N,) in metres or degrees, and shares (N,) from 0 to 1 of the queries.
    offset:
        What the starts were off by.
    queries:
        How many queries each share is of: then bands of 95 % are drawn (Wilson 1927, "Probable inference, the law
        of succession, and statistical inference").
    success:
        What counts as success, for the axis.
    title:
        Of the figure.

    Raises
    ------
    DataError
        For offsets and shares that do not correspond, shares outside 0 to 1, and no queries.
    """
    if queries is not None and queries < 1:
        raise DataError("Shares of no query cannot be drawn", expected="at least 1 query", found=str(queries))
    drawn = figure(title, 340, showlegend=True, hovermode="x unified")
    for position, (label, (offsets, shares)) in enumerate(curves.items()):
        x, y = _curve(label, offsets, shares)
        shade, line = colour(position), dash(position)
        if queries is not None and len(x):
            low, high = _wilson(y, queries)
            drawn.add_scatter(
                x=np.concatenate([x, x[::-1]]),
                y=100 * np.concatenate([low, high[::-1]]),
                fill="toself",
                fillcolor=shade,
                opacity=0.15,
                line={"width": 0},
                mode="lines",
                legendgroup=label,
                showlegend=False,
                hoverinfo="skip",
            )
        drawn.add_scatter(
            x=x,
            y=100 * y,
            name=shown(label),
            legendgroup=label,
            mode="lines+markers",
            line={"color": shade, "width": 2, "dash": line},
            marker={"color": shade, "size": 7, "symbol": _SYMBOLS[position % len(_SYMBOLS)]},
            hovertemplate="%{y:.0f} %",
        )
    drawn.update_xaxes(title_text=_UNITS[offset], rangemode="tozero")
    drawn.update_yaxes(title_text=f"queries {success or 'found'} [%]", range=[-3, 103])
    return drawn


def mte_bars(
    errors: Mapping[str, Mapping[str, Mapping[str, float | None]]],
    *,
    reference: str = "",
    title: str = "mean translational error [m]",
) -> go.Figure:
    """Draw mean errors as bars on a logarithmic axis: a group a map and scenario, a colour a method.

    Parameters
    ----------
    errors:
        By method, map and scenario, metres; None or left out where there is no figure: then there is no bar.
    reference:
        The method whose figures are not ours, such as the paper's: in grey and hatched.
    title:
        Of the axis.

    Raises
    ------
    DataError
        For an error that is not positive: a logarithm has no place for it.
    """
    maps = list(dict.fromkeys(name for by_map in errors.values() for name in by_map))
    scenarios = list(dict.fromkeys(s for by_map in errors.values() for row in by_map.values() for s in row))
    places = [(of, scenario) for of in maps for scenario in scenarios]
    drawn = figure("", 420, barmode="group", bargap=0.25, margin={"t": 48}, showlegend=True)
    shade = 0
    for method, by_map in errors.items():
        values = [by_map.get(of, {}).get(scenario) for of, scenario in places]
        wrong = [value for value in values if value is not None and not value > 0]
        if wrong:
            raise DataError(f"Errors of '{method}' cannot be drawn", expected="metres above 0", found=f"{wrong[0]}")
        own = method != reference
        drawn.add_bar(
            x=[[shown(of) for of, _ in places], [shown(scenario) for _, scenario in places]],
            y=values,
            name=shown(method),
            marker={"color": colour(shade) if own else NEUTRAL, "pattern": {"shape": "" if own else "/"}},
            hovertemplate="%{x}: %{y:.3f} m<extra>%{fullData.name}</extra>",
        )
        shade += own
    drawn.update_yaxes(title_text=shown(title), type="log", tickformat="~g", dtick="D2")
    # Above: below stand the names of scenarios and maps.
    drawn.update_layout(legend={"y": 1.03, "yanchor": "bottom"})
    return drawn


def convergence_figure(
    errors: Mapping[str, ArrayLike], steps: Mapping[str, ArrayLike] | None = None, *, title: str = ""
) -> go.Figure:
    """Draw how far off each pose was from round to round, and how far the pose moved, on logarithmic axes.

    Parameters
    ----------
    errors:
        By query or method, distances (R,) in metres from the true centre: first the start's, then those after
        each round. NaN leaves a gap.
    steps:
        By the same names, how far (R - 1,) the centre moved in each round, in metres.
    title:
        Of the figure.

    Raises
    ------
    DataError
        For as many steps as there are errors, or steps of what has no errors.
    """
    drawn = figure(title, 480 if steps else 320, showlegend=len(errors) > 1)
    rows = 2 if steps else 1
    drawn.set_subplots(rows, 1, shared_xaxes=True, vertical_spacing=0.07)
    kinds = [(1, errors, 0), *([(2, steps, 1)] if steps else [])]
    for row, values, first in kinds:
        for label, numbers in values.items():
            if label not in errors:
                raise DataError(f"Steps of '{label}' have no errors", expected="the same names", found=label)
            y = np.asarray(numbers, dtype=np.float64).ravel()
            rounds = np.asarray(errors[label]).size
            if len(y) != rounds - first:
                raise DataError(
                    f"Errors and steps of '{label}' do not correspond",
                    expected=f"{rounds - 1} steps for {rounds} errors",
                    found=f"{len(y)}",
                )
            position = list(errors).index(label)
            drawn.add_scatter(
                x=np.arange(first, first + len(y)),
                y=np.maximum(y, _LEAST),
                customdata=y,
                name=shown(label),
                legendgroup=label,
                showlegend=row == 1,
                mode="lines+markers",
                line={"color": colour(position), "width": 2, "dash": dash(position)},
                marker={"color": colour(position), "size": 6},
                hovertemplate="round %{x}: %{customdata:.4f} m<extra>%{fullData.name}</extra>",
                row=row,
                col=1,
            )
    for row, text in ((1, "position error [m]"), (2, "moved [m]"))[:rows]:
        drawn.update_yaxes(title_text=text, type="log", tickformat="~g", row=row, col=1)
    drawn.update_xaxes(title_text="round (0: start)", dtick=1, row=rows, col=1)
    return drawn


def _curve(label: str, offsets: ArrayLike, shares: ArrayLike) -> tuple[Array, Array]:
    x, y = np.asarray(offsets, dtype=np.float64).ravel(), np.asarray(shares, dtype=np.float64).ravel()
    if len(x) != len(y):
        raise DataError(
            f"Offsets and shares of '{label}' do not correspond", expected=f"{len(x)}", found=f"{len(y)}"
        )
    if len(y) and not (y.min() >= 0 and y.max() <= 1):
        raise DataError(f"'{label}' has shares that are none", expected="0 to 1", found=f"{y.min()} to {y.max()}")
    return x, y


def _wilson(share: Array, count: int) -> tuple[Array, Array]:
    """Return the bounds of 95 % of shares that were counted on so many trials."""
    spread = _NORMAL**2 / count
    middle = (share + spread / 2) / (1 + spread)
    half = _NORMAL / (1 + spread) * np.sqrt(share * (1 - share) / count + spread / (4 * count))
    return np.clip(middle - half, 0, 1), np.clip(middle + half, 0, 1)
