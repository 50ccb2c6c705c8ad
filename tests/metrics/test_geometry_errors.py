"""Surfaces against the truth: every distance here is known beforehand."""

from __future__ import annotations

import json

import numpy as np
import pytest
from shapes import CAMERA, ball

from toolkit.errors import DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.ray_casting import MeshCaster
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.surface import Cloud, Mesh
from toolkit.geometry.triangles import face_areas, sample_surface, vertex_normals
from toolkit.metrics.geometry import compare_surfaces


def test_spheres_of_radius_one_and_a_hundredth_more_are_a_hundredth_apart() -> None:
    errors = compare_surfaces(ball(1.01), ball(), thresholds=(0.005, 0.02), samples=20_000)
    # Facets of 64 to a quarter turn sag by 1 - cos(pi / 4 / 64) = 8e-5 at most, in both directions.
    assert errors.accuracy.mean() == pytest.approx(0.01, abs=1e-4)
    assert errors.completeness.mean() == pytest.approx(0.01, abs=1e-4)
    assert errors.accuracy.max() < 0.0102
    assert errors.normal_angle_deg is not None
    # Facets are up to 1.9 degrees wide; nearest facets differ by one at most.
    assert errors.normal_angle_deg.mean() < 1.0
    assert (errors.f_score(0.005), errors.f_score(0.02)) == (0.0, 1.0)
    told = errors.to_dict()
    assert json.loads(json.dumps(told, allow_nan=False)) == told
    assert [row["threshold"] for row in told["thresholds"]] == [0.005, 0.02]
    assert told["accuracy"]["rms"] == pytest.approx(0.01, abs=1e-4)
    assert told["accuracy"]["median"] == pytest.approx(0.01, abs=1e-4)
    assert told["scope"] == "all"


def test_planted_outliers_lower_precision_by_their_share_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(30.0), np.arange(30.0), [0.0]), axis=-1).reshape(-1, 3)
    truth = Cloud(grid)
    far = np.column_stack([rng.uniform(0, 29, (100, 2)), np.full(100, 0.9)])
    errors = compare_surfaces(Cloud(np.concatenate([grid, far])), truth, thresholds=(0.5, 1.0))
    assert errors.precision(0.5) == 900 / 1000
    assert errors.recall(0.5) == 1.0
    assert errors.f_score(0.5) == pytest.approx(2 * 0.9 / 1.9)
    assert errors.scope == "the box of the true cloud"
    # Beyond the box grown by the largest threshold nobody knows what there is: it does not count.
    away = compare_surfaces(Cloud(np.concatenate([grid, far + np.array([0, 0, 5])])), truth, thresholds=(0.5, 1.0))
    assert away.precision(0.5) == 1.0
    assert away.left_out == (0.1, 0.0)


def test_a_missing_half_lowers_recall_to_a_half_and_leaves_precision() -> None:
    whole = ball(finer=6)
    upper = Mesh(whole.vertices, whole.faces[whole.vertices[whole.faces][:, :, 2].mean(axis=1) > 0])
    errors = compare_surfaces(upper, whole, thresholds=(0.01,), samples=50_000)
    assert errors.precision(0.01) == 1.0
    # The rim's band of a hundredth is 0.5 % of the sphere; stratified samples add 1 / sqrt(50,000) at most.
    assert errors.recall(0.01) == pytest.approx(0.505, abs=0.005)


def test_only_what_the_cameras_see_counts() -> None:
    sphere = ball()
    camera = RigidTransform.look_at((0.0, 0.0, 4.0), (0.0, 0.0, 0.0))
    # Behind the front, at the height of -0.5, stands a disk that the camera cannot know of.
    hidden = Mesh(
        np.array([[-0.3, -0.3, -0.5], [0.3, -0.3, -0.5], [0.0, 0.4, -0.5]]), np.array([[0, 1, 2]], np.int32)
    )
    found = Mesh(
        np.concatenate([sphere.vertices, hidden.vertices]),
        np.concatenate([sphere.faces, hidden.faces + len(sphere.vertices)]).astype(np.int32),
    )
    errors = compare_surfaces(found, sphere, seen_from=[(CAMERA, camera)], samples=20_000)
    # The horizon from 4 radii is at 1/4. Rays graze there: the slack of 0.004 reaches some way beyond it.
    assert errors.truth[:, 2].min() > 0.2
    assert errors.left_out[1] == pytest.approx(1 - 0.375, abs=0.01)  # a cap of height 3/4 is 3/8 of the sphere
    assert errors.accuracy.max() < 1e-5
    assert "casting rays" in errors.scope
    # Nothing counts that is farther than the pole and a bit.
    near = compare_surfaces(found, sphere, seen_from=[(CAMERA, camera)], far=3.1, samples=20_000)
    assert near.truth[:, 2].min() > 0.85
    assert near.found[:, 2].min() > 0.85
    # Samples are added until as many count as were asked for.
    assert len(errors.truth) == pytest.approx(20_000, rel=0.05)
    # Before the sphere, in view, it counts.
    before = Mesh(
        found.vertices + np.where(np.arange(len(found.vertices))[:, None] >= len(sphere.vertices), [0, 0, 2.0], 0),
        found.faces,
    )
    assert compare_surfaces(before, sphere, seen_from=[(CAMERA, camera)], samples=20_000).accuracy.max() > 0.4


def test_normals_count_whichever_way_they_point() -> None:
    flipped = Mesh(ball().vertices, ball().faces[:, ::-1].copy())
    errors = compare_surfaces(flipped, ball(), samples=5_000)
    assert errors.normal_angle_deg is not None
    assert errors.normal_angle_deg.max() < 2.0  # the neighbouring facet's
    bare = compare_surfaces(Cloud(ball().vertices), Cloud(ball().vertices))
    assert bare.normal_angle_deg is None
    assert bare.to_dict()["normal_angle_deg"] is None


def test_the_same_seed_gives_the_same_figures() -> None:
    first, again, other = (compare_surfaces(ball(1.01), ball(), samples=2_000, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.accuracy, again.accuracy)
    assert (first.accuracy != other.accuracy).any()


def test_samples_lie_evenly_by_area() -> None:
    corners = np.array([[0, 0, 0], [3, 0, 0], [0, 1, 0], [3, 1, 0]], float)
    split = Mesh(
        np.concatenate([corners, [[0.1, 0, 0], [0.1, 1, 0]]]),
        np.array([[0, 4, 5], [0, 5, 2], [4, 1, 3], [4, 3, 5]], np.int32),
    )
    assert face_areas(split).sum() == pytest.approx(3.0)
    cloud = sample_surface(split, 30_000, seed=0)
    counts, _ = np.histogram(cloud.xyz[:, 0], bins=30, range=(0, 3))
    # 1,000 a bin; four standard deviations of a Poisson count, which stratified ones stay below.
    assert np.abs(counts - 1000).max() < 4 * 1000**0.5
    assert cloud.normals is not None
    np.testing.assert_allclose(cloud.normals, np.tile([0, 0, 1.0], (30_000, 1)), atol=1e-12)


def test_normals_of_vertices_point_out_and_lone_vertices_have_one_too() -> None:
    sphere = ball()
    assert sphere.normals is not None
    # A vertex's normal is within a facet's width, 1.4 degrees, of the radius.
    assert np.degrees(np.arccos(np.einsum("ni,ni->n", vertex_normals(sphere), sphere.normals).min())) < 1.0
    lone = Mesh(np.zeros((4, 3)), np.array([[0, 1, 2]], np.int32))
    np.testing.assert_array_equal(vertex_normals(lone), np.tile([0, 0, 1.0], (4, 1)))


def test_depth_by_casting_is_that_of_the_sphere() -> None:
    pose = RigidTransform.look_at((0.0, -3.0, 0.0), (0.0, 0.0, 0.0))
    for camera in (CAMERA, ColmapCamera("OPENCV_FISHEYE", 160, 120, (150, 150, 80, 60, -0.05, 0.01, 0, 0))):
        depth = MeshCaster(ball(finer=6)).depth(camera, pose)
        row, column = np.mgrid[:120, :160]
        rays = camera.ray(np.stack([column.ravel() + 0.5, row.ravel() + 0.5], axis=1))[1]
        along = 3 * rays[:, 2]
        inside = along**2 - 8
        expected = np.where(inside > 0, (along - np.sqrt(np.maximum(inside, 0))) * rays[:, 2], 0).reshape(120, 160)
        sure = inside.reshape(120, 160) > 0.05  # facets blur the rim
        np.testing.assert_allclose(depth[sure], expected[sure], atol=1e-3)
        assert not depth[inside.reshape(120, 160) < -0.05].any()


def test_what_cannot_be_compared_is_told() -> None:
    empty = Mesh(np.zeros((3, 3)), np.zeros((0, 3), np.int32))
    with pytest.raises(DataError, match="without faces meets no ray"):
        MeshCaster(empty)
    with pytest.raises(DataError, match="without area has no points"):
        compare_surfaces(empty, ball(), samples=100)
    with pytest.raises(DataError, match="The found cloud is empty"):
        compare_surfaces(Cloud(np.zeros((0, 3))), ball(), samples=100)
    with pytest.raises(DataError, match="The true cloud is empty"):
        compare_surfaces(ball(), Cloud(np.zeros((0, 3))), samples=100)
    with pytest.raises(DataError, match=r"threshold is no distance; .*found \(0.1, 0\)"):
        compare_surfaces(ball(), ball(), thresholds=(0.1, 0), samples=100)
    away = RigidTransform.look_at((0.0, 0.0, 4.0), (0.0, 0.0, 9.0))
    with pytest.raises(StageError, match="see nothing of the true surface"):
        compare_surfaces(ball(), ball(), seen_from=[(CAMERA, away)], samples=100)
    near = RigidTransform.look_at((0.0, 0.0, 4.0), (0.0, 0.0, 0.0))
    with pytest.raises(StageError, match="Nothing that was found is where the truth can be told"):
        compare_surfaces(ball(0.1, (50.0, 0, 0)), ball(), seen_from=[(CAMERA, near)], samples=100)
