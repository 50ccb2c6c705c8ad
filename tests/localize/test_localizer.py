"""Localising renders of a small map: near and far starts, distorted lenses, and photos of nothing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from splat_ground import CAMERA, down, ground_map, photo

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.fan import fan_poses
from toolkit.localize.judge import likeness
from toolkit.localize.localizer import Localizer
from toolkit.localize.matched_round import Clock
from toolkit.localize.one_shot import OneShot, one_shot_name
from toolkit.localize.polish import polish
from toolkit.localize.query import Query, flat_picture, render_camera, shrunk_query
from toolkit.localize.settings import LocalizeSettings, OneShotSettings, PolishSettings, ReliabilitySettings
from toolkit.localize.splat_map import SplatMap
from toolkit.localize.starts import Start
from toolkit.metrics.localization import pose_errors

TRUE = down(3.0, -2.0, turn=(2.0, -3.0, 20.0))

ONCE = OneShotSettings().replace({"match.method": "sift"})


@pytest.fixture(scope="module")
def ground() -> SplatMap:
    return ground_map()


@pytest.fixture(scope="module")
def query(ground: SplatMap) -> Query:
    return photo(ground, TRUE)


def settings(**changes: object) -> LocalizeSettings:
    return LocalizeSettings().replace({"polish.steps": 8, **changes})


def start(pose: RigidTransform, metres: float = 10.0, degrees: float = 15.0) -> Start:
    return Start("photo", pose, metres, degrees)


def test_ours_ends_at_the_truth_where_one_shot_does_not(ground: SplatMap, query: Query) -> None:
    far = down(18.0, 6.0, turn=(12.0, 4.0, 35.0))
    once = OneShot(ground, ONCE).localize(query, start(far))
    ours = Localizer(ground, settings()).localize(query, start(far))
    assert once.cam_from_world is not None
    assert ours.cam_from_world is not None
    metres, degrees = pose_errors(ours.cam_from_world, TRUE)
    # The photo is the map's own render: what is left is the stillness asked for, 0.0005 of 40 m, and the polish.
    assert metres < 0.02
    assert degrees < 0.03
    assert metres < 0.5 * pose_errors(once.cam_from_world, TRUE)[0]
    assert once.rounds == 1
    assert ours.rounds >= 2
    assert ours.trail[0].rendered_from is far
    assert set(ours.seconds) == {"features", "render", "match", "pnp", "polish", "judge"}


def test_the_covariance_covers_the_error(ground: SplatMap, query: Query) -> None:
    done = Localizer(ground, settings(**{"polish.use": False})).localize(query, start(down(5.0, 0.0)))
    assert done.cam_from_world is not None
    assert done.covariance is not None
    error = done.cam_from_world.centre - TRUE.centre
    assert float(error @ np.linalg.solve(done.covariance[:3, :3], error)) < 16.0
    assert done.position_sigma is not None
    assert done.position_sigma.shape == (3,)
    assert done.to_dict()["found"] is True


def test_a_fan_finds_what_the_start_does_not_show(ground: SplatMap, query: Query) -> None:
    away = start(down(-30.0, -25.0, turn=(-20.0, 15.0, 20.0)), 20.0, 12.0)
    without = Localizer(ground, settings(**{"fan.most": 0})).localize(query, away)
    assert without.cam_from_world is None
    assert "matches agree" in without.reason
    found = Localizer(ground, settings(**{"fan.most": 60, "fan.side": 240})).localize(query, away)
    assert found.cam_from_world is not None
    assert pose_errors(found.cam_from_world, TRUE)[0] < 0.02
    assert found.seconds["fan"] > 0


@pytest.mark.parametrize("kind", ["black", "noise", "elsewhere", "blurred"])
def test_what_is_not_in_the_map_is_not_found(ground: SplatMap, query: Query, kind: str) -> None:
    from scipy.ndimage import gaussian_filter

    pictures = {
        "black": np.zeros_like(query.picture),
        "noise": np.random.default_rng(0).integers(0, 255, query.picture.shape, dtype=np.uint8),
        "elsewhere": photo(ground_map(seed=9), TRUE).picture,
        "blurred": gaussian_filter(query.picture, (12, 12, 0)),
    }
    lost = Query("photo", pictures[kind], CAMERA)
    for done in (
        Localizer(ground, settings(**{"fan.most": 8})).localize(lost, start(down())),
        OneShot(ground, ONCE).localize(lost, start(down())),
    ):
        assert done.cam_from_world is None
        assert "matches agree" in done.reason
        assert done.covariance is None
        assert not done


def test_a_pose_far_from_a_sure_start_is_not_believed(ground: SplatMap, query: Query) -> None:
    sure = start(down(9.0, -2.0, turn=(2.0, -3.0, 20.0)), 0.5, 0.5)
    done = Localizer(ground, settings()).localize(query, sure)
    assert done.cam_from_world is None
    assert "standard deviations from the start" in done.reason
    unsure = dataclasses.replace(sure, position_sigma=float("inf"), rotation_sigma_deg=float("inf"))
    assert Localizer(ground, settings()).localize(query, unsure)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"judge.min_inliers": 100_000}, "are needed"),
        ({"judge.min_inlier_share": 1.0, "pnp.max_error": 0.1, "blur": 0.0}, "100% are needed"),
        ({"judge.max_position_sigma": 0.0}, "known to"),
        ({"judge.min_likeness": 1.0}, "do not look alike"),
        ({"rounds": 1, "still": 0.0}, "still moves by"),
    ],
)
def test_every_doubt_has_its_reason(ground: SplatMap, query: Query, change: dict[str, float], reason: str) -> None:
    done = Localizer(ground, settings(**{"fan.most": 0, **change})).localize(query, start(down(6.0, 3.0)))
    assert done.cam_from_world is None
    assert reason in done.reason


def test_a_distorted_photo_is_localised_through_its_lens(ground: SplatMap) -> None:
    lens = ColmapCamera("OPENCV", 240, 180, (200.0, 200.0, 120.0, 90.0, -0.15, 0.03, 0.0, 0.0))
    # The photo: what a wider pinhole sees from the same place, bent as the lens bends it.
    wide = ColmapCamera.pinhole(360, 270, 200.0)
    flat = ground.render(wide, TRUE, ReliabilitySettings()).colour
    x, y = np.meshgrid(np.arange(240) + 0.5, np.arange(180) + 0.5)
    _, rays = lens.ray(np.column_stack([x.ravel(), y.ravel()]))
    at = wide.project(rays).reshape(180, 240, 2) - 0.5
    from scipy.ndimage import map_coordinates

    picture = np.stack(
        [map_coordinates(flat[..., k].astype(float), at[..., ::-1].transpose(2, 0, 1), order=1) for k in range(3)],
        -1,
    ).astype(np.uint8)
    bent = Query("photo", picture, lens)
    done = Localizer(ground, settings()).localize(bent, start(down(6.0, 0.0)))
    assert done.cam_from_world is not None
    # Resampled twice: a tenth of a pixel at 40 m is 0.02 m.
    assert pose_errors(done.cam_from_world, TRUE)[0] < 0.04
    straight, shown = flat_picture(bent, render_camera(lens, 1000))
    theirs = ground.render(CAMERA, TRUE, ReliabilitySettings()).colour
    assert shown.mean() > 0.9
    assert np.abs(straight.astype(float) - theirs)[shown].mean() < 5.0


def test_polish_finds_the_place_from_centimetres_off_under_another_exposure(ground: SplatMap, query: Query) -> None:
    off = down(3.15, -2.1, turn=(2.05, -3.1, 20.1))
    darker = Query("photo", (query.picture * 0.6 + 20).astype(np.uint8), CAMERA)
    done = polish(ground, darker, off, 40.0, PolishSettings(steps=40), ReliabilitySettings())
    assert done.cam_from_world is not None
    assert done.after < done.before
    metres, _ = pose_errors(done.cam_from_world, TRUE)
    assert metres < 0.25 * pose_errors(off, TRUE)[0]


def test_polish_needs_something_to_see(ground: SplatMap, query: Query) -> None:
    beyond = down(500.0, 0.0)
    assert polish(ground, query, beyond, 40.0, PolishSettings(), ReliabilitySettings()).cam_from_world is None


def test_likeness_knows_details_from_shade(ground: SplatMap, query: Query) -> None:
    everywhere = np.ones(query.picture.shape[:2], bool)
    shaded = (query.picture * np.linspace(0.5, 1.0, 240)[None, :, None]).astype(np.uint8)
    assert likeness(query.picture, shaded, everywhere) > 0.9
    assert abs(likeness(query.picture, photo(ground_map(seed=3), TRUE).picture, everywhere)) < 0.2
    assert likeness(query.picture, query.picture, ~everywhere) == 0.0


def test_a_fan_is_as_wide_as_its_start_is_unsure() -> None:
    poses = fan_poses(start(down(), 5.0, 10.0), 200, 2.0)
    offsets = np.array([pose.centre - down().centre for pose in poses])
    assert len(poses) == 200
    assert np.abs(offsets).max() <= 10.0
    # A normal distribution cut off at two of its deviations has 0.88 of its deviation.
    np.testing.assert_allclose(offsets.std(axis=0), 4.4, rtol=0.1)
    angles = [pose_errors(pose, down())[1] for pose in poses]
    assert 10.0 < float(np.median(angles)) < 20.0
    again = fan_poses(start(down(), 5.0, 10.0), 200, 2.0)
    assert all(np.array_equal(a.matrix, b.matrix) for a, b in zip(poses, again, strict=True))
    assert fan_poses(start(down(), 0.0, 0.0), 5, 2.0) == ()
    assert fan_poses(start(down()), 0, 2.0) == ()


def test_one_shot_is_the_papers_with_the_papers_features_only() -> None:
    assert one_shot_name("superpoint-lightglue") == "paper"
    assert one_shot_name("sift") == "one-shot-sift"


def test_a_photo_must_fit_its_camera() -> None:
    with pytest.raises(DataError, match="does not fit its camera"):
        Query("photo", np.zeros((10, 10, 3), np.uint8), CAMERA)


def test_photos_finer_than_the_map_are_shrunk(ground: SplatMap) -> None:
    # Disks of 0.36 m: a quarter of that is a pixel of 0.09 m, which this camera has from 18 m.
    assert ground.detail() == pytest.approx(0.36, rel=1e-3)
    low = down(2.0, 1.0, height=8.0, turn=(1.0, 2.0, 10.0))
    near = photo(ground, low, ColmapCamera.pinhole(480, 360, 400.0))
    done = Localizer(ground, settings()).localize(near, start(down(3.0, 0.0, height=9.0), 2.0, 5.0))
    assert done.cam_from_world is not None
    assert pose_errors(done.cam_from_world, low)[0] < 0.02
    whole = Localizer(ground, settings(finest=0.0)).localize(near, start(down(3.0, 0.0, height=9.0), 2.0, 5.0))
    # A photo of a third of the sides shows what the map shows, too; its pixels are told on the whole one.
    assert done.trail[-1].matches > 1.2 * whole.trail[-1].matches
    for each in (done, whole):
        last = each.trail[-1]
        assert last.photo_pixels[:, 0].max() > 400
        missed = near.camera.project(low.apply(last.points[last.inside])) - last.photo_pixels[last.inside]
        assert np.median(np.linalg.norm(missed, axis=1)) < 3.0  # a pixel of the small photo has three of the whole


def test_matches_may_miss_by_as_much_as_the_map_is_blurred(ground: SplatMap) -> None:
    low = down(2.0, 1.0, height=8.0, turn=(1.0, 2.0, 10.0))
    near = photo(ground, low, ColmapCamera.pinhole(480, 360, 400.0))
    begin = start(down(3.0, 0.0, height=9.0), 2.0, 5.0)
    # From there 19 of 32 matches agree within 2 pixels, 26 within 4: disks of 0.36 m are 8 pixels of what is left.
    strict = {"finest": 0.12, "judge.min_inliers": 25, "fan.most": 0}
    sharp = Localizer(ground, settings(**strict, blur=0.0)).localize(near, begin)
    assert sharp.cam_from_world is None
    assert "25 are needed" in sharp.reason
    blurred = Localizer(ground, settings(**strict, blur=0.5)).localize(near, begin)
    assert blurred.cam_from_world is not None
    assert pose_errors(blurred.cam_from_world, low)[0] < 0.03


@pytest.mark.parametrize(
    ("height", "size", "error"),
    [
        (60.0, (240, 180), 2.0),  # a disk is 1.2 pixels wide
        (18.0, (240, 180), 4.0),  # four pixels of a photo that is just fine enough
        (3.0, (160, 120), 4.0),  # sixteen, of which a fortieth of the longer side may be missed
    ],
)
def test_the_error_that_matches_may_have_grows_with_the_blur_up_to_a_bound(
    ground: SplatMap, query: Query, height: float, size: tuple[int, int], error: float
) -> None:
    search = Localizer(ground, settings())._search(query, down(0.0, 0.0, height=height), None, 0, Clock())
    assert (search.query.camera.width, search.query.camera.height) == size
    assert search.pnp.max_error == pytest.approx(error, rel=0.1)  # heights are above the mean of a wavy ground


def test_from_where_nothing_of_the_map_is_seen_a_photo_is_taken_as_it_is(ground: SplatMap, query: Query) -> None:
    away = down(5000.0, 0.0, height=3.0)
    search = Localizer(ground, settings())._search(query, away, None, 0, Clock())
    assert search.query is query
    assert search.pnp.max_error == settings().pnp.max_error


def test_a_photo_is_shrunk_with_its_camera(query: Query) -> None:
    half = shrunk_query(query, 2.0, least_side=10)
    assert half.picture.shape == (90, 120, 3)
    assert half.camera.params[0] == pytest.approx(100.0)
    assert shrunk_query(query, 0.5, least_side=10) is query
    assert shrunk_query(query, 100.0, least_side=60).picture.shape == (45, 60, 3)
    assert shrunk_query(query, 2.0, least_side=1000) is query
