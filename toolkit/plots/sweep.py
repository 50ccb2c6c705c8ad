"""What a sweep found: all settings and the objective of each trial, what mattered, and how it went on."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from toolkit.plots.style import GRID, NEUTRAL, colour, figure, shown

#: From worse to better; the ends are told apart on white and on near-black.
_SCALE = ((100, 116, 139), (59, 130, 246), (245, 158, 11))
_COLOURS = 15
_LONGEST = 18
#: Numbers of which each has a tick of its own, where there are no more.
_FEW = 7


@dataclass(frozen=True, slots=True)
class SweepAxis:
    """A setting that was swept.

    Attributes
    ----------
    name:
        Of the setting.
    choices:
        Its values where they are drawn as steps, in order: names, yes and no; empty for numbers.
    log:
        Whether numbers are drawn by their magnitudes.
    """

    name: str
    choices: tuple[Any, ...] = ()
    log: bool = False


@dataclass(frozen=True, slots=True)
class SweepPoint:
    """A trial.

    Attributes
    ----------
    number:
        From 0 on.
    values:
        By the names of the settings.
    objective:
        None where it has none.
    state:
        As ``"finished"`` or ``"pruned"``.
    """

    number: int
    values: Mapping[str, Any]
    objective: float | None
    state: str


def parallel_figure(
    axes: Sequence[SweepAxis], points: Sequence[SweepPoint], objective: str, *, maximise: bool
) -> go.Figure:
    """Draw each trial that has a result as a line through its settings to its objective, the best on top.

    Lines and not Plotly's own parallel coordinates: those need WebGL, and are one pixel thin on every ground.

    Parameters
    ----------
    axes:
        Settings from left to right.
    points:
        Trials; those without a result are left out.
    objective, maximise:
        What is measured, and whether more is better.
    """
    drawn = figure("", 400, margin={"l": 40, "r": 44, "t": 66, "b": 26}, showlegend=False, hovermode="closest")
    ended = _with_result(points)
    if not ended:
        return drawn
    results = np.array([point.objective for point in ended], dtype=np.float64)
    columns = [_column(axis, [point.values[axis.name] for point in ended]) for axis in axes]
    columns.append(_column(SweepAxis(objective), results.tolist()))
    heights = np.stack([column.heights for column in columns], axis=1)
    goodness = columns[-1].heights if maximise else 1 - columns[-1].heights
    steps = np.minimum((goodness * _COLOURS).astype(int), _COLOURS - 1)
    # One trace a colour, with gaps between its trials: thousands of traces would be slow. The best come last.
    for step in np.unique(steps):
        chosen = np.flatnonzero(steps == step)
        gap = np.full((len(chosen), 1), np.nan)
        drawn.add_scatter(
            x=np.tile([*range(len(columns)), np.nan], len(chosen)),
            y=np.hstack([heights[chosen], gap]).ravel(),
            mode="lines+markers",
            line={"color": _colour_of(int(step)), "width": 1.5 + 1.5 * step / (_COLOURS - 1)},
            marker={"size": 6},
            text=np.repeat([_told(ended[i], objective) for i in chosen], len(columns) + 1),
            hovertemplate="%{text}<extra></extra>",
        )
    for place, (name, column) in enumerate(zip([*(axis.name for axis in axes), objective], columns, strict=True)):
        _draw_axis(drawn, place, name, column, last=place == len(axes))
    drawn.update_xaxes(visible=False, range=[-0.12, len(axes) + 0.12], fixedrange=True)
    drawn.update_yaxes(visible=False, range=[-0.04, 1.04], fixedrange=True)
    return drawn


@dataclass(frozen=True, slots=True)
class _Column:
    """Where trials lie on an axis, and where its ticks, from 0 at the bottom to 1."""

    heights: NDArray[np.float64]
    ticks: Mapping[float, str]


def _column(axis: SweepAxis, values: Sequence[Any]) -> _Column:
    if axis.choices:
        between = max(len(axis.choices) - 1, 1)
        ticks = {place / between: _tick(choice) for place, choice in enumerate(axis.choices)}
        return _Column(np.array([axis.choices.index(value) / between for value in values]), ticks)
    numbers = np.asarray(values, dtype=np.float64)
    few = np.unique(numbers)
    scale = np.log10 if axis.log else np.asarray
    low, high = float(scale(few[0])), float(scale(few[-1]))
    if high == low:
        return _Column(np.full(len(numbers), 0.5), {0.5: _tick(float(few[0]))})
    shown_at = few if len(few) <= _FEW else _round_numbers(low, high, log=axis.log)
    ticks = {(float(scale(number)) - low) / (high - low): _tick(float(number)) for number in shown_at}
    return _Column((scale(numbers) - low) / (high - low), ticks)


def _round_numbers(low: float, high: float, *, log: bool) -> NDArray[np.float64]:
    """Return a few round numbers from ``low`` to ``high``, both exponents of ten with ``log``."""
    if log:
        whole = np.arange(math.ceil(low), math.floor(high) + 1, dtype=np.float64)
        return np.power(10.0, whole if len(whole) > 1 else np.array([low, (low + high) / 2, high]))
    size = 10.0 ** math.floor(math.log10((high - low) / 2))
    step = next(size * factor for factor in (1, 2, 5, 10) if (high - low) / (size * factor) <= 5)
    return np.arange(math.ceil(low / step), math.floor(high / step) + 1, dtype=np.float64) * step


def _draw_axis(drawn: go.Figure, place: int, name: str, column: _Column, *, last: bool) -> None:
    drawn.add_shape(type="line", x0=place, x1=place, y0=0, y1=1, line={"color": NEUTRAL, "width": 1}, layer="below")
    drawn.add_annotation(x=place, y=1, text=shown(_short(name)), yshift=38, textangle=-14, showarrow=False)
    for height, text in column.ticks.items():
        # Where no line goes: at the ends beyond the axis, right of the last one; else beside it, on a plate.
        end = 0 if last else 1 if height > 0.999 else -1 if height < 0.001 else 0
        drawn.add_annotation(
            x=place,
            y=height,
            text=shown(text),
            xanchor="center" if end else "left" if last else "right",
            xshift=0 if end else 6 if last else -6,
            yshift=11 * end,
            bgcolor=None if end or last else GRID,
            borderpad=1,
            showarrow=False,
            font={"size": 11},
        )


def _with_result(points: Sequence[SweepPoint]) -> list[SweepPoint]:
    return [point for point in points if point.objective is not None and math.isfinite(point.objective)]


def _told(point: SweepPoint, objective: str) -> str:
    values = "".join(f"<br>{shown(name)}: {shown(_tick(value))}" for name, value in point.values.items())
    return f"trial {point.number}<br>{shown(objective)}: {point.objective:.5g}{values}"


def _colour_of(step: int) -> str:
    """Return the colour of a step from worst to best."""
    share = step / (_COLOURS - 1) * (len(_SCALE) - 1)
    low = min(int(share), len(_SCALE) - 2)
    mixed = (round(a + (b - a) * (share - low)) for a, b in zip(_SCALE[low], _SCALE[low + 1], strict=True))
    return "rgb({},{},{})".format(*mixed)


def importance_figure(importances: Mapping[str, float]) -> go.Figure:
    """Draw how much each setting mattered, the most important on top; they sum to 1."""
    drawn = figure("", 110 + 34 * max(len(importances), 1), margin={"t": 16, "l": 12}, bargap=0.4)
    names = [shown(name) for name in importances]
    drawn.add_bar(
        y=names,
        x=list(importances.values()),
        orientation="h",
        marker={"color": colour(0)},
        text=[f"{value:.0%}" for value in importances.values()],
        textposition="outside",
        cliponaxis=False,
        hovertemplate="%{y}: %{x:.3f}<extra></extra>",
    )
    drawn.update_xaxes(
        title_text="share", range=[0, 1.12 * max(importances.values(), default=1.0)], tickformat=".0%"
    )
    drawn.update_yaxes(autorange="reversed", type="category", showgrid=False)
    return drawn


def trials_figure(points: Sequence[SweepPoint], objective: str, *, maximise: bool) -> go.Figure:
    """Draw the objective of each trial, and the best so far as a line."""
    drawn = figure("", 300, hovermode="closest", margin={"t": 16})
    ended = sorted(_with_result(points), key=lambda point: point.number)
    numbers = [point.number for point in ended]
    results = np.array([point.objective for point in ended], dtype=np.float64)
    if len(results):
        best = np.maximum.accumulate(results) if maximise else np.minimum.accumulate(results)
        drawn.add_scatter(
            x=numbers,
            y=best,
            name="best so far",
            mode="lines",
            line={"color": colour(1), "width": 2, "shape": "hv"},
            hovertemplate="best up to trial %{x}: %{y:.5g}<extra></extra>",
        )
        drawn.add_scatter(
            x=numbers,
            y=results,
            name="trial",
            mode="markers",
            marker={"color": colour(0), "size": 9},
            text=[_told(point, objective) for point in ended],
            hovertemplate="%{text}<extra></extra>",
        )
    # Left alone, Plotly puts ticks between few trials.
    drawn.update_xaxes(title_text="trial", dtick=1 if numbers and numbers[-1] < 12 else None, tickformat="d")
    drawn.update_yaxes(title_text=shown(objective))
    return drawn


def _short(name: str) -> str:
    """Return a name as it fits above an axis: its last part, or the end of that."""
    last = name.rpartition(".")[2]
    return last if len(last) <= _LONGEST else "…" + last[1 - _LONGEST :]


def _tick(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.5g}" if isinstance(value, float) else str(value)
