"""A dense cloud thinned to a number of points."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.depth.thin_cloud import thin_cloud
from toolkit.errors import DataError
from toolkit.geometry.surface import Cloud

AWAY = np.array([4096.0, -1024.0, 512.0])


def ground(count: int = 20_000, seed: int = 0) -> Cloud:
    """A plane of 100 by 60 m with noise of 0.1 m in height, red in the west and blue in the east."""
    generator = np.random.default_rng(seed)
    xyz = generator.uniform([0, 0, 0], [100, 60, 0], size=(count, 3))
    xyz[:, 2] = 0.1 * generator.standard_normal(count)
    rgb = np.where(xyz[:, :1] < 50, [255, 0, 0], [0, 0, 255]).astype(np.uint8)
    normals = np.tile([0.0, 0.0, 1.0], (count, 1))
    return Cloud(xyz, rgb, normals)


@pytest.mark.parametrize("most", [5000, 500, 20, 1])
def test_nearly_as_many_are_left_as_may_be(most: int) -> None:
    found = thin_cloud(ground(), most)
    assert len(found.cloud) <= most
    # A grid's count jumps where few cubes are left.
    assert len(found.cloud) >= 0.5 * most
    if most >= 500:
        assert len(found.cloud) >= 0.95 * most
    assert found.before == 20_000
    assert found.voxel > 0


def test_they_cover_the_same_place_with_less_noise() -> None:
    cloud = ground()
    found = thin_cloud(cloud, 1000).cloud
    assert np.all(found.xyz.min(axis=0) >= cloud.xyz.min(axis=0))
    assert np.all(found.xyz.max(axis=0) <= cloud.xyz.max(axis=0))
    np.testing.assert_allclose(np.ptp(found.xyz, axis=0)[:2], [100, 60], atol=4.0)
    # The mean of about twenty points each.
    assert found.xyz[:, 2].std() < 0.05
    assert found.rgb is not None
    west, east = found.xyz[:, 0] < 45, found.xyz[:, 0] > 55
    assert np.all(found.rgb[west] == [255, 0, 0])
    assert np.all(found.rgb[east] == [0, 0, 255])


def test_it_repeats_and_does_not_depend_on_where_the_world_begins() -> None:
    cloud = ground()
    one, two = thin_cloud(cloud, 700), thin_cloud(cloud, 700)
    np.testing.assert_array_equal(one.cloud.xyz, two.cloud.xyz)
    away = thin_cloud(Cloud(cloud.xyz + AWAY, cloud.rgb), 700)
    np.testing.assert_allclose(away.cloud.xyz - AWAY, one.cloud.xyz, atol=1e-8)


def test_a_small_cloud_stays_as_it_is() -> None:
    cloud = ground(50)
    found = thin_cloud(cloud, 50)
    np.testing.assert_array_equal(found.cloud.xyz, cloud.xyz)
    assert found.voxel == 0


def test_points_at_one_place_become_one() -> None:
    found = thin_cloud(Cloud(np.ones((10, 3))), 3)
    np.testing.assert_array_equal(found.cloud.xyz, np.ones((1, 3)))


def test_points_in_clumps_far_apart_are_kept_apart() -> None:
    generator = np.random.default_rng(0)
    clumps = np.concatenate([generator.normal(0, 1e-3, (500, 3)) + centre for centre in (0.0, 1000.0)])
    found = thin_cloud(Cloud(clumps), 100)
    assert 50 <= len(found.cloud) <= 100


@pytest.mark.parametrize(("count", "most"), [(10, 0), (0, 5)])
def test_nothing_cannot_be_thinned(count: int, most: int) -> None:
    with pytest.raises(DataError, match=f"cannot be thinned; .* found {count}, {most}"):
        thin_cloud(Cloud(np.zeros((count, 3))), most)
