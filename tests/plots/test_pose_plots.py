"""Errors of poses by frame, and clouds from the side."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.plots.elevation import elevation_map
from toolkit.plots.pose_errors import pose_errors_figure
from toolkit.scene import Frame, Points, Scene


def scene(lift: float = 0.0) -> Scene:
    places = [(10 * math.cos(i), 10 * math.sin(i), 5.0 + lift * (i == 2)) for i in range(6)]
    frames = tuple(Frame(f"{i}.jpg", 1, RigidTransform.look_at(place, (0, 0, 0))) for i, place in enumerate(places))
    return Scene(Path("images"), {1: ColmapCamera.pinhole(64, 48, 60.0)}, frames)


def test_each_frame_has_its_errors() -> None:
    drawn = pose_errors_figure({"lifted": scene(2.0)}, scene(), alignment="none")
    position, rotation = drawn.data
    np.testing.assert_allclose(position.y, [0, 0, 2, 0, 0, 0], atol=1e-9)
    assert rotation.y[2] > 1
    assert "lifted: POS 0.333 m" in position.name
    assert "6 of 6 frames" in position.name
    assert drawn.layout.yaxis.type == drawn.layout.yaxis2.type == "log"


def test_what_cannot_be_compared_is_told() -> None:
    none = scene().without_poses()
    drawn = pose_errors_figure({"<lost>": none, "found": scene(1.0)}, scene())
    assert "&lt;lost&gt;: Too few frames" in drawn.layout.title.text
    assert len(drawn.data) == 2
    empty = pose_errors_figure({"found": scene()}, None)
    assert not empty.data
    assert "no reference poses" in empty.layout.title.text


def test_ways_keep_their_colours_where_one_is_missing() -> None:
    whole = pose_errors_figure({"a": scene(1.0), "b": scene(1.0)}, scene())
    part = pose_errors_figure({"a": scene().without_poses(), "b": scene(1.0)}, scene())
    assert part.data[0].marker.color == whole.data[2].marker.color


def test_clouds_stand_one_below_the_other_seen_from_the_south() -> None:
    xyz = np.array([[-30.0, 5.0, 0.0], [30.0, -5.0, 12.0]])
    cloud = Points(xyz, np.array([[255, 0, 0], [0, 255, 0]], dtype=np.uint8))
    drawn = elevation_map(
        {"low": cloud, "<none>": None, "high": dataclasses.replace(cloud, xyz=xyz + np.array([0.0, 0.0, 3.0]))}
    )
    low, high = drawn.data
    np.testing.assert_allclose(low.x, [-30, 30])
    np.testing.assert_allclose(low.y, [0, 12])
    np.testing.assert_allclose(high.y, [3, 15])
    assert list(low.marker.color) == ["rgb(255,0,0)", "rgb(0,255,0)"]
    assert drawn.layout.yaxis.range == drawn.layout.yaxis3.range
    assert [note.text for note in drawn.layout.annotations] == [
        "low: 2 points",
        "&lt;none&gt;: 0 points",
        "high: 2 points",
    ]


def test_no_cloud_at_all_is_an_empty_figure() -> None:
    assert not elevation_map({}).data
    assert not elevation_map({"none": None}).data
