"""Pictures of the town: exact in geometry, lit from where the sun is, the same each time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.samples.make import view_points
from toolkit.samples.town import SKY, Material, RenderedView, Town, TownSettings, build_town, render_view
from toolkit.samples.town.render import develop, sample_pattern

Judge = Callable[[Town, NDArray[np.float64]], NDArray[np.float64]]

CAMERA = ColmapCamera.pinhole(64, 48, 50.0)
LARGE = ColmapCamera.pinhole(160, 120, 125.0)
ORBIT = RigidTransform.look_at([60.0, -20.0, 45.0], [0.0, 0.0, 3.0])
BESIDE = RigidTransform.look_at([60.0, -12.0, 42.0], [1.0, 0.0, 3.0])
LOW = RigidTransform.look_at([7.0, 4.0, 2.5], [0.0, 0.0, 2.5])


def make_town(seed: int = 0, **settings: object) -> Town:
    return build_town(TownSettings(**{"trees": 12, **settings}), np.random.default_rng(seed))


@pytest.fixture(scope="module")
def town() -> Town:
    return make_town()


def seen_pixels(view: RenderedView) -> NDArray[np.int64]:
    return np.argwhere(view.depth > 0)[:, ::-1]


@pytest.mark.parametrize("pose", [ORBIT, LOW], ids=["orbit", "low"])
@pytest.mark.parametrize(
    "camera",
    [CAMERA, ColmapCamera("OPENCV_FISHEYE", 64, 48, (30.0, 31.0, 32.5, 24.0, 0.01, -0.005, 0.0, 0.0))],
    ids=["pinhole", "fisheye"],
)
def test_depths_lie_on_the_surface(
    town: Town, camera: ColmapCamera, pose: RigidTransform, surface_distance: Judge
) -> None:
    view = render_view(town, camera, pose, samples=1)
    points = view_points(view, camera, pose, seen_pixels(view))
    assert len(points) > 1000
    distance = surface_distance(town, points)
    # Near an edge the judge may name the neighbouring triangle; elsewhere float32 depth is all that is lost.
    assert distance.max() < 1e-3
    assert np.quantile(distance, 0.97) < 1e-4


def test_a_point_seen_in_one_view_is_where_the_other_sees_it(town: Town) -> None:
    first = render_view(town, CAMERA, ORBIT, samples=1)
    points = view_points(first, CAMERA, ORBIT, seen_pixels(first))
    in_second = BESIDE.apply(points)
    pixels = CAMERA.project(in_second)
    within = np.all((pixels > 0) & (pixels < [CAMERA.width, CAMERA.height]), axis=1)
    origins, directions = CAMERA.ray(pixels[within])
    world_from_cam = BESIDE.inverse()
    hits = town.cast(world_from_cam.apply(origins), directions @ world_from_cam.rotation.T)
    expected = np.linalg.norm(in_second[within], axis=1)
    # The ray back to the point meets it, or something in front of it: never what lies behind.
    assert (hits.distance - expected).max() < 1e-3
    assert np.mean(np.abs(hits.distance - expected) < 1e-3) > 0.75


def test_depth_is_camera_z_at_the_pixel_centre(town: Town) -> None:
    height = 100.0
    down = RigidTransform.look_at([2.0, 3.0, height], [2.0, 3.0, 0.0])
    view = render_view(town, CAMERA, down, samples=1)
    ground = view.material == Material.GROUND
    np.testing.assert_allclose(view.depth[ground], height, rtol=1e-6)
    assert (view.depth[~ground] < height).all()
    column, row = np.array([50, 10])
    there = view_points(view, CAMERA, down, np.array([[column, row]]))[0]
    # North is up and east is right in the picture; the pixel's centre is half a pixel on.
    sight = np.array([(column + 0.5 - 32.0), -(row + 0.5 - 24.0)]) / 50.0
    np.testing.assert_allclose(there[:2], [2.0, 3.0] + sight * view.depth[row, column], atol=1e-4)


def test_sky_has_no_depth(town: Town) -> None:
    level = RigidTransform.look_at([0.0, -60.0, 60.0], [0.0, 60.0, 75.0])
    view = render_view(town, CAMERA, level)
    np.testing.assert_array_equal(view.depth == 0, view.material == SKY)
    assert (view.material == SKY)[:10].all()
    assert not view.sunlit[view.material == SKY].any()


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(town: Town) -> None:
    again, other = make_town(), make_town(seed=1)
    view, repeated, different = (render_view(t, CAMERA, ORBIT) for t in (town, again, other))
    np.testing.assert_array_equal(view.colour, repeated.colour)
    np.testing.assert_array_equal(view.depth, repeated.depth)
    assert np.mean(view.colour != different.colour) > 0.5


def test_the_shadow_falls_away_from_the_sun() -> None:
    ball = 6.6  # height in metres of the ball on the monument
    east = make_town(sun_azimuth=90.0, sun_elevation=45.0)
    np.testing.assert_allclose(east.sun, [np.sqrt(0.5), 0.0, np.sqrt(0.5)], atol=1e-12)
    down = RigidTransform.look_at([0.0, 0.0, 30.0], [0.0, 0.0, 0.0])
    view = render_view(east, CAMERA, down)

    def lit(x: float, y: float) -> bool:
        column, row = np.floor(CAMERA.project(down.apply([[x, y, 0.0]]))[0]).astype(int)
        return bool(view.sunlit[row, column])

    assert not lit(-ball, 0.0)  # in the west: its middle, at 45 degrees as far off as it is high
    assert lit(ball, 0.0)
    assert lit(0.0, ball)


def test_shadow_is_darker(town: Town) -> None:
    view = render_view(town, LARGE, ORBIT)
    ground = view.material == Material.GROUND
    bright = view.colour[ground & view.sunlit].mean()
    dark = view.colour[ground & ~view.sunlit].mean()
    assert (ground & ~view.sunlit).sum() > 200
    assert dark < 0.65 * bright


def differences(town: Town) -> tuple[NDArray, NDArray, NDArray]:
    """Return colour differences (N,) of what two views share, the same for pairs at random, and the materials."""
    first, second = render_view(town, LARGE, ORBIT), render_view(town, LARGE, BESIDE)
    pixels = seen_pixels(first)
    there = BESIDE.apply(view_points(first, LARGE, ORBIT, pixels))
    spot = np.floor(LARGE.project(there)).astype(int)
    within = np.all((spot >= 0) & (spot < [LARGE.width, LARGE.height]), axis=1)
    pixels, there, spot = pixels[within], there[within], spot[within]
    shared = np.abs(second.depth[spot[:, 1], spot[:, 0]] - there[:, 2]) < 0.3
    pixels, spot = pixels[shared], spot[shared]
    a = first.colour[pixels[:, 1], pixels[:, 0]].astype(float)
    b = second.colour[spot[:, 1], spot[:, 0]].astype(float)
    mixed = np.random.default_rng(0).permutation(b)
    material = first.material[pixels[:, 1], pixels[:, 0]]
    return np.abs(a - b).mean(axis=1), np.abs(a - mixed).mean(axis=1), material


def test_texture_stays_on_its_surface(town: Town) -> None:
    real, mixed, material = differences(town)
    plain = material != Material.GLASS
    # Half a pixel of difference in where the two views sample a detailed texture remains.
    assert np.median(real[plain]) < 0.15 * np.median(mixed[plain])


def test_glass_shows_what_stands_before_it() -> None:
    town = make_town(glass_share=1.0)
    view, pose = glass_front(town)
    pixels = np.argwhere(view.material == Material.GLASS)[:, ::-1]
    points = view_points(view, LARGE, pose, pixels)
    along = points - pose.centre
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    normal = town.mesh.normal[town.cast(np.broadcast_to(pose.centre, along.shape), along).triangle]
    mirrored = along - 2 * np.sum(along * normal, axis=1, keepdims=True) * normal
    meets_sky = ~town.cast(points + 1e-2 * mirrored, mirrored).met
    brightness = view.colour[pixels[:, 1], pixels[:, 0]].mean(axis=1)
    assert min(meets_sky.sum(), (~meets_sky).sum()) > 500
    # By the law of reflection, computed here: the sky is brighter than the ground in shadow of the facade.
    assert brightness[meets_sky].mean() > brightness[~meets_sky].mean() + 15


def glass_front(town: Town) -> tuple[RenderedView, RigidTransform]:
    """Return a view of a glass facade from a place in front of it with room around, level with its middle."""
    mesh = town.mesh
    for face in np.flatnonzero((mesh.material == Material.GLASS) & (mesh.style[:, 4] == 0.0)):
        corners = mesh.vertices[mesh.triangles[mesh.face == face]].reshape(-1, 3).astype(float)
        middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        outward = np.cross(mesh.u_axis[face], mesh.v_axis[face])
        pose = RigidTransform.look_at(middle + 11.0 * outward, middle)
        view = render_view(town, LARGE, pose, samples=1)
        if town.clearance(pose.centre[None]).min() > 2.0 and np.mean(view.material == Material.GLASS) > 0.5:
            return view, pose
    raise AssertionError("no glass facade with room before it")


def test_more_samples_come_nearer_to_the_truth(town: Town) -> None:
    truth = render_view(town, CAMERA, ORBIT, samples=32).colour.astype(float)
    error = [np.abs(render_view(town, CAMERA, ORBIT, samples=n).colour - truth).mean() for n in (1, 4)]
    assert error[1] < 0.7 * error[0]
    assert error[1] < 5.0  # grey levels, in a picture whose pixels are a metre wide


def test_the_mast_is_seen_although_its_struts_are_thinner_than_a_pixel() -> None:
    mast = make_town().plan.mast
    assert mast is not None
    with_mast = make_town()
    x, y = mast[0]
    cos, sin = np.cos(with_mast.plan.yaw), np.sin(with_mast.plan.yaw)
    foot = np.array([cos * x - sin * y, sin * x + cos * y, 0.0])
    pose = RigidTransform.look_at(foot - np.array([0.0, 80.0, -60.0]), foot + np.array([0.0, 0.0, 15.0]))
    view = render_view(with_mast, CAMERA, pose, samples=16)
    share = np.linspace(0.1, 0.6, 12)[:, None]
    axis = CAMERA.project(pose.apply(foot + share * [0.0, 0.0, mast[1]]))
    rows, columns = axis[:, 1].astype(int), axis[:, 0].astype(int)
    tint = np.array(
        [view.colour[r, c - 1 : c + 2].astype(float).max(axis=0) for r, c in zip(rows, columns, strict=True)]
    )
    # Red and white bands: somewhere red stands out over green by more than grass, stone or asphalt would let it.
    assert (tint[:, 0] - tint[:, 1]).max() > 12


def test_sample_positions_use_each_row_and_column_once() -> None:
    for count in (1, 2, 4, 7, 16):
        pattern = sample_pattern(count)
        for axis in (0, 1):
            np.testing.assert_allclose(np.sort(pattern[:, axis]), (np.arange(count) + 0.5) / count)
        np.testing.assert_allclose(pattern.mean(axis=0), 0.5)


def test_developing_is_monotonic_and_ends_at_white() -> None:
    shown = develop(np.linspace(0, 20, 200, dtype=np.float32))
    assert (np.diff(shown) >= 0).all()
    assert shown[0] == 0.0
    assert shown[-1] == pytest.approx(1.0)


def test_no_samples_are_refused(town: Town) -> None:
    with pytest.raises(ValueError, match="expected at least 1 sample"):
        render_view(town, CAMERA, ORBIT, samples=0)
