"""Figures show the numbers that they are given, and keep one colour a run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
import pytest

from toolkit.geometry.rigid import RigidTransform
from toolkit.plots.curves import MOST_POINTS, curve_figure, thinned
from toolkit.plots.style import COLOURS, DASHES, colour, dash, shown
from toolkit.plots.times import time_figure
from toolkit.plots.trajectories import camera_lines, trajectory_figure
from toolkit.plots.views import view_figure


@dataclass
class Stage:
    name: str
    seconds: float
    reused: bool = False


def ring(count: int, radius: float = 5.0) -> dict[str, RigidTransform]:
    angles = np.linspace(0, 6, count)
    return {
        f"{i}.jpg": RigidTransform.look_at((radius * np.cos(a), radius * np.sin(a), 2.0), (0, 0, 0))
        for i, a in enumerate(angles)
    }


def names(figure: go.Figure) -> list[str]:
    return [trace.name for trace in figure.data if trace.showlegend is not False]


@pytest.mark.parametrize(("values", "ticks"), [([0.45, 0.25], "D1"), ([3.0, 0.02], "D2"), ([np.nan, 0.0], "D1")])
def test_a_logarithmic_axis_has_labels_however_short_it_is(values: list[float], ticks: str) -> None:
    """Labels at 1, 2 and 5 only leave none between 0.25 and 0.45."""
    figure = curve_figure({"a": ([1, 2], values)}, title="loss", x_title="step", log=True)
    assert figure.layout.yaxis.dtick == ticks


def test_a_curve_shows_its_values() -> None:
    figure = curve_figure({"a": ([1, 2, 3], [0.3, 0.2, 0.1])}, title="loss", x_title="step", log=True)
    assert list(figure.data[0].x) == [1, 2, 3]
    assert list(figure.data[0].y) == [0.3, 0.2, 0.1]
    assert figure.layout.yaxis.type == "log"
    assert figure.layout.xaxis.title.text == "step"
    assert figure.layout.title.text == "loss"
    assert figure.layout.showlegend is False  # one run needs no legend


def test_a_run_without_this_curve_keeps_its_colour_for_the_next() -> None:
    figure = curve_figure({"a": ([], []), "b": ([1, 2], [1, 2])}, title="", x_title="")
    assert names(figure) == ["b"]
    assert figure.data[0].line.color == colour(1)


def test_a_single_value_is_a_mark() -> None:
    assert curve_figure({"a": ([1], [2])}, title="", x_title="").data[0].mode == "markers"


@pytest.mark.parametrize("count", [1, 2, MOST_POINTS, MOST_POINTS + 1, 70000])
def test_long_curves_are_thinned_evenly_with_both_ends(count: int) -> None:
    kept = thinned(count)
    assert len(kept) == min(count, MOST_POINTS)
    assert (kept[0], kept[-1]) == (0, count - 1)
    gaps = np.diff(kept)
    assert len(gaps) == 0 or gaps.max() - gaps.min() <= 1


def test_colours_begin_again_with_another_line_style() -> None:
    marks = [(colour(i), dash(i)) for i in range(len(COLOURS) * len(DASHES))]
    assert len(set(marks)) == len(marks)


def test_tags_in_names_are_shown_and_not_obeyed() -> None:
    odd = '<a href="x">&'
    assert shown(odd) == '&lt;a href="x"&gt;&amp;'
    figures = (
        curve_figure({odd: ([1, 2], [1, 2])}, title=odd, x_title=""),
        time_figure({odd: [Stage(odd, 1.0)]}),
        trajectory_figure({odd: ring(3)}),
        view_figure({odd: {odd: 1.0}}, [odd], measure=""),
    )
    for figure in figures:
        assert "<a" not in figure.to_json().replace("<extra>", "").replace("\\u003c", "<")


def test_bars_are_stacked_by_stage_and_hatched_where_reused() -> None:
    figure = time_figure({"a": [Stage("sfm", 3.0), Stage("train", 9.0)], "b": [Stage("sfm", 3.0, reused=True)]})
    assert figure.layout.barmode == "stack"
    sfm, train = figure.data
    assert (sfm.name, list(sfm.y), list(sfm.x)) == ("sfm", ["a", "b"], [3.0, 3.0])
    assert list(sfm.marker.pattern.shape) == ["", "/"]
    assert list(sfm.customdata) == ["computed", "reused"]
    assert list(train.x) == [9.0, None]
    assert [note.text for note in figure.layout.annotations] == ["a", "b"]


def test_no_times_are_no_error() -> None:
    assert len(time_figure({}).data) == 0


def test_trajectories_run_through_the_camera_centres() -> None:
    poses = ring(7)
    figure = trajectory_figure({"run": poses}, ring(7, radius=5.1))
    assert names(figure) == ["reference", "run"]
    path = next(trace for trace in figure.data if trace.name == "run")
    centres = np.stack([path.x, path.y, path.z], axis=1)
    np.testing.assert_allclose(centres, [pose.centre for pose in poses.values()])
    assert list(path.text) == list(poses)
    assert figure.layout.scene.aspectmode == "data"


def test_a_run_without_poses_is_left_out_and_keeps_its_colour() -> None:
    figure = trajectory_figure({"none": {}, "some": ring(3)})
    assert names(figure) == ["some"]
    assert figure.data[0].line.color == colour(1)
    assert len(trajectory_figure({}).data) == 0


def test_cameras_are_pyramids_that_look_forward() -> None:
    pose = RigidTransform.look_at((0, 0, 10), (0, 0, 0))
    lines = camera_lines([pose], 2.0)
    ends = lines[np.isfinite(lines).all(axis=1)]
    tips = ends[np.linalg.norm(ends - [0, 0, 10], axis=1) < 1e-9]
    base = ends[np.linalg.norm(ends - [0, 0, 10], axis=1) >= 1e-9]
    assert len(tips) == 7  # three triangles come back to the centre, the last line does not
    np.testing.assert_allclose(base[:, 2], 8.0, atol=1e-9)  # two units deep, towards the ground
    assert np.isnan(lines[-1]).all()
    assert camera_lines([], 1.0).shape == (0, 3)


def test_many_cameras_are_thinned_but_all_centres_drawn() -> None:
    figure = trajectory_figure({"run": ring(500)}, most_cameras=50)
    path, pyramids = figure.data
    assert len(path.x) == 500
    assert len(pyramids.x) == len(camera_lines(list(ring(50).values()), 1.0))


def test_one_camera_alone_is_drawn() -> None:
    figure = trajectory_figure({"run": ring(1)})
    assert np.isfinite(np.asarray(figure.data[1].x, float)).any()


def test_measures_of_pictures_are_marks_in_the_given_order() -> None:
    figure = view_figure({"a": {"x": 1.0, "y": 2.0}, "b": {"y": 3.0}}, ["y", "x"], measure="PSNR in dB")
    assert list(figure.data[0].x) == ["y", "x"]
    assert list(figure.data[0].y) == [2.0, 1.0]
    assert list(figure.data[1].y) == [3.0, None]
    assert figure.layout.yaxis.title.text == "PSNR in dB"
    second = view_figure({"none": {}, "some": {"x": 1.0}}, ["x"], measure="").data
    assert [(trace.name, trace.marker.color) for trace in second] == [("some", colour(1))]
