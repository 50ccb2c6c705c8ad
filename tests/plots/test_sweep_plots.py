"""Figures of sweeps show the numbers that they are given."""

from __future__ import annotations

import math

import numpy as np
import plotly.graph_objects as go
import pytest

from toolkit.plots.sweep import SweepAxis, SweepPoint, importance_figure, parallel_figure, trials_figure

AXES = (
    SweepAxis("train.rate", log=True),
    SweepAxis("mode", choices=("plain", "odd")),
    SweepAxis("on", (False, True)),
)
POINTS = tuple(
    SweepPoint(number, {"train.rate": rate, "mode": mode, "on": on}, value, "finished")
    for number, (rate, mode, on, value) in enumerate(
        [
            (1e-4, "odd", True, 20.0),
            (1e-1, "plain", False, 24.0),
            (1e-2, "plain", True, None),
            (1e-3, "odd", False, 22.0),
            (1e-3, "odd", False, math.nan),
        ]
    )
)


def heights(figure: go.Figure) -> dict[str, list[float]]:
    """Return where each trial lies on the axes, by what is told of it, in the order of drawing."""
    found: dict[str, list[float]] = {}
    for trace in figure.data:
        for x, y, text in zip(trace.x, trace.y, trace.text, strict=True):
            if not math.isnan(x):
                found.setdefault(text.partition("<br>")[0], []).append(float(y))
    return found


def ticks(figure: go.Figure, place: int) -> dict[str, float]:
    return {note.text: note.y for note in figure.layout.annotations if note.x == place and note.textangle is None}


@pytest.mark.parametrize(("maximise", "order"), [(True, [0, 3, 1]), (False, [1, 3, 0])])
def test_trials_are_lines_through_their_settings_and_the_best_is_drawn_last(
    maximise: bool, order: list[int]
) -> None:
    figure = parallel_figure(AXES, POINTS, "test.psnr", maximise=maximise)
    drawn = heights(figure)
    assert list(drawn) == [f"trial {number}" for number in order]
    # Rates by magnitude from 1e-4 to 1e-1, choices in their order, PSNR from 20 to 24.
    assert drawn["trial 0"] == pytest.approx([0, 1, 1, 0])
    assert drawn["trial 1"] == pytest.approx([1, 0, 0, 1])
    assert drawn["trial 3"] == pytest.approx([1 / 3, 1, 0, 0.5])
    assert ticks(figure, 0) == {"0.0001": 0.0, "0.001": pytest.approx(1 / 3), "0.1": 1.0}
    assert ticks(figure, 1) == {"plain": 0.0, "odd": 1.0}
    assert ticks(figure, 2) == {"no": 0.0, "yes": 1.0}
    titles = [note.text for note in figure.layout.annotations if note.textangle is not None]
    assert titles == ["rate", "mode", "on", "psnr"]
    assert figure.data[-1].line.color == "rgb(245,158,11)"
    assert figure.data[0].line.color == "rgb(100,116,139)"


@pytest.mark.parametrize(
    ("ends", "log", "told"),
    [
        ((0.2, 0.3), True, ["0.2", "0.24495", "0.3"]),
        ((2e-5, 0.3), True, ["0.0001", "0.001", "0.01", "0.1"]),
        ((0.1, 0.93), False, ["0.2", "0.4", "0.6", "0.8"]),
        ((-3.0, 7.0), False, ["-2", "0", "2", "4", "6"]),
    ],
)
def test_ticks_are_round_numbers_where_there_are_many_values(
    ends: tuple[float, float], log: bool, told: list[str]
) -> None:
    values = np.geomspace(*ends, 20) if log else np.linspace(*ends, 20)
    points = [SweepPoint(i, {"a": value}, 1.0, "finished") for i, value in enumerate(values)]
    figure = parallel_figure([SweepAxis("a", log=log)], points, "x", maximise=True)
    assert list(ticks(figure, 0)) == told
    assert ticks(figure, 1) == {"1": 0.5}  # all the same: in the middle


def test_importances_are_bars_the_most_important_on_top() -> None:
    figure = importance_figure({"train.rate": 0.75, "mode": 0.25})
    assert list(figure.data[0].y) == ["train.rate", "mode"]
    assert list(figure.data[0].x) == [0.75, 0.25]
    assert list(figure.data[0].text) == ["75%", "25%"]
    assert figure.layout.yaxis.autorange == "reversed"


@pytest.mark.parametrize(("maximise", "best"), [(True, [20.0, 24.0, 24.0]), (False, [20.0, 20.0, 20.0])])
def test_the_best_so_far_is_a_line_over_the_trials(maximise: bool, best: list[float]) -> None:
    line, marks = trials_figure(tuple(reversed(POINTS)), "test.psnr", maximise=maximise).data
    assert list(marks.x) == [0, 1, 3]
    assert list(marks.y) == [20.0, 24.0, 22.0]
    assert list(line.y) == best
    assert marks.text[0] == "trial 0<br>test.psnr: 20<br>train.rate: 0.0001<br>mode: odd<br>on: yes"


def test_no_trials_are_no_error() -> None:
    assert len(parallel_figure(AXES, (), "x", maximise=True).data) == 0
    assert len(trials_figure((), "x", maximise=True).data) == 0
    assert len(importance_figure({}).data[0].y) == 0


def test_tags_in_names_are_shown_and_not_obeyed() -> None:
    odd = '<a href="x">&'
    point = SweepPoint(0, {odd: odd}, 1.0, "finished")
    figures = (
        parallel_figure([SweepAxis(odd, (odd,))], [point], odd, maximise=True),
        trials_figure([point], odd, maximise=True),
        importance_figure({odd: 1.0}),
    )
    for figure in figures:
        assert "<a" not in figure.to_json().replace("<extra>", "").replace("\\u003c", "<")
