"""The pictures of a selection show who was chosen, where it stands and what it gained."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import pytest

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.plots.view_selection import (
    MOST_LEFT_OUT,
    gain_figure,
    scene_selection_figure,
    view_selection_figure,
)
from toolkit.scene import Frame, Georeference, Scene
from toolkit.views.fisher import select_views
from toolkit.views.scene_views import select_from_scene
from toolkit.views.settings import ViewSelectionSettings


def views(count: int, widest_deg: float = 30.0) -> np.ndarray:
    """Directions away from cameras that stand above the ground."""
    rng = np.random.default_rng(0)
    height = rng.uniform(np.cos(np.radians(widest_deg)), 1.0, count)
    turn = rng.uniform(0, 2 * np.pi, count)
    flat = np.sqrt(1 - height**2)
    return -np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)


def marks(drawn: go.Figure, name: str) -> go.Scatter3d:
    (trace,) = [trace for trace in drawn.data if trace.name is not None and trace.name.startswith(name)]
    return trace


def test_chosen_views_stand_where_their_cameras_are_numbered_in_order_of_pick() -> None:
    directions = views(12)
    names = [f"{i}<b>.tif" for i in range(12)]
    selection = select_views(directions, 4)
    drawn = view_selection_figure(selection, directions, names, compass=True)
    chosen, rest = marks(drawn, "chosen"), marks(drawn, "left out")
    np.testing.assert_allclose(
        np.stack([chosen.x, chosen.y, chosen.z], axis=1), -directions[list(selection.chosen)]
    )
    assert list(chosen.text) == ["1", "2", "3", "4"]
    assert chosen.hovertext[0].startswith(f"pick 1: {selection.chosen[0]}&lt;b&gt;.tif<br>")
    camera = -directions[selection.chosen[0]]
    tilt, azimuth = np.degrees(np.arccos(camera[2])), np.degrees(np.arctan2(camera[0], camera[1])) % 360
    assert chosen.hovertext[0].endswith(f"{tilt:.1f}° from the pole, azimuth {azimuth:.1f}°")
    assert rest.name == "left out (8)"
    assert len(rest.x) == 8
    assert drawn.layout.title.text.startswith("4 of 12 views, most spread by brute force, determinant ")


def test_rays_run_from_the_focus_to_each_camera() -> None:
    directions = views(6)
    drawn = view_selection_figure(select_views(directions, 2), directions)
    (rays,) = [trace for trace in drawn.data if trace.legendgroup == "chosen (2)" and trace.mode == "lines"]
    ends = np.stack([rays.x, rays.y, rays.z], axis=1).reshape(2, 3, 3)
    np.testing.assert_array_equal(ends[:, 0], 0.0)
    np.testing.assert_allclose(np.linalg.norm(ends[:, 1], axis=1), 1.0)
    assert np.isnan(ends[:, 2]).all()
    assert "determinant 0" in drawn.layout.title.text


@pytest.mark.parametrize(("widest", "last"), [(28.0, "30°"), (75.0, "90°"), (170.0, "180°")])
def test_the_grid_reaches_as_far_as_the_views(widest: float, last: str) -> None:
    turn = np.radians([0.0, 120.0, 240.0])
    tilt = np.radians(widest)
    cameras = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.full(3, np.cos(tilt))], axis=1)
    drawn = view_selection_figure(select_views(-cameras, 1), -cameras)
    (texts,) = [trace.text for trace in drawn.data if trace.mode == "text"]
    assert texts[-1] == last


def test_north_is_marked_where_the_hemisphere_says_so() -> None:
    directions = views(5)
    drawn = view_selection_figure(select_views(directions, 3), directions, compass=True)
    (marked,) = [trace for trace in drawn.data if trace.mode == "text"]
    north = list(marked.text).index("N")
    assert marked.x[north] == pytest.approx(0.0, abs=1e-9)
    assert marked.y[north] > 0.4
    assert drawn.layout.scene.yaxis.visible is False


def test_of_very_many_views_only_some_are_drawn_and_the_legend_says_so() -> None:
    directions = views(MOST_LEFT_OUT + 100)
    settings = ViewSelectionSettings(method="greedy")
    drawn = view_selection_figure(select_views(directions, 5, settings), directions)
    assert len(marks(drawn, "left out").x) == MOST_LEFT_OUT
    assert marks(drawn, "left out").name == f"left out ({MOST_LEFT_OUT} of {MOST_LEFT_OUT + 95} drawn)"


def test_a_picture_of_all_views_has_none_left_out() -> None:
    directions = views(4)
    drawn = view_selection_figure(select_views(directions, 4), directions)
    assert not [trace for trace in drawn.data if trace.name is not None and trace.name.startswith("left out")]


def test_figures_refuse_views_that_are_not_those_of_the_selection() -> None:
    directions = views(5)
    selection = select_views(directions, 3)
    with pytest.raises(ValueError, match="expected 5 views, got 4 and 4 names"):
        view_selection_figure(selection, directions[:4])
    with pytest.raises(ValueError, match="expected 5 views, got 5 and 2 names"):
        view_selection_figure(selection, directions, ["a", "b"])
    with pytest.raises(DataError, match="not of length 1"):
        view_selection_figure(selection, 2 * directions)


@pytest.mark.parametrize("georeferenced", [True, False])
def test_a_scene_is_drawn_about_its_own_up(georeferenced: bool) -> None:
    cameras = -views(6)
    # An arbitrary world lies askew: up is along x.
    places = 10 * (cameras if georeferenced else cameras[:, [2, 0, 1]])
    frames = tuple(
        Frame(f"{i}.png", 1, RigidTransform.look_at(place, np.zeros(3))) for i, place in enumerate(places)
    )
    georeference = Georeference(50.0, 8.0, 100.0) if georeferenced else None
    scene = Scene(Path("images"), {1: ColmapCamera.pinhole(64, 48, 60.0)}, frames, georeference=georeference)
    drawn = scene_selection_figure(select_from_scene(scene, ViewSelectionSettings(count=3)))
    up = drawn.layout.scene.camera.up
    assert (up.z if georeferenced else up.x) > 0.95
    assert marks(drawn, "chosen").hovertext[0].startswith("pick 1: ")
    assert ("azimuth" in marks(drawn, "chosen").hovertext[0]) is georeferenced


def test_the_gain_curve_rises_to_the_share_of_all_views() -> None:
    directions = views(9)
    flat = directions * (1, 0, 1) / np.linalg.norm(directions * (1, 0, 1), axis=1, keepdims=True)
    drawn = gain_figure({"all": select_views(directions, 9), "plane": select_views(flat, 4)})
    whole, plane = drawn.data
    assert list(whole.x) == list(range(1, 10))
    assert np.isnan(whole.y[:2]).all()
    assert np.all(np.diff(whole.y[2:]) > 0)
    assert whole.y[-1] == pytest.approx(1.0)
    assert plane.name == "plane (angles of pairs)"
    assert np.isnan(plane.y[0])
    assert np.all(np.diff(plane.y[1:]) > 0)
