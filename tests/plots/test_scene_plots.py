"""Figures of scenes, matches and pictures show the numbers that they are given."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import pytest
from PIL import Image

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.plots import scene_map as scene_map_module
from toolkit.plots.matches import match_graph_figure, matches_figure
from toolkit.plots.pictures import LONGEST_SIDE, eight_bit, photo_against_render
from toolkit.plots.scene_map import MOST_POINTS, scene_map
from toolkit.plots.trajectories import space
from toolkit.scene import Frame, Georeference, Points, PosePrior, Scene

CENTRES = np.array([[10.0, 0.0, 5.0], [0.0, 10.0, 5.0], [-10.0, 0.0, 5.0]])
SENSED = np.array([0.0, -10.0, 6.0])


def scene(names: tuple[str, ...] = ("a.jpg", "b.jpg", "c.jpg"), points: Points | None = None) -> Scene:
    """Three cameras that look inwards, the second a test frame, one known by its sensors only, one by nothing."""
    posed = [
        Frame(name, 1, RigidTransform.look_at(centre, (0, 0, 0)), split="test" if i == 1 else "train")
        for i, (name, centre) in enumerate(zip(names, CENTRES, strict=True))
    ]
    turned = RigidTransform.look_at(SENSED, (0, 0, 0)).rotation
    sensed = Frame("sensed.jpg", 1, prior=PosePrior(SENSED, np.array([1.0, 2.0, 3.0]), turned))
    camera = ColmapCamera.pinhole(64, 48, 60.0)
    return Scene(Path("images"), {1: camera}, (*posed, sensed, Frame("lost.jpg", 1)), points=points)


def cloud(count: int) -> Points:
    rng = np.random.default_rng(0)
    return Points(rng.uniform(-8, 8, (count, 3)), rng.integers(0, 256, (count, 3)).astype(np.uint8))


def trace(figure: go.Figure, name: str) -> go.Scatter3d:
    (found,) = (item for item in figure.data if item.name == name)
    return found


def places(drawn: go.Scatter3d, axes: str = "xyz") -> np.ndarray:
    return np.stack([np.asarray(drawn[axis], float) for axis in axes], axis=1)


@pytest.mark.parametrize("top_view", [False, True])
def test_cameras_stand_at_their_poses_and_sensors_where_there_is_none(top_view: bool) -> None:
    figure = scene_map(scene(), top_view=top_view)
    axes = "xy" if top_view else "xyz"
    count = len(axes)
    np.testing.assert_allclose(places(trace(figure, "cameras"), axes), CENTRES[[0, 2], :count])
    np.testing.assert_allclose(places(trace(figure, "test cameras"), axes), CENTRES[[1], :count])
    sensed = trace(figure, "sensor positions")
    np.testing.assert_allclose(places(sensed, axes), SENSED[None, :count])
    assert list(sensed.error_x.array) == [1.0]
    assert list(sensed.error_y.array) == [2.0]
    assert top_view or list(sensed.error_z.array) == [3.0]
    assert sensed.marker.symbol != trace(figure, "cameras").marker.symbol
    assert list(trace(figure, "test cameras").text) == ["b.jpg (test)"]
    assert figure.layout.title.text == "3 of 5 frames with a pose, 1 at their sensor position, 1 unknown"


def test_a_sigma_that_is_unknown_has_no_bar() -> None:
    bare = scene()
    frames = (*bare.frames[:3], Frame("sensed.jpg", 1, prior=PosePrior(SENSED)))
    sensed = trace(scene_map(bare.replace(frames=frames)), "sensor positions")
    assert sensed.error_x.array is None
    mixed = (*bare.frames, Frame("plain.jpg", 1, prior=PosePrior(-SENSED)))
    sensed = trace(scene_map(bare.replace(frames=mixed)), "sensor positions")
    assert list(sensed.error_x.array) == [1.0, 0.0]


def test_pyramids_and_arrows_point_where_cameras_look() -> None:
    pyramids = [item for item in scene_map(scene()).data if item.mode == "lines"]
    assert len(pyramids) == 3  # cameras, test cameras, sensor positions with an attitude
    ends = places(pyramids[1])
    ends = ends[np.isfinite(ends).all(axis=1)]
    # The second camera is at north 10 and looks to the middle: nothing of its pyramid is farther out.
    assert ends[:, 1].max() <= 10.0 + 1e-9

    figure = scene_map(scene(), top_view=True)
    arrows = next(item for item in figure.data if item.mode == "lines+markers")
    # East of the middle and looking west, west of it and looking east: degrees clockwise from north.
    np.testing.assert_allclose(np.asarray(arrows.marker.angle)[::3], [-90.0, 90.0])
    x = np.asarray(arrows.x, float)
    assert x[0] == 10.0
    assert x[1] < 10.0
    assert np.isnan(x[2])


def test_a_camera_that_looks_straight_down_points_to_the_top_of_its_picture() -> None:
    down = RigidTransform(np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.zeros(3))
    only = scene().replace(frames=(Frame("a.jpg", 1, down),))
    arrows = next(item for item in scene_map(only, top_view=True).data if item.mode == "lines+markers")
    # Down the picture is east, so its top is west.
    assert abs(arrows.marker.angle[0]) == pytest.approx(90.0)
    assert np.asarray(arrows.x, float)[1] < np.asarray(arrows.x, float)[0]


def test_both_views_have_equal_scale_and_say_their_axes() -> None:
    plain, geo = scene(), scene().replace(georeference=Georeference(48.0, 9.0, 600.0))
    assert scene_map(plain).layout.scene.aspectmode == "data"
    assert scene_map(plain).layout.scene.xaxis.title.text == "x"
    space = scene_map(geo).layout.scene
    assert [space[f"{axis}axis"].title.text for axis in "xyz"] == ["east [m]", "north [m]", "up [m]"]
    plane = scene_map(geo, top_view=True).layout
    assert (plane.xaxis.title.text, plane.yaxis.title.text) == ("east [m]", "north [m]")
    assert (plane.yaxis.scaleanchor, plane.yaxis.scaleratio) == ("x", 1)


def test_points_keep_their_colours_and_are_thinned(monkeypatch: pytest.MonkeyPatch) -> None:
    few = cloud(50)
    drawn = trace(scene_map(scene(points=few)), "points")
    np.testing.assert_allclose(places(drawn), few.xyz)
    assert drawn.marker.color[7] == "rgb({},{},{})".format(*few.rgb[7])
    assert not [item for item in scene_map(scene(points=few), points=False).data if item.name == "points"]
    assert MOST_POINTS == 20_000
    monkeypatch.setattr(scene_map_module, "MOST_POINTS", 20)
    assert len(trace(scene_map(scene(points=few)), "points").x) == 20
    assert len(trace(scene_map(scene(points=few), top_view=True), "points").x) == 20


def test_from_above_high_points_hide_low_ones() -> None:
    few = cloud(30)
    drawn = trace(scene_map(scene(points=few), top_view=True), "points")
    order = np.argsort(few.xyz[:, 2])
    np.testing.assert_allclose(places(drawn, "xy"), few.xyz[order, :2])
    assert drawn.marker.color[-1] == "rgb({},{},{})".format(*few.rgb[order[-1]])


def test_points_far_off_all_others_are_left_out() -> None:
    few = cloud(200)
    astray = Points(np.concatenate([few.xyz, [[1e6, 0.0, 0.0]]]), np.concatenate([few.rgb, few.rgb[:1]]))
    drawn = trace(scene_map(scene(points=astray)), "points")
    assert len(drawn.x) == 200
    assert np.max(drawn.x) < 9


def test_the_reference_is_drawn_in_grey_as_a_path() -> None:
    drawn = trace(scene_map(scene().without_poses(), reference=scene()), "true cameras")
    np.testing.assert_allclose(places(drawn), CENTRES)
    assert drawn.mode == "lines+markers"


@pytest.mark.parametrize("top_view", [False, True])
def test_names_are_shown_and_not_obeyed_and_nothing_is_nan(top_view: bool) -> None:
    figure = scene_map(scene(('<a href="x">&', "b.jpg", "c.jpg"), cloud(10)), top_view=top_view)
    assert trace(figure, "cameras").text[0] == '&lt;a href="x"&gt;&amp;'
    for item in figure.data:
        if item.name is not None:  # lines without a name have gaps between them
            assert np.isfinite(places(item, "xy" if top_view else "xyz")).all()
    json.loads(figure.to_json(), parse_constant=pytest.fail)


def test_a_scene_without_any_place_is_an_empty_map() -> None:
    figure = scene_map(scene().replace(frames=(Frame("lost.jpg", 1),)))
    assert len(figure.data) == 0
    assert figure.layout.title.text == "0 of 1 frames with a pose"


def test_the_viewer_stands_farther_from_flat_things() -> None:
    cube, flat = np.array([[0.0, 0, 0], [1, 1, 1]]), np.array([[0.0, 0, 0], [1, 1, 0.01]])
    far = [np.linalg.norm(list(space(box)["camera"]["eye"].values())) for box in (cube, flat)]
    # Plotly's unit is the geometric mean of the sides: 0.01^(1/3) of the flat box's longest.
    assert far[1] / far[0] == pytest.approx(np.sqrt(2.0001 / 3) / 0.01 ** (1 / 3))
    for box in (np.zeros((1, 3)), np.empty((0, 3))):
        assert np.isfinite(list(space(box)["camera"]["eye"].values())).all()
    assert [space(flat)[f"{axis}axis"]["nticks"] for axis in "xyz"] == [8, 8, 2]


@pytest.mark.parametrize("pitch", [30.0, 90.0])
def test_a_world_that_lies_askew_is_drawn_upright(pitch: float) -> None:
    tilt = RigidTransform.look_at((0, 0, 0), (1.0, 2.0, -0.5)).rotation
    height = 8 * np.tan(np.radians(min(pitch, 89.999)))
    centres = 8 * np.array([[np.cos(a), np.sin(a), height / 8] for a in np.arange(0, 6, 0.5)])
    frames = []
    for i, centre in enumerate(centres):
        upright = RigidTransform.look_at(centre, (0.0, 0.0, 0.0))
        rotation = upright.rotation @ tilt.T
        frames.append(Frame(f"{i}.jpg", 1, RigidTransform(rotation, upright.translation)))
    askew = scene().replace(frames=tuple(frames))
    up = scene_map(askew).layout.scene.camera.up
    # The half-turn that is missing from the circle tilts the mean a little.
    assert np.array([up.x, up.y, up.z]) @ tilt[:, 2] > 0.99
    in_enu = scene_map(askew.replace(georeference=Georeference(48.0, 9.0, 600.0))).layout.scene.camera.up
    assert (in_enu.x, in_enu.y, in_enu.z) == (0.0, 0.0, 1.0)


def photo(width: int = 40, height: int = 30, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)


def decoded(drawn: go.Image) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(drawn.source.split(",")[1]))))


def test_matches_join_pixels_of_both_photos() -> None:
    first, second = np.array([[0.5, 0.5], [39.5, 29.5]]), np.array([[10.5, 20.5], [30.5, 5.5]])
    figure = matches_figure(photo(), photo(50, 20), first, second, inlier=[True, False])
    left, right = (item for item in figure.data if isinstance(item, go.Image))
    # The top-left pixel covers 0..1: its centre is at 0.5.
    assert (left.x0, left.y0, left.dx, left.dy) == (0.5, 0.5, 1.0, 1.0)
    shift = right.x0 - 0.5
    assert shift >= 40
    good, bad = trace(figure, "verified"), trace(figure, "not verified")
    np.testing.assert_allclose(places(good, "xy")[:2], [[0.5, 0.5], [10.5 + shift, 20.5]])
    np.testing.assert_allclose(places(bad, "xy")[:2], [[39.5, 29.5], [30.5 + shift, 5.5]])
    assert good.line.color != bad.line.color
    assert figure.layout.title.text == "2 matches, 1 verified"
    assert figure.layout.yaxis.range == (30, 0)
    assert figure.layout.yaxis.scaleanchor == "x"
    np.testing.assert_allclose(decoded(left).mean(), photo().mean(), atol=3)  # JPEG


def test_many_matches_are_thinned_and_the_title_says_so() -> None:
    pixels = np.random.default_rng(0).uniform(0, 30, (1000, 2))
    figure = matches_figure(photo(), photo(), pixels, pixels, most=60)
    assert len(trace(figure, "matches").x) == 3 * 60  # start, end, gap
    assert figure.layout.title.text == "1000 matches, 60 drawn"


def test_photos_without_matches_are_drawn() -> None:
    figure = matches_figure(photo(), photo(), np.empty((0, 2)), np.empty((0, 2)), inlier=[])
    assert len(figure.data) == 2
    assert figure.layout.title.text == "0 matches, 0 verified"


def test_pixels_that_do_not_correspond_are_refused() -> None:
    with pytest.raises(
        DataError, match=r"Matched pixels do not correspond; expected \(N, 2\).*found \(2, 2\), \(1"
    ):
        matches_figure(photo(), photo(), np.zeros((2, 2)), np.zeros((1, 2)))
    with pytest.raises(DataError, match=r"and \(1,\)"):
        matches_figure(photo(), photo(), np.zeros((2, 2)), np.zeros((2, 2)), inlier=[True])


def test_the_match_graph_is_symmetric_with_gaps_where_nothing_was_tried() -> None:
    figure = match_graph_figure(["<a>", "b", "c"], [[0, 1], [1, 2]], [40, 0])
    assert [list(row) for row in figure.data[0].z] == [[None, 40, None], [40, None, 0], [None, 0, None]]
    assert figure.data[0].customdata[0][1] == "&lt;a&gt; – b"
    assert figure.layout.title.text == "1 of 2 pairs verified"
    assert figure.layout.yaxis.scaleanchor == "x"
    assert len(match_graph_figure([], np.empty((0, 2)), []).data) == 1


def test_a_match_graph_that_contradicts_itself_is_refused() -> None:
    with pytest.raises(DataError, match="Pairs and counts do not correspond; expected 1; found 2"):
        match_graph_figure(["a", "b"], [[0, 1]], [1, 2])
    with pytest.raises(DataError, match="frames that there are not; expected indices below 2"):
        match_graph_figure(["a", "b"], [[0, 2]], [1])


def test_photo_render_and_error_share_one_zoom() -> None:
    taken = photo()
    drawn = taken.astype(np.float32) / 255
    drawn[3, 5] = np.clip(drawn[3, 5] + 0.2, 0, 1)
    figure = photo_against_render(taken, drawn, psnr=31.234, name="<b>")
    assert figure.layout.title.text == "&lt;b&gt; · PSNR 31.23 dB"
    left, right, error = figure.data
    assert (left.x0, right.x0, error.x0) == (0.5, 0.5, 0.5)
    values = np.asarray(error.z)
    expected = np.abs(eight_bit(drawn)[3, 5].astype(float) - taken[3, 5]).mean()
    assert values[3, 5] == pytest.approx(expected, abs=0.5)  # rounded to a level
    assert np.count_nonzero(values) == 1
    layout = figure.layout
    assert (layout.xaxis2.matches, layout.xaxis3.matches) == ("x", "x")
    assert (layout.yaxis2.matches, layout.yaxis3.matches) == ("y", "y")
    assert layout.yaxis.scaleanchor == "x"
    assert len(photo_against_render(taken, drawn, error=False).data) == 2


def test_large_pictures_are_drawn_smaller_in_their_own_pixels() -> None:
    large = np.zeros((10, 2 * LONGEST_SIDE, 3), np.uint8)
    left, _, error = photo_against_render(large, large).data
    assert decoded(left).shape == (5, LONGEST_SIDE, 3)
    assert (left.dx, left.x0) == (2.0, 1.0)
    assert np.asarray(error.z).shape == (5, LONGEST_SIDE)
    assert error.dx == 2.0


def test_what_is_no_picture_is_refused() -> None:
    with pytest.raises(DataError, match="different sizes"):
        photo_against_render(photo(), photo(20))
    with pytest.raises(DataError, match="wrong shape"):
        eight_bit(np.zeros((4, 4)))
    with pytest.raises(DataError, match="wrong type.*int64"):
        eight_bit(np.zeros((4, 4, 3), np.int64))
    with pytest.raises(DataError, match="not finite"):
        eight_bit(np.full((4, 4, 3), np.nan))
