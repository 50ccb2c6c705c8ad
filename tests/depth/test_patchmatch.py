"""PatchMatch stereo: the compiled cost and its readable twin, surfaces that are known, seeds and masks."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from toolkit.depth.patchmatch import PlaneMaps, StereoView, pack_views, patch_match, pinhole_of
from toolkit.depth.patchmatch_kernels import cost_planes
from toolkit.depth.plane_cost import slow_plane_cost
from toolkit.depth.stereo_settings import PatchMatchSettings
from toolkit.depth.stereo_views import load_stereo_view
from toolkit.errors import DataError
from toolkit.geometry.compiled import launching

SETTINGS = PatchMatchSettings(radius=3, iterations=3)
RANGE = (1.8, 5.0)


def views_of(plane: Any) -> tuple[StereoView, list[StereoView]]:
    views = [load_stereo_view(plane.scene, frame.name) for frame in plane.scene.frames]
    return views[0], views[1:]


@pytest.fixture(scope="module")
def found(slanted: Any) -> PlaneMaps:
    return patch_match(*views_of(slanted), RANGE, SETTINGS, seed=3)


def relative_error(depth: Any, truth: Any, border: int = 6) -> Any:
    inner = np.s_[border:-border, border:-border]
    return np.abs(depth[inner] / truth[inner] - 1)


@pytest.mark.parametrize(("radius", "step"), [(3, 1), (4, 2), (5, 2)])
def test_the_compiled_cost_is_that_of_the_readable_twin(slanted: Any, radius: int, step: int) -> None:
    settings = PatchMatchSettings(radius=radius, step=step)
    reference, sources = views_of(slanted)
    rng = np.random.default_rng(0)
    shape = reference.grey.shape
    depth = (slanted.depth["0.png"] * rng.uniform(0.9, 1.1, shape)).astype(np.float32)
    normals = np.array([0, 0, -1]) + rng.uniform(-0.6, 0.6, (*shape, 3))
    normals = (normals / np.linalg.norm(normals, axis=2, keepdims=True)).astype(np.float32)
    cost = _costs(reference, sources, depth, normals, settings)

    places = rng.integers((0, 0), shape, (80, 2))
    expected = [
        slow_plane_cost(reference, sources, i, j, float(depth[i, j]), normals[i, j].astype(float), settings)
        for i, j in places
    ]
    # The pictures are float32 in both, and so is the cost that is kept.
    assert np.allclose(cost[places[:, 0], places[:, 1]], expected, atol=1e-4)
    assert 0.02 < np.mean(np.array(expected) < 1) < 0.98  # near and far from the truth, inside and outside


def _costs(reference: StereoView, sources: Any, depth: Any, normals: Any, settings: PatchMatchSettings) -> Any:
    cost, texture = np.zeros_like(depth), np.zeros_like(depth)
    colour = 1 / (2 * settings.sigma_colour**2)
    with launching():
        cost_planes(
            reference.grey,
            depth,
            normals,
            cost,
            texture,
            pinhole_of(reference),
            pack_views(reference, sources),
            *(settings.radius, settings.step, colour, settings.best, 0.0),
        )
    return cost


def test_a_slanted_plane_is_found(slanted: Any, found: PlaneMaps) -> None:
    error = relative_error(found.depth, slanted.depth["0.png"])
    # A pixel in a view is 1.1 % of the depth here.
    assert np.median(error) < 0.002
    assert np.mean(error < 0.01) > 0.95
    expected = slanted.scene.frames[0].cam_from_world.rotation @ slanted.normal
    angle = np.degrees(np.arccos(np.clip(found.normals[6:-6, 6:-6] @ expected, -1, 1)))
    assert np.median(angle) < 8
    assert np.median(found.confidence) > 0.95


def test_a_sphere_before_a_plane_is_found_up_to_its_outline(
    plane_maker: Callable[..., Any], tmp_path: Path
) -> None:
    bumped = plane_maker(tmp_path / "bumped", bump=0.5)
    depth = patch_match(*views_of(bumped), RANGE, SETTINGS).depth
    error = relative_error(depth, bumped.depth["0.png"])
    assert np.median(error) < 0.003
    # The rest is the outline, which a window of seven pixels blurs, and what only one view sees.
    assert np.mean(error < 0.01) > 0.8


def test_the_same_seed_gives_the_same_planes_whatever_the_threads(slanted: Any, found: PlaneMaps) -> None:
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        again = patch_match(*views_of(slanted), RANGE, SETTINGS, seed=3)
    finally:
        numba.set_num_threads(before)
    assert np.array_equal(again.depth, found.depth)
    assert np.array_equal(again.normals, found.normals)
    other = patch_match(*views_of(slanted), RANGE, SETTINGS.replace({"levels": 1, "iterations": 1}), seed=4)
    assert not np.array_equal(other.depth, found.depth)


def test_the_depth_of_other_pictures_draws_planes_to_it(slanted: Any, found: PlaneMaps) -> None:
    reference, sources = views_of(slanted)
    rough = dataclasses.replace(found, depth=found.depth * np.float32(1.03))
    known = [
        dataclasses.replace(source, depth=slanted.depth[f"{number}.png"].astype(np.float32))
        for number, source in enumerate(sources, start=1)
    ]
    refined = patch_match(reference, known, RANGE, SETTINGS, start=rough)
    error = relative_error(refined.depth, slanted.depth["0.png"])
    assert np.median(error) < 0.002 < 0.02 < np.median(relative_error(rough.depth, slanted.depth["0.png"]))


def test_masked_pixels_have_no_cost_and_help_nobody(slanted: Any) -> None:
    reference, sources = views_of(slanted)
    grey = reference.grey.copy()
    grey[20:40, 30:60] = np.nan
    quick = SETTINGS.replace({"levels": 2, "iterations": 2})
    masked = patch_match(dataclasses.replace(reference, grey=grey), sources, RANGE, quick)
    assert np.isinf(masked.cost[20:40, 30:60]).all()
    assert np.isfinite(masked.cost[:20]).all()
    blind = [dataclasses.replace(source, grey=np.full_like(source.grey, np.nan)) for source in sources]
    nothing = patch_match(reference, blind, RANGE, quick)
    assert nothing.confidence.max() == 0


def test_what_cannot_be_compared_is_told(slanted: Any) -> None:
    reference, _ = views_of(slanted)
    with pytest.raises(DataError, match="no view to compare"):
        patch_match(reference, [], RANGE, SETTINGS)
    with pytest.raises(DataError, match="not of its camera's size"):
        dataclasses.replace(reference, grey=reference.grey[:-1])
