"""Source views by angle and overlap, depth ranges from points, tracks where there are none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from toolkit.depth.stereo_settings import ViewChoiceSettings
from toolkit.depth.view_choice import choose_views, seen_points, triangulation_angles, with_tracks
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Frame, Points, Scene, Tracks

CAMERA = ColmapCamera.pinhole(100, 80, 100.0)


def row_of_cameras(angles: list[float], tracks: bool = True) -> Scene:
    """Cameras on a circle of radius 10 around a flat patch of points, at angles in degrees."""
    around = np.radians(angles)
    frames = tuple(
        Frame(
            f"{number}.png", 1, RigidTransform.look_at([10 * np.sin(a), 0, -10 * np.cos(a)], [0, 0, 0], (0, -1, 0))
        )
        for number, a in enumerate(around)
    )
    xyz = np.random.default_rng(0).uniform(-1, 1, (60, 3)) * (2, 2, 0.2)
    points = Points(xyz, np.zeros((60, 3), np.uint8))
    scene = Scene(Path("pictures"), {1: CAMERA}, frames, points)
    return with_tracks(scene) if tracks else scene


def test_views_near_the_best_angle_come_first() -> None:
    scene = row_of_cameras([0, 0.5, 4, 10, 30, 80])
    first = choose_views(scene, ViewChoiceSettings(), 25.0)[0]
    # Half a degree is too little and 80 degrees too much for any use.
    assert first.sources == ("3.png", "2.png", "4.png") or first.sources == ("3.png", "4.png", "2.png")
    assert choose_views(scene, ViewChoiceSettings(views=1, best_angle=30.0), 25.0)[0].sources == ("4.png",)


def test_overlap_counts_as_well_as_angle() -> None:
    scene = row_of_cameras([0, 10, -10])
    assert scene.points is not None
    tracks = scene.points.tracks
    assert tracks is not None
    kept = (tracks.frame != 1) | (tracks.point < 20)  # the second camera sees a third of the points
    fewer = Tracks(tracks.point[kept], tracks.frame[kept], tracks.pixel[kept])
    scene = scene.replace(points=Points(scene.points.xyz, scene.points.rgb, None, fewer))
    assert choose_views(scene, ViewChoiceSettings(), 25.0)[0].sources == ("2.png", "1.png")
    assert choose_views(scene, ViewChoiceSettings(min_shared=21), 25.0)[0].sources == ("2.png",)


def test_the_range_holds_the_points_with_its_margin() -> None:
    scene = row_of_cameras([0, 10])
    near, far = choose_views(scene, ViewChoiceSettings(), 0.0)[0].depth_range or (0, 0)
    assert 9.8 <= near < far <= 10.2
    wide = choose_views(scene, ViewChoiceSettings(), 50.0)[0].depth_range
    assert wide == pytest.approx((near / 1.5, far * 1.5))


def test_what_has_no_view_says_why() -> None:
    few = row_of_cameras([0, 10])
    assert few.points is not None
    nine = few.replace(points=Points(few.points.xyz[:9], few.points.rgb[:9]))
    choice = choose_views(nine, ViewChoiceSettings(), 25.0)[0]
    assert not choice
    assert choice.reason == "it sees only 9 of the scene's points, 10 are needed"
    wide = choose_views(row_of_cameras([0, 80]), ViewChoiceSettings(), 25.0)[0]
    assert not wide
    assert "median angle of 1 to 60 degrees" in wide.reason


def test_without_tracks_points_behind_others_are_not_seen() -> None:
    scene = row_of_cameras([0, 10], tracks=False)
    assert scene.points is not None
    front = np.random.default_rng(1).uniform(-2, 2, (3000, 3)) * (1, 1, 0.1)
    behind = scene.points.xyz * 0.8 + (0, 0, 8)
    both = np.concatenate([front, behind])
    seen = seen_points(scene.replace(points=Points(both, np.zeros((len(both), 3), np.uint8))))["0.png"]
    assert np.array_equal(seen, np.arange(3000))


def test_tracks_are_projections_and_own_ones_stay() -> None:
    scene = row_of_cameras([0, 10], tracks=False)
    tracked = with_tracks(scene)
    assert tracked.points is not None
    tracks = tracked.points.tracks
    assert tracks is not None
    pose = scene.frames[1].cam_from_world
    assert pose is not None
    mine = tracks.frame == 1
    assert np.allclose(tracks.pixel[mine], CAMERA.project(pose.apply(tracked.points.xyz[tracks.point[mine]])))
    assert with_tracks(tracked) is tracked
    assert with_tracks(scene.replace(points=None)).points is None


def test_angles_are_those_between_the_rays() -> None:
    scene = row_of_cameras([0, 25])
    angles = triangulation_angles(scene.frames[0], scene.frames[1], np.zeros((1, 3)))
    assert angles == pytest.approx([25.0])
