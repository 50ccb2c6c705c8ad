"""Scale and shift of a prediction: found among outliers, refused with a reason where they cannot be known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from toolkit.depth.fit import depth_pairs, fit_depth, fit_scale_shift
from toolkit.depth.ground_depth import plane_depth
from toolkit.depth.monocular import DepthKind, DepthPrediction
from toolkit.depth.settings import DepthSettings, FitSettings
from toolkit.errors import DataError
from toolkit.scene import Points, Scene, Tracks

Array = NDArray[np.float64]
GROUND = DepthSettings.from_dict({"ground": {"ground_height": 5.0}})


def with_outliers(depths: Array, rng: np.random.Generator, share: float = 0.3) -> Array:
    """Return depths of which a share are those of something else, from half to twice as deep."""
    wrong = depths.copy()
    bad = rng.permutation(len(depths))[: round(share * len(depths))]
    wrong[bad] *= rng.choice([0.5, 0.6, 1.6, 2.0], len(bad))
    return wrong


@pytest.mark.parametrize("inverse", [True, False])
@pytest.mark.parametrize("with_shift", [True, False])
def test_scale_and_shift_are_found_among_thirty_percent_of_outliers(inverse: bool, with_shift: bool) -> None:
    rng = np.random.default_rng(3)
    depths = rng.uniform(20, 120, 400)
    scale, shift = (2e-4, -3e-3) if inverse else (0.4, 7.0)
    shift = shift if with_shift else 0.0
    values = ((1 / depths if inverse else depths) - shift) / scale
    found = fit_scale_shift(values, with_outliers(depths, rng), inverse, with_shift, FitSettings(), seed=1)
    assert not isinstance(found, str), found
    # Without noise the last rounds keep exact pairs only, so that nothing but rounding is left.
    assert found[0] == pytest.approx(scale, rel=1e-6)
    assert found[1] == pytest.approx(shift, rel=1e-6, abs=1e-12)
    assert found[2] < 1e-6
    assert found[3] == 280


def test_noise_costs_little_and_shows_in_the_residual() -> None:
    rng = np.random.default_rng(5)
    depths = rng.uniform(20, 120, 500)
    noisy = with_outliers(depths * (1 + 0.02 * rng.standard_normal(500)), rng)
    found = fit_scale_shift((1 / depths + 0.01) / 3e-4, noisy, True, True, FitSettings(), seed=1)
    assert not isinstance(found, str), found
    # 2 % of noise in 350 pairs: 0.1 % on the mean, a few times that on the slope.
    assert found[0] == pytest.approx(3e-4, rel=0.02)
    assert 0.008 < found[2] < 0.025
    assert found[3] == pytest.approx(350, abs=15)


def test_the_same_seed_gives_the_same_fit() -> None:
    rng = np.random.default_rng(7)
    depths = rng.uniform(20, 120, 6000)
    values, noisy = 1 / depths, with_outliers(depths, rng)
    assert fit_scale_shift(values, noisy, True, True, FitSettings(), seed=4) == fit_scale_shift(
        values, noisy, True, True, FitSettings(), seed=4
    )


def test_what_cannot_be_fitted_says_why() -> None:
    rng = np.random.default_rng(0)
    depths = rng.uniform(20, 120, 100)
    settings = FitSettings()
    assert fit_scale_shift(depths[:5], depths[:5], False, True, settings) == (
        "only 5 points of the scene lie in the picture, 12 are needed"
    )
    assert "all alike" in str(fit_scale_shift(np.ones(100), depths, False, True, settings))
    assert "no positive scale" in str(fit_scale_shift(-depths, depths, False, False, settings))
    tight = FitSettings(tolerance=0.5, min_share=80.0)
    random = fit_scale_shift(rng.uniform(0, 1, 100), depths, False, True, tight)
    assert "of 100 points agree within 0.5 %, 80 are needed" in str(random)


def plane_points(scene: Scene, name: str, tracks: bool) -> Points:
    """Return points of the plane z = 5 that the frame sees, and as many hidden far below it."""
    frame = scene.frame(name)
    depth = plane_depth(scene, frame, 5.0, 300.0)
    rows, columns = (index[::5] for index in np.nonzero(np.isfinite(depth)))
    pixels = np.stack([columns, rows], axis=1) + 0.5
    _, directions = scene.camera_of(frame).ray(pixels)
    assert frame.cam_from_world is not None
    seen = frame.cam_from_world.inverse().apply(directions / directions[:, 2:] * depth[rows, columns][:, None])
    hidden = frame.cam_from_world.centre + 3 * (seen - frame.cam_from_world.centre)
    count = len(seen)
    observed = None
    if tracks:
        index = [other.name for other in scene.frames].index(name)
        observed = Tracks(np.arange(count), np.full(count, index), pixels)
    return Points(np.concatenate([seen, hidden]), np.zeros((2 * count, 3), np.uint8), tracks=observed)


def prediction_of(depth: Array, kind: DepthKind) -> DepthPrediction:
    """Return what a network of this kind says: right up to an affine map where it may be."""
    values = {"metric": depth / 1.7, "affine-depth": depth / 9 - 2, "affine-disparity": 40 / depth - 0.3}[kind]
    return DepthPrediction(values.astype(np.float32), kind)


@pytest.mark.parametrize("kind", ["metric", "affine-depth", "affine-disparity"])
def test_points_of_the_scene_give_the_depth(flat_scene: Callable[..., Scene], kind: DepthKind) -> None:
    empty = flat_scene()
    scene = flat_scene(plane_points(empty, "oblique.png", tracks=True))
    frame = scene.frame("oblique.png")
    truth = plane_depth(scene, frame, 5.0, 300.0)
    fit = fit_depth(scene, frame, prediction_of(truth, kind), DepthSettings())
    assert fit
    assert fit.rule == "points"
    assert fit.used == fit.pairs > 50
    assert fit.depth is not None
    # Single precision of the prediction, 6e-8, and its cancellation against the shift.
    np.testing.assert_allclose(fit.depth, truth, rtol=1e-4)
    assert np.isnan(fit.depth[np.isnan(truth)]).all()


def test_only_points_that_the_frame_saw_count_where_tracks_say_so(flat_scene: Callable[..., Scene]) -> None:
    empty = flat_scene()
    frame = empty.frame("oblique.png")
    truth = plane_depth(empty, frame, 5.0, 300.0)
    prediction = prediction_of(truth, "metric")
    with_tracks = depth_pairs(flat_scene(plane_points(empty, frame.name, tracks=True)), frame, prediction)
    without = depth_pairs(flat_scene(plane_points(empty, frame.name, tracks=False)), frame, prediction)
    assert 2 * len(with_tracks[0]) == len(without[0])
    np.testing.assert_allclose(with_tracks[0] * 1.7, with_tracks[1], rtol=1e-6)


def test_too_few_points_give_no_depth_but_a_reason(flat_scene: Callable[..., Scene]) -> None:
    scene = flat_scene(Points(np.array([[20.0, 0, 5]]), np.zeros((1, 3), np.uint8)))
    frame = scene.frame("nadir.png")
    fit = fit_depth(scene, frame, DepthPrediction(np.ones((30, 40), np.float32), "affine-depth"), GROUND)
    assert not fit
    assert fit.to_dict() == {
        "rule": "none",
        "scale": None,
        "shift": None,
        "residual": None,
        "pairs": 1,
        "used": 0,
        "reason": "only 1 points of the scene lie in the picture, 12 are needed",
    }


def test_metric_depth_is_kept_without_points_or_when_asked(flat_scene: Callable[..., Scene]) -> None:
    scene = flat_scene()
    frame = scene.frame("nadir.png")
    prediction = DepthPrediction(np.full((30, 40), 31.0, np.float32), "metric")
    kept = fit_depth(scene, frame, prediction, DepthSettings())
    assert (kept.rule, kept.scale, kept.shift) == ("metric kept", 1.0, 0.0)
    assert "no points; metres are taken for scene units" in kept.reason
    posed = flat_scene(plane_points(scene, "nadir.png", tracks=True))
    asked = fit_depth(posed, frame, prediction, DepthSettings.from_dict({"fit": {"fit_metric": False}}))
    assert asked.rule == "metric kept"
    assert "as asked" in asked.reason
    fitted = fit_depth(posed, frame, prediction, DepthSettings())
    assert fitted.scale == pytest.approx(2.0)


@pytest.mark.parametrize("kind", ["affine-depth", "affine-disparity"])
def test_without_points_the_median_is_that_of_the_ground(flat_scene: Callable[..., Scene], kind: DepthKind) -> None:
    scene = flat_scene()
    frame = scene.frame("oblique.png")
    truth = plane_depth(scene, frame, 5.0, 1000.0)
    values = np.where(np.isfinite(truth), 8 / truth if kind == "affine-disparity" else truth / 8, np.nan)
    fit = fit_depth(scene, frame, DepthPrediction(values.astype(np.float32), kind), GROUND)
    assert fit.rule == "ground distance"
    assert "the median distance is set to that of the ground" in fit.reason
    assert fit.depth is not None
    assert np.nanmedian(fit.depth) == pytest.approx(np.nanmedian(truth), rel=1e-3)


def test_without_points_and_ground_there_is_a_reason(flat_scene: Callable[..., Scene]) -> None:
    prediction = DepthPrediction(np.ones((30, 40), np.float32), "affine-disparity")
    lost = flat_scene(georeference=None)
    assert "nothing says which way is up" in fit_depth(lost, lost.frames[0], prediction, GROUND).reason
    scene = flat_scene()
    near = DepthSettings.from_dict({"ground": {"ground_height": 5.0, "max_distance": 1.0}})
    assert "nowhere in view" in fit_depth(scene, scene.frames[0], prediction, near).reason


def test_a_prediction_is_an_image() -> None:
    with pytest.raises(DataError, match=r"no image; expected \(H, W\), both alike; found \(3,\)"):
        DepthPrediction(np.ones(3, np.float32), "metric")
    with pytest.raises(DataError, match=r"with a confidence \(2, 3\)"):
        DepthPrediction(np.ones((3, 2), np.float32), "metric", np.ones((2, 3), np.float32))
