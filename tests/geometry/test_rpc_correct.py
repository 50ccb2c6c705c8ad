"""Refinement of RPCs from tie points: biases of known size, wrong matches, and what the points leave open."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pushbroom import SIDE, rpc_camera

from toolkit.errors import DataError, SettingsError, StageError
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.geometry.rpc_correct import RpcRefinement, refine_rpcs
from toolkit.geometry.rpc_settings import RpcRefinementSettings

VIEWS = ((20.0, 30.0), (25.0, 200.0), (15.0, 90.0), (30.0, 300.0))
BIASES = np.array([[3.0, -2.0], [-1.5, 2.5], [0.5, -3.5], [-2.0, 1.0]])
NOISE = 0.3
SETTINGS = RpcRefinementSettings(sigma_px=NOISE)


@dataclass
class Ties:
    cameras: list[RpcCamera]
    true: list[RpcCamera]
    points: NDArray[np.float64]
    camera: NDArray[np.int64]
    point: NDArray[np.int64]
    pixel: NDArray[np.float64]

    def refined(self, settings: RpcRefinementSettings = SETTINGS, **more: Any) -> RpcRefinement:
        return refine_rpcs(self.cameras, self.camera, self.point, self.pixel, settings, **more)


def ties(
    corrections: NDArray[np.float64] = BIASES, count: int = 300, noise: float = NOISE, wrong: float = 0.0
) -> Ties:
    """Return points seen by most of the cameras, whose RPCs lack the corrections, in random order."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-200, -200, -80], [200, 200, 80], (count, 3))
    cameras = [rpc_camera(*view) for view in VIEWS[: len(corrections)]]
    true = [camera.with_correction(values.tolist()) for camera, values in zip(cameras, corrections, strict=True)]
    camera, point = np.nonzero(rng.random((len(true), count)) < 0.8)
    pixel = np.concatenate([item.project(points[point[camera == index]]) for index, item in enumerate(true)])
    pixel += rng.normal(0, noise, pixel.shape)
    outlier = rng.random(len(pixel)) < wrong
    pixel[outlier] += rng.uniform(-40, 40, (int(outlier.sum()), 2))
    order = rng.permutation(len(pixel))
    return Ties(cameras, true, points, camera[order], point[order], pixel[order])


def disagreement(refined: RpcRefinement, made: Ties) -> NDArray[np.float64]:
    """Return by how much (C, 2) biases are wrong, but for the common shift of ground and pictures."""
    shift = np.nanmedian(refined.points - made.points[: len(refined.points)], axis=0)
    slopes = np.stack([camera.jacobian(np.zeros((1, 3)))[0] for camera in made.true])
    wrong: NDArray[np.float64] = (refined.correction - [camera.correction for camera in made.true])[:, [0, 3]]
    return wrong + slopes @ shift


def test_biases_are_found_but_for_a_common_shift() -> None:
    made = ties()
    refined = made.refined()
    # 240 points of 0.3 px each in a picture: 0.02 px.
    np.testing.assert_allclose(disagreement(refined, made), 0.0, rtol=0, atol=0.1)
    assert refined.rms_before > 2.0
    # Two coordinates, of which places take three eighths of the freedom.
    assert refined.rms == pytest.approx(NOISE * np.sqrt(2) * np.sqrt(1 - 3 / 6.4), rel=0.1)
    assert refined.sigma0 == pytest.approx(1.0, abs=0.1)
    assert refined.inlier.mean() > 0.99
    assert [camera.correction for camera in refined.cameras] == [tuple(row) for row in refined.correction.tolist()]


def test_the_gauge_is_the_smallest_corrections() -> None:
    made = ties()
    refined = made.refined()
    # Which common shift of the ground, that the pictures follow, would make the corrections smaller?
    slopes = np.stack([camera.jacobian(np.zeros((1, 3)))[0] for camera in made.true]).reshape(-1, 3)
    found = refined.correction[:, [0, 3]].ravel()
    smaller = np.linalg.lstsq(slopes, found)[0]
    # None but centimetres: over such a box perspective hardly tells where the ground is.
    np.testing.assert_allclose(smaller, 0.0, rtol=0, atol=0.1)
    assert np.linalg.norm(found) < np.linalg.norm(BIASES)
    # The block's place is known to the prior, 10 px of half a metre in eight numbers; its height worse.
    assert (refined.datum_sigma[:2] > 1.0).all()
    assert refined.datum_sigma[2] > refined.datum_sigma[:2].max()


def test_cameras_that_agree_are_left_alone() -> None:
    made = ties(np.zeros((3, 2)), noise=0.0)
    refined = made.refined()
    np.testing.assert_allclose(refined.correction, 0.0, rtol=0, atol=1e-6)
    seen = np.isfinite(refined.points[:, 0])
    np.testing.assert_allclose(refined.points[seen], made.points[: len(seen)][seen], rtol=0, atol=1e-4)


def test_wrong_matches_do_not_pull() -> None:
    made = ties(wrong=0.1)
    refined = made.refined()
    np.testing.assert_allclose(disagreement(refined, made), 0.0, rtol=0, atol=0.15)
    truth = np.concatenate([[camera.project(made.points[[index]])[0]] for camera, index in pairs(made)])
    wrong = np.linalg.norm(made.pixel - truth, axis=1) > 5
    used = np.isfinite(refined.residual)
    assert refined.inlier[wrong & used].mean() < 0.2
    assert refined.inlier[~wrong & used].mean() > 0.9


def pairs(made: Ties) -> list[tuple[RpcCamera, int]]:
    return [(made.true[camera], index) for camera, index in zip(made.camera, made.point, strict=True)]


def test_known_ground_fixes_the_shift() -> None:
    made = ties()
    ground = np.full((len(made.points), 3), np.nan)
    ground[:10] = made.points[:10]
    refined = made.refined(ground=ground, ground_sigma=0.05)
    np.testing.assert_allclose(refined.correction[:, [0, 3]], BIASES, rtol=0, atol=0.3)
    assert refined.datum_sigma.max() < 0.2
    error = (refined.correction[:, [0, 3]] - BIASES) / refined.correction_sigma[:, [0, 3]]
    assert np.abs(error).max() < 4


def test_one_picture_can_be_refined_from_known_ground() -> None:
    made = ties(BIASES[:1])
    refined = made.refined(ground=made.points, ground_sigma=0.01)
    np.testing.assert_allclose(refined.correction[0, [0, 3]], BIASES[0], rtol=0, atol=0.1)


def test_affine_corrections_are_found_with_known_ground() -> None:
    rng = np.random.default_rng(1)
    true = rng.normal(0, 1, (4, 6)) * [3, 1, 1, 3, 1, 1]
    made = ties(true)
    refined = made.refined(
        RpcRefinementSettings(sigma_px=NOISE, model="affine"), ground=made.points, ground_sigma=0.01
    )
    error = (refined.correction - true) / refined.correction_sigma
    assert np.abs(error).max() < 4
    # 240 observations of 0.3 px; the points fill two fifths of the picture's width.
    assert refined.correction_sigma.max() < 0.15


def test_the_formal_sigmas_are_those_that_repetition_shows() -> None:
    made = ties(BIASES[:3], count=60, noise=0.0)
    pixel = made.pixel.copy()
    rng = np.random.default_rng(2)
    heights, sigmas = [], []
    for _ in range(20):
        made.pixel = pixel + rng.normal(0, NOISE, pixel.shape)
        refined = made.refined()
        # Heights against each other: their mean is a matter of the prior, and does not scatter.
        heights.append(refined.points[:, 2] - np.nanmean(refined.points[:, 2]))
        sigmas.append(np.sqrt(np.maximum(refined.point_sigma[:, 2] ** 2 - refined.datum_sigma[2] ** 2, 0.0)))
    # 20 repetitions of 60 points tell the ratio to some per cent; Cauchy's weights make formal sigmas larger.
    assert 0.75 < np.nanmedian(np.std(heights, axis=0)) / np.nanmedian(sigmas) < 1.15


def test_points_without_a_say_are_counted_and_left_out() -> None:
    made = ties()
    made.point = np.append(made.point, [300, 301, 301])
    made.camera = np.append(made.camera, [0, 1, 1])
    made.pixel = np.append(made.pixel, [[500.0, 500.0]] * 3, axis=0)
    refined = made.refined()
    alone = int((np.bincount(made.point[:-3]) == 1).sum())
    assert refined.dropped["seen by fewer than two"] == alone + 2
    assert np.isnan(refined.points[300:]).all()
    assert np.isnan(refined.residual[-3:]).all()
    assert not refined.inlier[-3:].any()
    assert set(refined.to_dict()["dropped"]) == {
        "seen by fewer than two",
        "rays too near to parallel",
        "outside the RPCs' heights",
    }


def test_one_wild_height_is_dropped() -> None:
    made = ties()
    made.point = np.append(made.point, [300, 300])
    made.camera = np.append(made.camera, [0, 1])
    high = np.array([[0.0, 0.0, 900.0]])
    wild = [replace(made.true[index], extrapolate=True).project(high)[0] for index in (0, 1)]
    made.pixel = np.append(made.pixel, wild, axis=0)
    assert made.refined().dropped["outside the RPCs' heights"] == 1


def test_pictures_that_do_not_overlap_are_named() -> None:
    made = ties()
    # Points of pictures 0 and 1 are no longer those of 2 and 3.
    made.point = made.point + 300 * (made.camera >= 2)
    with pytest.raises(StageError, match="not linked to the others by tie points.*found picture 2, 3"):
        made.refined()
    none = ties(BIASES[:3])
    seen = none.camera < 2
    none.camera, none.point, none.pixel = none.camera[seen], none.point[seen], none.pixel[seen]
    with pytest.raises(StageError, match="found picture 2"):
        none.refined()
    single = ties(BIASES[:1])
    with pytest.raises(StageError, match="No tie point is seen by two pictures"):
        single.refined()


def test_parallel_rays_and_wrong_heights_are_an_error() -> None:
    made = ties(BIASES[:2])
    same = replace(made, cameras=[made.cameras[0]] * 2)
    same.pixel = made.true[0].project(made.points)[made.point]
    with pytest.raises(StageError, match="Fewer than half of the tie points meet.* rays too near to parallel"):
        same.refined()
    above = made.cameras[0].rpc
    cameras = [replace(item, rpc=replace(item.rpc, height_offset=5000.0)) for item in made.cameras]
    assert above.height_range[1] < 4000
    shifted = replace(made, cameras=[cameras[0], made.cameras[1]])
    with pytest.raises(StageError, match=r"outside the RPCs' heights, median height about .* m"):
        shifted.refined()


def test_disagreeing_pictures_are_an_error() -> None:
    made = ties()
    made.pixel[made.camera == 3] = np.random.default_rng(5).uniform(0, SIDE, (int((made.camera == 3).sum()), 2))
    with pytest.raises(StageError, match=r"Picture 3 has too few tie points.*at least 40 within 2\.0 px; found"):
        made.refined(RpcRefinementSettings(sigma_px=NOISE, min_inliers=40))


def test_a_search_that_does_not_settle_says_so() -> None:
    with pytest.raises(StageError, match="does not settle.*within 1 steps; found a last step of .*max_iterations"):
        ties().refined(RpcRefinementSettings(sigma_px=NOISE, max_iterations=1))


def test_arrays_that_do_not_fit_are_refused() -> None:
    made = ties()
    with pytest.raises(DataError, match=r"do not fit together; expected camera \(M,\), point \(M,\)"):
        refine_rpcs(made.cameras, made.camera[:-1], made.point, made.pixel)
    with pytest.raises(DataError, match="expected cameras from 0 to 1 and points from 0; found cameras 0 to 3"):
        refine_rpcs(made.cameras[:2], made.camera, made.point, made.pixel)
    with pytest.raises(DataError, match="Tie points' pixels are not finite"):
        refine_rpcs(made.cameras, made.camera, made.point, made.pixel * np.nan)
    with pytest.raises(DataError, match="No tie points"):
        refine_rpcs(made.cameras, [], [], np.zeros((0, 2)))
    elsewhere = replace(made.cameras[0], origin=(43.3, 5.4, 0.0))
    with pytest.raises(DataError, match=r"different origins; expected \(43\.3, 5\.4, 0\.0\) for all"):
        refine_rpcs([elsewhere, *made.cameras[1:]], made.camera, made.point, made.pixel)
    with pytest.raises(DataError, match=r"Known places do not fit the points; expected \(300, 3\); found \(5, 3\)"):
        made.refined(ground=np.zeros((5, 3)))
    with pytest.raises(DataError, match="need a standard deviation; expected metres above zero; found 0"):
        made.refined(ground=made.points, ground_sigma=0)
    with pytest.raises(SettingsError, match="model"):
        RpcRefinementSettings(model="cubic")
