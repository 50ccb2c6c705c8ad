"""Depth from files in COLMAP's fusion: planted scales, modes, pictures that are left out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toolkit.depth.array_depth import ArrayDepth
from toolkit.depth.dense_folder import DenseFolder
from toolkit.depth.external_depth import ExternalResult, external_depth
from toolkit.depth.fuse import fuse_depth
from toolkit.depth.normals import normals_from_depth
from toolkit.depth.stereo_settings import ExternalSettings, FusionSettings
from toolkit.errors import DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.scene import Points

ALONE = ExternalSettings(use="replace")


@pytest.fixture
def arrays(slanted: Any, tmp_path: Path) -> Path:
    """Return a folder of depth maps, each with a scale and a shift of its own and some noise at the points."""
    folder = tmp_path / "arrays"
    folder.mkdir()
    for number, (name, depth) in enumerate(slanted.depth.items()):
        np.save(folder / f"{name}.npy", ((depth - 0.1 * number) / (2 + number)).astype(np.float32))
    return folder


def run(scene: Any, arrays: Path, folder: Path, settings: ExternalSettings = ALONE, **more: Any) -> ExternalResult:
    provider = ArrayDepth(arrays, "affine-depth")
    return external_depth(scene, provider, settings, folder, longest=more.pop("longest", 1000), **more)


def test_planted_scales_and_shifts_are_found_and_fused(slanted: Any, arrays: Path, tmp_path: Path) -> None:
    found = run(slanted.scene, arrays, tmp_path / "dense")
    # Depth is looked up at the pixel that a point falls into, up to half a pixel beside it.
    for number, frame in enumerate(found.frames):
        assert frame.reason == ""
        assert frame.fit["scale"] == pytest.approx(2 + number, rel=3e-3)
        assert frame.fit["shift"] == pytest.approx(0.1 * number, abs=0.01)
        assert frame.fit["used"] > 100
    view = found.views[1]
    known = view.depth > 0
    assert np.array_equal(np.argwhere(known).min(axis=0), [4, 4])  # the border
    assert np.abs(view.depth / slanted.depth["1.png"] - 1)[known].max() < 2e-3
    assert view.confidence is not None
    assert 0 < view.confidence[known].max() <= 0.5
    cloud = fuse_depth(found.folder, FusionSettings())
    assert np.abs(cloud.xyz @ slanted.normal).max() < 0.03
    assert cloud.normals is not None
    assert (cloud.normals @ slanted.normal).min() > 0.99


def test_outliers_among_the_points_do_no_harm(slanted: Any, arrays: Path, tmp_path: Path) -> None:
    points = slanted.scene.points
    xyz = points.xyz.copy()
    xyz[:50] += np.random.default_rng(0).uniform(-1, 1, (50, 3))
    found = run(slanted.scene.replace(points=Points(xyz, points.rgb)), arrays, tmp_path / "dense")
    assert found.frames[2].fit["scale"] == pytest.approx(4, rel=0.02)


def test_a_picture_without_points_is_left_out(slanted: Any, arrays: Path, tmp_path: Path) -> None:
    scene = slanted.scene
    points = scene.points
    tracked = points_seen_by(scene, {0, 1, 2})
    found = run(tracked, arrays, tmp_path / "dense")
    assert [frame.reason != "" for frame in found.frames] == [False, False, False, True, True]
    assert "only 0 points of the scene" in found.frames[3].reason
    assert len(found.views) == 3
    assert found.to_dict()["used"] == 3
    with pytest.raises(StageError, match="No picture has a depth map.*no points"):
        run(scene.replace(points=None), arrays, tmp_path / "none")
    with pytest.raises(StageError, match="No frame has a pose"):
        run(scene.without_poses(), arrays, tmp_path / "none")
    assert points is not None


def points_seen_by(scene: Any, numbers: set[int]) -> Any:
    from toolkit.depth.view_choice import with_tracks
    from toolkit.scene import Tracks

    tracked = with_tracks(scene)
    tracks = tracked.points.tracks
    kept = np.isin(tracks.frame, list(numbers))
    fewer = Tracks(tracks.point[kept], tracks.frame[kept], tracks.pixel[kept])
    return scene.replace(points=Points(scene.points.xyz, scene.points.rgb, None, fewer))


def test_holes_are_filled_and_stereo_stays(slanted: Any, arrays: Path, exact_folder: Path, tmp_path: Path) -> None:
    stereo = DenseFolder(exact_folder)
    depth, normals = stereo.depth("1.png").copy(), stereo.normals("1.png")
    depth[20:40, 30:60] = 0
    depth[:10] *= 1.02  # a mistake of stereo's, which must stay
    stereo.write("1.png", depth, normals, None)
    fill = run(slanted.scene, arrays, tmp_path / "fill", ExternalSettings(use="fill"), stereo=exact_folder)
    made = fill.views[1].depth
    assert np.array_equal(made[depth > 0], depth[depth > 0])
    assert np.allclose(made[20:40, 30:60], slanted.depth["1.png"][20:40, 30:60], rtol=2e-3)
    assert fill.frames[1].pixels["external"] == 600
    assert fill.frames[1].pixels["stereo"] == 72 * 96 - 600

    both = run(slanted.scene, arrays, tmp_path / "with", ExternalSettings(use="with"), stereo=exact_folder)
    mixed = both.views[1].depth[5:10, 10:-10] / slanted.depth["1.png"][5:10, 10:-10]
    assert 1.002 < mixed.min() < mixed.max() < 1.018  # a mean of both
    narrow = ExternalSettings(use="with", agree=1.0)
    apart = run(slanted.scene, arrays, tmp_path / "narrow", narrow, stereo=exact_folder)
    assert np.allclose(apart.views[1].depth[5:9, 10:-10], depth[5:9, 10:-10])
    assert apart.frames[1].pixels["both"] < both.frames[1].pixels["both"]
    with pytest.raises(StageError, match="with stereo's, but there is none"):
        run(slanted.scene, arrays, tmp_path / "fill2", ExternalSettings(use="fill"))


def test_maps_may_be_smaller_than_pictures(slanted: Any, arrays: Path, tmp_path: Path) -> None:
    view = run(slanted.scene, arrays, tmp_path / "dense", longest=48).views[0]
    assert view.depth.shape == (36, 48)
    middle = slanted.depth["0.png"].reshape(36, 2, 48, 2).mean(axis=(1, 3))
    known = view.depth > 0
    assert np.abs(view.depth / middle - 1)[known].max() < 0.01  # half a pixel of the large picture


def test_steps_and_low_confidence_are_left_out(slanted: Any, arrays: Path, tmp_path: Path) -> None:
    depth = slanted.depth["0.png"].copy()
    depth[:, 60:] *= 1.5
    sure = np.ones(depth.shape)
    sure[50:60, 20:30] = 0.1
    (arrays / "0.png.npy").unlink()
    np.savez(arrays / "0.png.npz", depth=depth, confidence=sure)
    settings = ALONE.replace({"depth.min_confidence": 0.3})
    found = run(slanted.scene, arrays, tmp_path / "dense", settings)
    made = found.views[0].depth
    assert not made[:, 59:61].any()
    assert made[10:40, 20:50].all()
    assert not made[50:60, 20:30].any()
    assert found.frames[0].pixels["confidence"] == 100


def test_what_is_whole_is_not_made_again(slanted: Any, arrays: Path, tmp_path: Path) -> None:
    first = run(slanted.scene, arrays, tmp_path / "dense")
    note = tmp_path / "dense" / "stereo" / "external" / "0.png.json"
    told = json.loads(note.read_text(encoding="utf-8"))
    note.write_text(json.dumps({**told, "reason": "as it was"}), encoding="utf-8")
    assert run(slanted.scene, arrays, tmp_path / "dense").frames[0].reason == "as it was"
    other = run(slanted.scene, arrays, tmp_path / "dense", ALONE.replace({"border": 9}))
    assert other.frames[0].reason == first.frames[0].reason == ""


def test_maps_of_the_wrong_size_are_told(slanted: Any, arrays: Path, tmp_path: Path) -> None:
    np.save(arrays / "0.png.npy", np.ones((10, 10)))
    with pytest.raises(DataError, match="does not fit the picture"):
        run(slanted.scene, arrays, tmp_path / "dense")


def test_normals_are_those_of_the_plane_on_both_sides_of_a_step(slanted: Any) -> None:
    camera = slanted.scene.cameras[1]
    assert isinstance(camera, ColmapCamera)
    pose = slanted.scene.frames[0].cam_from_world
    depth = slanted.depth["0.png"].copy()
    normals = normals_from_depth(depth, camera)
    assert np.allclose(normals, pose.rotation @ slanted.normal, atol=1e-4)
    depth[:, 50:] *= 1.5
    depth[10, 10] = 0
    stepped = normals_from_depth(depth, camera)
    assert np.allclose(stepped[30, 40:60], pose.rotation @ slanted.normal, atol=1e-3)
    assert not stepped[10, 10].any()
    alone = np.zeros((5, 5))
    alone[2, 2] = 1
    assert not normals_from_depth(alone, ColmapCamera.pinhole(5, 5, 4.0)).any()
