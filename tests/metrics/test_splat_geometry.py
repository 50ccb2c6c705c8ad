"""Distances to a cloud, displacement, bias and spread of depth."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.errors import DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.metrics.splat_geometry import (
    cloud_distances,
    depth_bias,
    displacements,
    distance_summary,
    ray_errors,
)

CAMERA = ColmapCamera.pinhole(40, 30, 35.0)


def test_distances_are_those_to_the_nearest_point() -> None:
    generator = np.random.default_rng(0)
    points, cloud = generator.normal(size=(60, 3)), generator.normal(size=(80, 3))
    found = cloud_distances(points, cloud)
    np.testing.assert_allclose(found, np.linalg.norm(points[:, None] - cloud[None], axis=2).min(axis=1))
    summary = distance_summary(found)
    assert summary["points"] == 60
    assert summary["median"] == np.median(found)
    assert summary["p90"] == np.percentile(found, 90)


def test_what_cannot_be_measured_is_told() -> None:
    points = np.zeros((2, 3))
    with pytest.raises(DataError, match="the cloud is empty"):
        cloud_distances(points, np.zeros((0, 3)))
    with pytest.raises(DataError, match=r"the points are no places; .*found shape \(2, 3\), 1 numbers not finite"):
        cloud_distances(np.array([[0, 0, np.nan], [0, 0, 0]]), points)
    with pytest.raises(DataError, match=r"the cloud are no places; .*found shape \(3,\)"):
        cloud_distances(points, np.zeros(3))
    with pytest.raises(StageError, match="nothing to summarise"):
        distance_summary(np.zeros(0))


def test_displacement_is_told_apart_by_direction_and_opacity() -> None:
    origins = np.zeros((4, 3))
    centres = np.array([[3.0, 4.0, 0.0], [0, 0, -2.0], [0, 0, 1.0], [30.0, 40.0, 0.0]])
    moved = displacements(origins, centres, np.array([0.9, 0.6, 0.8, 0.1]))
    np.testing.assert_allclose(moved.horizontal, [5, 0, 0, 50])
    np.testing.assert_allclose(moved.vertical, [0, -2, 1, 0])
    told = moved.to_dict()
    assert told["all"]["gaussians"] == 4
    assert told["opaque"]["gaussians"] == 3
    assert told["all"]["horizontal"]["median"] == 2.5
    assert told["opaque"]["horizontal"]["median"] == 0
    # Lengths: up and down do not cancel.
    assert told["opaque"]["vertical"]["median"] == 1
    assert "opaque" not in displacements(origins, centres, np.full(4, 0.2)).to_dict()
    with pytest.raises(DataError, match="do not fit together"):
        displacements(origins, centres, np.ones(3))


def test_errors_are_along_the_ray() -> None:
    truth = np.full((30, 40), 10.0)
    found = truth + 0.5
    found[3, 4], truth[5, 6], found[7, 8] = 0.0, 0.0, np.nan
    errors = ray_errors(found, truth, CAMERA)
    assert np.isnan([errors[3, 4], errors[5, 6], errors[7, 8]]).all()
    assert np.isfinite(errors).sum() == 1200 - 3
    # In the middle the ray is the axis; in the corner it is longer by the root of 1 + x^2 + y^2.
    assert errors[15, 20] == pytest.approx(0.5, rel=1e-3)
    assert errors[0, 0] == pytest.approx(0.5 * np.sqrt(1 + (19.5 / 35) ** 2 + (14.5 / 35) ** 2))
    with pytest.raises(DataError, match=r"expected \(30, 40\); found \(30, 40\) and \(3, 4\)"):
        ray_errors(found, np.ones((3, 4)), CAMERA)


def test_bias_and_spread_are_those_of_most_pixels() -> None:
    errors = 0.3 + 0.1 * np.random.default_rng(0).standard_normal((200, 100))
    errors[:5] = 50.0  # a chimney that is not there
    errors[5:7] = np.nan
    found = depth_bias(errors)
    # 3 % of outliers shift the median by 0.04 sigma and widen the spread by 5 %.
    assert found.bias == pytest.approx(0.3, abs=0.01)
    assert found.spread == pytest.approx(0.1, rel=0.08)
    assert found.std > 5
    assert found.pixels == 19_800
    assert found.within == pytest.approx(np.mean(np.abs(errors[7:]) <= 0.2) * 19300 / 19800, abs=1e-9)
    assert found.to_dict()["bias"] == found.bias
    with pytest.raises(StageError, match="Depth cannot be compared"):
        depth_bias(np.full(3, np.nan))
