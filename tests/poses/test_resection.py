"""A map of some frames, and the others placed in it by its points."""

from __future__ import annotations

import dataclasses
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from flight_matches import flight, nadir_block
from synthetic_matches import forget_pairs, synthetic_matches

from toolkit.errors import DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.database import copy_database
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.poses.resection import place_by_tracks
from toolkit.poses.sfm import SfmSettings, incremental_sfm
from toolkit.poses.sfm_result import SfmResult
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene, write_scene

KNOWN = SfmSettings(refine_focal=False, refine_distortion=False, refine_principal_point=False, threads=1)


def halves(scene: Scene) -> Scene:
    """Every second frame is a query."""
    frames = [dataclasses.replace(f, split="test" if i % 2 else "train") for i, f in enumerate(scene.frames)]
    return scene.replace(frames=tuple(frames))


def mapped(scene: Scene, database_path: Path, settings: SfmSettings = KNOWN) -> SfmResult:
    names = [frame.name for frame in scene.frames if frame.split == "train"]
    return incremental_sfm(scene, database_path, settings, work_dir=database_path.parent / "work", only=names)


def place(scene: Scene, database_path: Path, least: int = 20, **changes: object):
    copy = database_path.with_name("copy.db")
    copy_database(database_path, copy)
    queries = [frame.name for frame in scene.frames if frame.split == "test"]
    return place_by_tracks(scene, copy, **{"only": queries, "max_error": 4.0, "least": least, "seed": 0, **changes})


def test_only_the_frames_that_are_asked_for_are_placed(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=8)
    result = mapped(halves(truth), database_path)
    assert [frame.split for frame in result.scene.registered] == ["train"] * 4
    assert result.not_registered == ()
    assert result.warnings == ()
    assert result.to_dict()["images"] == 4
    assert result.scene.points is not None
    assert result.scene.points.tracks is not None
    # Not one observation is a query's.
    assert set(result.scene.points.tracks.frame.tolist()) == {0, 2, 4, 6}


def test_queries_have_no_part_in_the_map(tmp_path: Path) -> None:
    """Points and camera are to the bit the same with the queries' matches and without."""
    maps = []
    for name in ("with", "without"):
        (tmp_path / name).mkdir()
        scene, _, database_path = flight(tmp_path / name, nadir_block(2, 6))
        if name == "without":
            forget_pairs(database_path, set(combinations(range(0, len(scene), 2), 2)))
        settings = KNOWN.replace({"use_positions": True, "refine_focal": True})
        maps.append(mapped(halves(scene), database_path, settings).scene)
    one, two = maps
    assert one.cameras == two.cameras
    assert one.points is not None
    assert two.points is not None
    np.testing.assert_array_equal(one.points.xyz, two.points.xyz)


def test_queries_are_placed_in_the_map_and_the_map_stays(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=8)
    scene = mapped(halves(truth), database_path).scene
    write_scene(scene, tmp_path / "map")
    # As a later stage finds it: pixels of tracks come back to the bit.
    scene = read_scene(tmp_path / "map")
    found = place(scene, database_path)
    assert found.placed == tuple(frame.name for frame in truth.frames[1::2])
    assert found.reasons == {}
    assert found.scene.points is scene.points
    assert found.scene.cameras is scene.cameras
    for before, after in zip(scene.frames, found.scene.frames, strict=True):
        assert before is after or before.split == "test"
    errors = trajectory_errors(found.scene, truth, "sim3")
    # Keypoints are half a pixel off, in pictures of 1,000.
    assert len(errors.names) == 8
    assert errors.rotation_deg.max() < 0.15


def test_a_query_with_few_points_is_told_and_stays_without_pose(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=6)
    scene = mapped(halves(truth), database_path).scene
    found = place(scene, database_path, least=5000)
    assert found.placed == ()
    assert all(frame.cam_from_world is None for frame in found.scene.frames[1::2])
    reasons = list(found.reasons.values())
    assert len(reasons) == 3
    assert all(reason.endswith("matched points agree, 5000 needed") for reason in reasons)


def test_a_map_photo_without_pose_is_not_placed_with_the_queries(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=8)
    scene = mapped(halves(truth), database_path).scene
    lost = dataclasses.replace(scene.frames[2], cam_from_world=None)
    scene = scene.replace(frames=(*scene.frames[:2], lost, *scene.frames[3:]))
    assert lost.name not in place(scene, database_path).placed


def test_a_query_with_a_camera_of_its_own_keeps_it(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=8)
    scene = mapped(halves(truth), database_path).scene
    (number,) = scene.cameras
    camera = scene.cameras[number]
    assert isinstance(camera, ColmapCamera)
    wrong = ColmapCamera(camera.model, camera.width, camera.height, (3 * camera.params[0], *camera.params[1:]))
    frames = tuple(dataclasses.replace(f, camera_id=7) if f.split == "test" else f for f in scene.frames)
    found = place(scene.replace(frames=frames, cameras={number: camera, 7: wrong}), database_path)
    right = place(scene, database_path)
    # The wrong focal length is believed: where a pose is found at all it is another one.
    for name in found.placed:
        one, other = found.scene.frame(name).cam_from_world, right.scene.frame(name).cam_from_world
        assert one is not None
        assert other is not None
        assert np.linalg.norm(one.centre - other.centre) > 0.1
    assert len(found.placed) <= len(right.placed)


def test_a_scene_without_tracks_cannot_place_anything(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=4)
    with pytest.raises(StageError, match="cannot be placed by points; .*found no points. Find poses"):
        place(halves(truth).without_poses(), database_path)
    assert truth.points is not None
    bare = halves(truth).replace(points=dataclasses.replace(truth.points, tracks=None))
    with pytest.raises(StageError, match="found points without tracks"):
        place(bare, database_path)


def test_wrong_choices_of_frames_are_told(tmp_path: Path) -> None:
    truth, database_path = synthetic_matches(tmp_path, frames=4)
    work = tmp_path / "work"
    with pytest.raises(DataError, match=r"No frame 'x\.jpg' in the scene"):
        incremental_sfm(truth, database_path, KNOWN, work_dir=work, only=["x.jpg"])
    one = [truth.frames[0].name]
    with pytest.raises(StageError, match="needs pictures; expected at least 2 to place; found 1"):
        incremental_sfm(truth, database_path, KNOWN, work_dir=work, only=one)
    two = [frame.name for frame in truth.frames[:2]]
    with pytest.raises(StageError, match="too few positions to use as priors; .* found 0 of 2"):
        incremental_sfm(truth, database_path, SfmSettings(use_positions=True), work_dir=work, only=two)
