"""Meshes of densities, points and depth maps: spheres come out as spheres."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import CAMERA, around, ball, open_edges, radii

from toolkit.depth.mesh_clean import ClipSettings, clip_near, clip_to_points, drop_small, keep_largest
from toolkit.depth.mesh_marching import MarchingSettings, mesh_from_density
from toolkit.depth.mesh_poisson import PoissonSettings, poisson_mesh
from toolkit.depth.mesh_tsdf import TsdfSettings, tsdf_mesh
from toolkit.errors import DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.decimate import decimate
from toolkit.geometry.ray_casting import MeshCaster
from toolkit.geometry.surface import Cloud, DepthView, Mesh
from toolkit.geometry.triangles import vertex_normals
from toolkit.metrics.geometry import compare_surfaces
from toolkit.progress import ProgressEvent

MIDDLE = (100.0, -50.0, 20.0)
BOX = np.array([[98.8, -51.2, 18.8], [101.2, -48.8, 21.2]])


def density(points: np.ndarray) -> np.ndarray:
    """25 on a sphere of radius 1 about the middle, rising inwards."""
    return 25.0 + 50.0 * (1.0 - np.linalg.norm(points - np.array(MIDDLE), axis=1))


def outward(mesh: Mesh) -> np.ndarray:
    """Return the cosines (n,) between normals and the way out of the sphere."""
    along = mesh.vertices - np.array(MIDDLE)
    cosines: np.ndarray = np.einsum("ni,ni->n", vertex_normals(mesh), along) / np.linalg.norm(along, axis=1)
    return cosines


def two_balls() -> Mesh:
    small = ball(0.2, (3.0, 0, 0), finer=2)
    large = ball(finer=3)
    assert large.rgb is not None
    assert small.rgb is not None
    return Mesh(
        np.concatenate([small.vertices, large.vertices]),
        np.concatenate([small.faces, large.faces + len(small.vertices)]).astype(np.int32),
        np.concatenate([small.rgb, large.rgb]),
    )


@pytest.fixture(scope="module")
def views() -> list[DepthView]:
    truth = ball(1.0, MIDDLE)
    caster = MeshCaster(truth)
    rgb = np.full((120, 160, 3), (200, 100, 50), np.uint8)
    return [
        DepthView(f"{number}", CAMERA, pose, caster.depth(CAMERA, pose), rgb=rgb)
        for number, pose in enumerate(around(16, 3.0, MIDDLE))
    ]


def test_a_dense_ball_becomes_a_closed_sphere_with_its_outside_out() -> None:
    asked: list[int] = []
    events: list[ProgressEvent] = []

    def counted(points: np.ndarray) -> np.ndarray:
        asked.append(len(points))
        return density(points)

    def colour(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        assert np.einsum("ni,ni->n", normals, points - np.array(MIDDLE)).min() > 0.9
        return np.full((len(points), 3), (1, 2, 3), np.uint8)

    settings = MarchingSettings(resolution=48, block=20)
    mesh = mesh_from_density(counted, BOX, settings, colour=colour, progress=events.append)
    # Linear interpolation of a distance on cells of 0.05: its curvature costs cell^2 / 8 = 3e-4 at most.
    np.testing.assert_allclose(radii(mesh, MIDDLE), 1.0, atol=4e-4)
    assert open_edges(mesh) == 0  # across the blocks, too
    assert outward(mesh).min() > 0.99
    assert mesh.rgb is not None
    assert (mesh.rgb == (1, 2, 3)).all()
    assert max(asked) <= 21**3  # no more than a block at a time
    assert events[-1].done == events[-1].total == 27


def test_blocks_do_not_change_the_surface() -> None:
    one, many = (mesh_from_density(density, BOX, MarchingSettings(resolution=32, block=b)) for b in (64, 8))
    assert len(one.vertices) == len(many.vertices)
    assert len(one.faces) == len(many.faces)
    assert np.abs(compare_surfaces(one, many, samples=2_000).accuracy).max() < 1e-3


def test_a_density_without_surface_is_told() -> None:
    settings = MarchingSettings(resolution=8)
    with pytest.raises(StageError, match=r"no surface; expected .*threshold 1000; found -?\d"):
        mesh_from_density(density, BOX, MarchingSettings(resolution=8, threshold=1000.0))
    with pytest.raises(DataError, match="another shape than its points"):
        mesh_from_density(lambda points: np.zeros((len(points), 1)), BOX, settings)
    with pytest.raises(DataError, match="A density is not finite"):
        mesh_from_density(lambda points: np.full(len(points), np.nan), BOX, settings)
    with pytest.raises(DataError, match="has no volume"):
        mesh_from_density(density, BOX[::-1], settings)


def test_the_largest_piece_may_be_kept_alone() -> None:
    def two(points: np.ndarray) -> np.ndarray:
        return np.maximum(
            density(points), 25 + 50 * (0.2 - np.linalg.norm(points - np.array([102.0, -50, 20]), axis=1))
        )

    box = np.array([BOX[0], [102.5, -48.8, 21.2]])
    whole, largest = (
        mesh_from_density(two, box, MarchingSettings(resolution=60, largest_only=only)) for only in (False, True)
    )
    assert whole.vertices[:, 0].max() > 102
    assert largest.vertices[:, 0].max() < 101.01


@pytest.mark.parametrize("normals", ["given", "from cameras", "from neighbours"])
def test_points_of_a_sphere_become_a_sphere(normals: str) -> None:
    sphere = ball(1.0, MIDDLE, finer=4)
    cloud = Cloud(sphere.vertices, sphere.rgb, sphere.normals if normals == "given" else None)
    seen_from = np.array([pose.centre for pose in around(20, 4.0, MIDDLE)]) if normals == "from cameras" else None
    mesh = poisson_mesh(cloud, PoissonSettings(depth=6), seen_from=seen_from)
    # Cells are 2.2 / 64 = 0.034 wide; points lie 0.1 apart and are smoothed over.
    np.testing.assert_allclose(radii(mesh, MIDDLE), 1.0, atol=0.006)
    assert open_edges(mesh) == 0
    assert outward(mesh).min() > 0.97
    assert mesh.rgb is not None
    expected = (mesh.vertices - np.array(MIDDLE) + 1) * 127
    assert np.abs(mesh.rgb - expected).mean() < 7  # grey levels: half the way to the next point


def test_poisson_goes_no_farther_than_the_points() -> None:
    sphere = ball(finer=5)
    cap = sphere.vertices[:, 2] > 0.3
    assert sphere.normals is not None
    cloud = Cloud(sphere.vertices[cap], None, sphere.normals[cap])
    loose = poisson_mesh(cloud, PoissonSettings(depth=6, trim=0, reach=0))
    tight = poisson_mesh(cloud, PoissonSettings(depth=6, trim=0, reach=3))
    trimmed = poisson_mesh(cloud, PoissonSettings(depth=6, trim=1.5, reach=0))
    assert loose.vertices[:, 2].min() < 0.1  # the bubble that closes the cap
    for mesh in (tight, trimmed):
        assert mesh.vertices[:, 2].min() > 0.1
        assert mesh.rgb is None
        errors = compare_surfaces(Cloud(sphere.vertices[cap]), mesh, samples=5_000)
        assert np.percentile(errors.accuracy, 99) < 0.02  # nothing of the cap itself went


def test_too_few_points_for_a_surface_are_told() -> None:
    with pytest.raises(StageError, match=r"too small for a surface; .*found 10 points"):
        poisson_mesh(Cloud(np.eye(10, 3)), PoissonSettings())
    with pytest.raises(StageError, match="too small for a surface"):
        poisson_mesh(Cloud(np.zeros((0, 3))), PoissonSettings())
    with pytest.raises(StageError, match="too small for a surface"):
        poisson_mesh(Cloud(np.ones((50, 3))), PoissonSettings())


def test_depth_of_a_sphere_from_all_sides_is_the_sphere(views: list[DepthView]) -> None:
    mesh = tsdf_mesh(iter(views), TsdfSettings())
    errors = compare_surfaces(
        mesh, ball(1.0, MIDDLE), seen_from=[(v.camera, v.cam_from_world) for v in views], samples=20_000
    )
    # Pixels are 0.0137 wide at the median depth of 2.05, voxels 0.027: a tenth of a voxel in the mean, one at most.
    assert errors.accuracy.mean() < 0.0027
    assert errors.accuracy.max() < 0.027
    assert errors.completeness.mean() < 0.0027
    assert abs(float(np.mean(radii(mesh, MIDDLE))) - 1) < 0.001
    assert outward(mesh).mean() > 0.98
    assert mesh.rgb is not None
    np.testing.assert_allclose(mesh.rgb, np.tile((200, 100, 50), (len(mesh.rgb), 1)), atol=1)


def test_pixels_are_where_colmap_has_them() -> None:
    # A slope of 0.8: half a pixel of 5 / 300 would show as 0.0052.
    slope = Mesh(
        np.array([[-9, -9, -2.2], [9, -9, 12.2], [9, 9, 12.2], [-9, 9, -2.2]]),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    )
    camera = ColmapCamera.pinhole(160, 120, 300.0)
    pose = around(1, 1.0)[0]
    moved = Mesh(pose.inverse().apply(slope.vertices), slope.faces)
    view = DepthView("a", camera, pose, MeshCaster(moved).depth(camera, pose))
    mesh = tsdf_mesh([view], TsdfSettings())
    apart = (pose.apply(mesh.vertices) - [0, 0, 5]) @ (np.array([-0.8, 0, 1]) / np.hypot(0.8, 1))
    assert abs(apart.mean()) < 1e-3
    assert mesh.rgb is None


def test_far_and_unsure_pixels_do_not_count(views: list[DepthView]) -> None:
    first = views[0]
    depth = first.depth.copy()
    depth[:20] = 30.0
    confidence = np.ones_like(depth)
    confidence[:, :80] = 0.2
    spoilt = DepthView("a", first.camera, first.cam_from_world, depth, confidence=confidence)
    mesh = tsdf_mesh([spoilt], TsdfSettings(min_confidence=0.5))
    inside = first.cam_from_world.apply(mesh.vertices)
    assert inside[:, 2].max() < 6
    assert inside[:, 0].min() > -0.05
    unsure = DepthView("a", first.camera, first.cam_from_world, depth, confidence=np.full_like(depth, 0.2))
    with pytest.raises(StageError, match="no depth to make a surface of.*Lower min_confidence"):
        tsdf_mesh([unsure], TsdfSettings(min_confidence=0.5))


def test_depth_maps_without_a_surface_are_told(views: list[DepthView], monkeypatch: pytest.MonkeyPatch) -> None:
    first = views[0]
    with pytest.raises(StageError, match=r"no depth to make a surface of; .*found none in 0 views"):
        tsdf_mesh([], TsdfSettings())
    empty = DepthView("a", first.camera, first.cam_from_world, np.zeros_like(first.depth))
    with pytest.raises(StageError, match=r"no depth to make a surface of; .*found none in 1 views"):
        tsdf_mesh([empty], TsdfSettings())
    with pytest.raises(StageError, match="Only crumbs are left"):
        tsdf_mesh([first], TsdfSettings(smallest=10_000_000))
    with monkeypatch.context() as smaller:
        smaller.setattr("toolkit.depth.mesh_tsdf._MOST_BLOCKS", 20)
        with pytest.raises(StageError, match="The voxels are too small.*at view '0'.*Give larger voxels"):
            tsdf_mesh([first], TsdfSettings())
    grey = DepthView("1", views[1].camera, views[1].cam_from_world, views[1].depth)
    with pytest.raises(DataError, match="View '1' has no colours, unlike the first one"):
        tsdf_mesh([first, grey], TsdfSettings())
    bent = ColmapCamera("SIMPLE_RADIAL", 160, 120, (150, 80, 60, 0.1))
    with pytest.raises(DataError, match="no pinhole; .*Undistort the scene first"):
        tsdf_mesh([DepthView("a", bent, first.cam_from_world, first.depth)], TsdfSettings())


def test_a_mesh_is_clipped_to_the_neighbourhood_of_points() -> None:
    mesh = two_balls()
    points = ball(finer=3).vertices
    near = clip_to_points(mesh, points[points[:, 2] > 0], 0.1)
    assert near.vertices[:, 2].min() > -0.1
    assert near.vertices[:, 0].max() <= 1.0
    assert near.rgb is not None
    assert len(near.rgb) == len(near.vertices)
    # Points are 0.1 to 0.2 apart: all of the large ball stays, and none of the small one 1.8 away.
    assert len(clip_near(mesh, points, ClipSettings(spacings=2)).faces) == len(ball(finer=3).faces)
    with pytest.raises(StageError, match=r"Clipping left nothing.*within 0.1 of 1 points.*vertices at 6\."):
        clip_to_points(mesh, np.array([[0, 0, 7.0]]), 0.1)
    with pytest.raises(DataError, match="no points to clip the mesh to"):
        clip_to_points(mesh, np.zeros((0, 3)), 0.1)
    with pytest.raises(DataError, match="clipped to a distance; expected a positive one; found 0"):
        clip_to_points(mesh, points, 0.0)
    with pytest.raises(DataError, match="Too few points for a spacing"):
        clip_near(mesh, points[:8], ClipSettings())


def test_small_pieces_go() -> None:
    mesh = two_balls()
    large = keep_largest(mesh)
    assert len(large.faces) == 8 * 4**3
    assert large.vertices[:, 0].max() == 1.0
    assert len(drop_small(mesh, 128).faces) == len(mesh.faces)
    assert len(drop_small(mesh, 129).faces) == 8 * 4**3
    assert len(drop_small(mesh, 10_000).faces) == 0


def test_fewer_faces_keep_the_shape_and_the_colours() -> None:
    sphere = ball(1.0, MIDDLE, finer=5)
    small = decimate(sphere, 1_000)
    assert 900 <= len(small.faces) <= 1_000
    # 1,000 faces: a sphere's facets sag by about 4 pi / 1000 / 4.
    np.testing.assert_allclose(radii(small, MIDDLE), 1.0, atol=0.01)
    assert small.rgb is not None
    assert np.abs(small.rgb - (small.vertices - np.array(MIDDLE) + 1) * 127).mean() < 4
    assert decimate(sphere, 10_000) is sphere
    # Many times fewer, by cubes first: twice the tolerance.
    smaller = decimate(ball(1.0, MIDDLE, finer=6), 1_000)
    assert 700 <= len(smaller.faces) <= 1_000
    np.testing.assert_allclose(radii(smaller, MIDDLE), 1.0, atol=0.02)
