"""Straight edges through a known lens: found in pictures, and the lens found from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from arc_matches import FISHEYE, HEIGHT, WIDTH, arc_scene
from numpy.typing import NDArray

from toolkit.errors import DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.poses.adjust import adjust
from toolkit.poses.blade_edges import EdgeSettings, edge_residuals, find_edges, straighten
from toolkit.poses.edge_adjust import adjust_with_edges
from toolkit.scene import scene_from_pycolmap, scene_to_pycolmap

PLAIN = ColmapCamera("OPENCV_FISHEYE", WIDTH, HEIGHT, (240.0, 240.0, 240.0, 180.0, 0.0, 0.0, 0.0, 0.0))


def true_edges(camera: ColmapCamera, *, noise: float, seed: int = 0) -> list[NDArray[np.float64]]:
    """Return 40 straight edges before a camera as it sees them, a point about every pixel."""
    rng = np.random.default_rng(seed)
    edges = []
    while len(edges) < 40:
        ends = np.column_stack([rng.uniform(-2.5, 2.5, (2, 2)), np.ones(2)])
        line = ends[0] + np.linspace(0, 1, 150)[:, None] * (ends[1] - ends[0])
        seen = camera.project(line)
        seen = seen[np.isfinite(seen).all(axis=1) & ((seen > 0) & (seen < (WIDTH, HEIGHT))).all(axis=1)]
        if len(seen) >= 60:
            edges.append(seen + noise * rng.normal(size=seen.shape))
    return edges


def angles(camera: pycolmap.Camera, radii: NDArray[np.float64]) -> NDArray[np.float64]:
    plane = np.asarray(camera.cam_from_img(np.column_stack([240.0 + radii, np.full(len(radii), 180.0)])))
    return np.degrees(np.arctan(np.linalg.norm(plane, axis=1)))


def test_through_the_true_lens_edges_are_straight() -> None:
    edges = true_edges(FISHEYE, noise=0.3)
    off = edge_residuals(FISHEYE.to_pycolmap(), edges)
    # The distance from a line has the noise of one coordinate; thousands of points tell it to some percent.
    assert np.std(off) == pytest.approx(0.3, rel=0.05)
    assert np.std(edge_residuals(PLAIN.to_pycolmap(), edges)) > 1.0


def test_the_lens_is_found_from_edges_alone() -> None:
    found = straighten(true_edges(FISHEYE, noise=0.3), PLAIN)
    assert found.converged
    assert found.edges == 40
    assert found.after == pytest.approx(0.3, rel=0.1)
    assert found.before > 2 * found.after
    radii = np.linspace(10, 230, 12)
    # Within a twentieth of a degree of the rays, at a picture scale of four pixels a degree.
    np.testing.assert_allclose(
        angles(found.camera.to_pycolmap(), radii), angles(FISHEYE.to_pycolmap(), radii), atol=0.2
    )
    assert found.sigma is not None
    off = np.abs(np.array(found.camera.params[4:]) - FISHEYE.params[4:]) / found.sigma
    # Four parameters within four of their standard deviations.
    assert off.max() < 4.0
    assert found.to_dict()["parameters"] == [4, 5, 6, 7]


def test_with_a_wrong_focal_length_the_view_is_stretched_and_still_straight() -> None:
    """All tangents by one factor, that of the focal lengths: what straight lines cannot tell."""
    wrong = ColmapCamera("OPENCV_FISHEYE", WIDTH, HEIGHT, (260.0, 260.0, 240.0, 180.0, 0.0, 0.0, 0.0, 0.0))
    found = straighten(true_edges(FISHEYE, noise=0.1), wrong)
    radii = np.linspace(20, 200, 10)
    here, true = (np.tan(np.radians(angles(lens.to_pycolmap(), radii))) for lens in (found.camera, FISHEYE))
    # Four coefficients follow the stretched view to half a percent.
    np.testing.assert_allclose(here / true, 240.0 / 260.0, rtol=0.01)


def test_a_tenth_of_crooked_edges_does_little_harm() -> None:
    edges = true_edges(FISHEYE, noise=0.3)
    for edge in edges[:4]:
        along = np.linspace(-1, 1, len(edge))
        edge[:, 1] += 6.0 * (1 - along**2)
    found = straighten(edges, PLAIN)
    assert 36 <= found.edges < 40
    radii = np.linspace(10, 230, 12)
    np.testing.assert_allclose(
        angles(found.camera.to_pycolmap(), radii), angles(FISHEYE.to_pycolmap(), radii), atol=0.5
    )


def test_edges_are_found_in_a_picture_to_a_tenth_of_a_pixel() -> None:
    """Bright half-planes behind the lens: each border is one straight edge."""
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    _, rays = FISHEYE.ray(np.column_stack([column.ravel(), row.ravel()]))
    normals = np.array([[1.0, 0.15, -0.5], [1.0, -0.1, 0.45], [0.1, 1.0, 0.4]])
    step = np.sum(np.nan_to_num(rays) @ normals.T > 0, axis=1).reshape(HEIGHT, WIDTH)
    picture = (60 + 50 * step).astype(np.uint8)
    edges = find_edges(picture, EdgeSettings())
    assert len(edges) >= 3
    for edge in edges:
        ray = FISHEYE.ray(edge)[1]
        nearest = normals[
            np.argmin(np.abs(ray @ (normals / np.linalg.norm(normals, axis=1)[:, None]).T).mean(axis=0))
        ]
        off = np.degrees(np.arcsin(ray @ nearest / np.linalg.norm(nearest)))
        # Hard steps of whole pixels wobble by half a pixel, 0.15 degrees; their mean is nearer.
        assert abs(np.mean(off)) < 0.05
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:, :240] = False
    assert all(
        (edge[:, 0] > 238).all()
        for edge in find_edges(np.repeat(picture[:, :, None], 3, 2), EdgeSettings(), mask=mask)
    )
    upright = find_edges(picture, EdgeSettings(direction=90.0, spread=45.0))
    assert 2 <= len(upright) < len(edges)
    assert all(abs(edge[-1, 1] - edge[0, 1]) > abs(edge[-1, 0] - edge[0, 0]) for edge in upright)
    found = straighten(edges, PLAIN)
    assert found.after < found.before


def test_what_cannot_be_is_told() -> None:
    with pytest.raises(StageError, match="SIMPLE_PINHOLE and 40 edges"):
        straighten(true_edges(FISHEYE, noise=0.0), ColmapCamera("SIMPLE_PINHOLE", WIDTH, HEIGHT, (240, 240, 180)))
    with pytest.raises(StageError, match="0 edges"):
        straighten([np.zeros((3, 2))], PLAIN)
    with pytest.raises(DataError, match=r"found \(4, 4\) and \(3, 3\)"):
        find_edges(np.zeros((4, 4), np.uint8), EdgeSettings(), mask=np.ones((3, 3), bool))


def test_edges_hold_the_lens_where_a_short_arc_does_not(tmp_path: Path) -> None:
    """Arc and lens by points alone, and by points and edges: nearer to the truth, and the sigma says so."""
    truth = arc_scene(tmp_path, FISHEYE, frames=8, arc=25.0, points=250, noise=0.5)
    model = scene_to_pycolmap(truth)
    adjust(
        model,
        refine_focal=True,
        refine_distortion=True,
        refine_principal_point=False,
        max_error=1e9,
        min_angle=0.0,
    )
    fitted = scene_from_pycolmap(model, tmp_path, like=truth)
    found = adjust_with_edges(fitted, true_edges(FISHEYE, noise=0.3), pixels_a_sample=1.0)
    radii = np.linspace(20, 200, 10)
    lenses = [scene.cameras[1] for scene in (fitted, found.scene)]
    before, after = (
        np.abs(angles(lens.to_pycolmap(), radii) - angles(FISHEYE.to_pycolmap(), radii)).max()
        for lens in lenses
        if isinstance(lens, ColmapCamera)
    )
    assert after < before
    assert found.before.sigma is not None
    assert found.after.sigma is not None
    assert found.after.sigma_fixed is not None
    # Never better than with a lens that is known exactly.
    assert found.after.sigma_fixed * 0.99 < found.after.sigma < found.before.sigma
    assert abs(found.after.arc_degrees - 25.0) < 3.5 * found.after.sigma
    # 40 edges of 100 pixels know their noise to some percent.
    assert found.spread_after == pytest.approx(0.3, rel=0.1)
    assert found.to_dict()["edges"] == 40
    with pytest.raises(StageError, match="1 cameras and 0 edges"):
        adjust_with_edges(fitted, [])
