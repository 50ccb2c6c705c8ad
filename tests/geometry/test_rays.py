"""Points nearest to rays: exact ones, weights, and what leaves a point open."""

from __future__ import annotations

import numpy as np

from toolkit.geometry.rays import nearest_points, ray_equations


def rays_to(points: np.ndarray, rays: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    group = np.repeat(np.arange(len(points)), rays)
    origins = rng.normal(size=(len(group), 3)) * 5
    directions = points[group] - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True), group


def test_rays_that_meet_give_their_point_in_any_order() -> None:
    points = np.random.default_rng(0).normal(size=(7, 3))
    origins, directions, group = rays_to(points, 3)
    mixed = np.random.default_rng(2).permutation(len(group))
    found = nearest_points(origins[mixed], directions[mixed], group[mixed], 8)
    np.testing.assert_allclose(found[:7], points, atol=1e-9)
    assert np.isnan(found[7]).all()


def test_a_point_is_in_the_middle_and_follows_the_weights() -> None:
    origins = np.array([[0.0, 0, 0], [0, 0, 1]])
    directions = np.array([[1.0, 0, 0], [0, 1, 0]])
    group = np.zeros(2, dtype=np.int64)
    np.testing.assert_allclose(nearest_points(origins, directions, group, 1), [[0, 0, 0.5]], atol=1e-12)
    weighted = nearest_points(origins, directions, group, 1, np.array([3.0, 1.0]))
    np.testing.assert_allclose(weighted, [[0, 0, 0.25]], atol=1e-12)


def test_one_ray_and_parallel_rays_leave_a_point_open() -> None:
    directions = np.array([[0.0, 0.6, 0.8]] * 3)
    group = np.array([0, 1, 1])
    assert np.isnan(nearest_points(np.eye(3), directions, group, 2)).all()


def test_the_equations_are_those_of_squared_distances() -> None:
    origins, directions, group = rays_to(np.zeros((1, 3)), 4)
    origins += 0.3
    normal, target = ray_equations(origins, directions, group, 1)
    x = np.array([0.2, -1.0, 0.7])
    squares = np.sum(np.cross(x - origins, directions) ** 2)
    constant = np.sum(np.cross(origins, directions) ** 2)
    np.testing.assert_allclose(x @ normal[0] @ x - 2 * x @ target[0] + constant, squares)
