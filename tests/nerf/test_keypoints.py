"""Depth of sparse points: rays, their spread, and the divergence that is learned."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from toolkit.errors import StageError
from toolkit.nerf.keypoints import depth_loss, extra_edges, keypoint_rays
from toolkit.nerf.volume import ray_weights
from toolkit.scene import Points, Scene, Tracks


def kept_points(scene: Scene) -> np.ndarray:
    """Return the points of all observations in training frames, of points that two of these saw."""
    tracks = scene.points.tracks if scene.points is not None else None
    assert tracks is not None
    point = tracks.point[tracks.frame != 2]
    return point[np.bincount(point)[point] >= 2]


def test_rays_end_at_the_points_and_only_training_frames_count(plane: Scene) -> None:
    rays = keypoint_rays(plane, 1.0)
    assert len(rays) == len(kept_points(plane))
    ends = rays.origins + rays.distances[:, None] * rays.directions
    assert float(ends[:, 2].abs().max()) < 1e-5
    # Exact points: all weigh the same, and the least error of a pixel makes their spread.
    torch.testing.assert_close(rays.weights, rays.weights[:1].expand(len(rays)), rtol=1e-2, atol=0)
    finer = keypoint_rays(plane, 0.5)
    torch.testing.assert_close(finer.sigmas, rays.sigmas / 2)


def test_a_point_with_a_large_reprojection_error_weighs_less_and_spreads_wider(plane: Scene) -> None:
    points = plane.points
    assert points is not None
    assert points.tracks is not None
    pixel = points.tracks.pixel + np.random.default_rng(0).normal(0, 0.3, points.tracks.pixel.shape)
    chosen = np.bincount(kept_points(plane)).argmax()
    bad = points.tracks.point == chosen
    pixel[bad] += np.where(points.tracks.frame[bad] % 2, 4.0, -4.0)[:, None]
    moved = Points(points.xyz, points.rgb, tracks=Tracks(points.tracks.point, points.tracks.frame, pixel))
    rays = keypoint_rays(plane.replace(points=moved), 0.1)
    rows = kept_points(plane) == chosen
    assert float(rays.weights[rows].max()) < 1e-3
    assert float(rays.weights[~rows].median()) > 0.3
    assert float(rays.sigmas[rows].median()) > 5 * float(rays.sigmas[~rows].median())


def test_the_loss_is_least_where_the_ray_ends_as_the_gaussian_says() -> None:
    edges = torch.linspace(0, 4, 401, dtype=torch.float64)[None]
    middle = (edges[:, 1:] + edges[:, :-1]) / 2
    distance, sigma = torch.tensor([2.0], dtype=torch.float64), torch.tensor([0.1], dtype=torch.float64)

    def gaussian(at: float, width: float) -> torch.Tensor:
        share = torch.exp(-0.5 * ((middle - at) / width) ** 2)
        return share / share.sum()

    best = depth_loss(gaussian(2.0, 0.1), edges, distance, sigma)
    # Its own entropy: ln(sigma sqrt(2 pi e)) - ln(length of an interval).
    assert float(best) == pytest.approx(np.log(0.1 * np.sqrt(2 * np.pi * np.e)) - np.log(0.01), abs=1e-3)
    # The divergence of two Gaussians apart by two sigma is 2.
    assert float(depth_loss(gaussian(2.2, 0.1), edges, distance, sigma) - best) == pytest.approx(2.0, abs=1e-2)
    assert depth_loss(gaussian(2.0, 0.2), edges, distance, sigma) > best
    assert depth_loss(gaussian(2.0, 0.05), edges, distance, sigma) > best


def test_the_gradient_is_right_and_thins_what_lies_before_the_point() -> None:
    edges = torch.linspace(0, 4, 13, dtype=torch.float64)[None]
    distance, sigma = torch.tensor([2.5], dtype=torch.float64), torch.tensor([0.3], dtype=torch.float64)
    density = torch.full((1, 12), 0.5, dtype=torch.float64, requires_grad=True)

    def loss(values: torch.Tensor) -> torch.Tensor:
        return depth_loss(ray_weights(values, edges.diff(dim=1)), edges, distance, sigma).sum()

    assert torch.autograd.gradcheck(loss, density)
    loss(density).backward()
    assert density.grad is not None
    assert bool((density.grad[0, :6] > 0).all())  # less density before
    assert bool((density.grad[0, 7:8] < 0).all())  # more at the point


def test_extra_edges_lie_around_the_depth() -> None:
    edges = extra_edges(torch.tensor([2.0, 5.0]), torch.tensor([0.1, 1.0]), count=5, reach=2.0)
    torch.testing.assert_close(edges, torch.tensor([[1.8, 1.9, 2.0, 2.1, 2.2], [3.0, 4.0, 5.0, 6.0, 7.0]]))


def test_what_is_missing_is_said(make_plane: Callable[..., Scene]) -> None:
    scene = make_plane()
    assert scene.points is not None
    with pytest.raises(StageError, match="found no sparse points"):
        keypoint_rays(scene.replace(points=None), 1.0)
    with pytest.raises(StageError, match="150 points without tracks"):
        keypoint_rays(scene.replace(points=Points(scene.points.xyz, scene.points.rgb)), 1.0)
    tracks = scene.points.tracks
    assert tracks is not None
    once = Tracks(tracks.point[tracks.frame == 0], tracks.frame[tracks.frame == 0], tracks.pixel[tracks.frame == 0])
    with pytest.raises(StageError, match="none of them seen twice"):
        keypoint_rays(scene.replace(points=Points(scene.points.xyz, scene.points.rgb, tracks=once)), 1.0)


def test_as_the_paper_writes_it_an_uncertain_point_weighs_more() -> None:
    edges = torch.linspace(0, 4, 4001, dtype=torch.float64)[None].repeat(2, 1)
    weights = torch.full((2, 4000), 1 / 4000, dtype=torch.float64)
    distance, sigma = torch.tensor([2.0, 2.0]).double(), torch.tensor([0.1, 0.2]).double()
    plain = depth_loss(weights, edges, distance, sigma)
    written = depth_loss(weights, edges, distance, sigma, unit=0.5)
    # The integral of the Gaussian is sigma sqrt(2 pi), measured in units of 0.5; the sum has a thousand steps.
    integral = sigma * (2 * torch.pi) ** 0.5 / 0.5
    torch.testing.assert_close(written, plain * integral, rtol=1e-6, atol=0)
    assert written[1] == pytest.approx(2 * float(written[0]), rel=1e-6)
