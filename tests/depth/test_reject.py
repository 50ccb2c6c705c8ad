"""What is rejected before fusion, and for which reason it counts."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from toolkit.depth.patchmatch import PlaneMaps, StereoView
from toolkit.depth.reject import border_pixels, confirmed_by, depth_edges, rejected_pixels, small_islands
from toolkit.depth.stereo_settings import RejectSettings
from toolkit.depth.stereo_views import load_stereo_view

SETTINGS = RejectSettings(border=4, min_island=0)


@pytest.fixture
def exact(slanted: Any) -> tuple[PlaneMaps, StereoView, list[StereoView]]:
    """Return true planes of the first picture, it and the others with their true depth."""
    views = [
        dataclasses.replace(load_stereo_view(slanted.scene, name), depth=depth.astype(np.float32))
        for name, depth in slanted.depth.items()
    ]
    pose = slanted.scene.frames[0].cam_from_world
    normals = np.broadcast_to(pose.rotation @ slanted.normal, (72, 96, 3)).astype(np.float32)
    depth = slanted.depth["0.png"].astype(np.float32)
    return PlaneMaps(depth, normals, np.zeros_like(depth), np.ones_like(depth)), views[0], views[1:]


def test_a_planted_wrong_depth_is_rejected_and_the_right_one_stays(exact: Any) -> None:
    planes, reference, sources = exact
    wrong = planes.depth.copy()
    wrong[30:40, 40:50] *= np.float32(1.05)
    counts = confirmed_by(wrong, reference, sources, SETTINGS)
    assert counts[30:40, 40:50].max() == 0
    around = np.ones(wrong.shape, bool)
    around[30:40, 40:50] = False
    around[border_pixels(wrong.shape, 10)] = False
    assert counts[around].min() >= 3
    steps_allowed = SETTINGS.replace({"edge": 0.0})
    kept, why = rejected_pixels(dataclasses.replace(planes, depth=wrong), reference, sources, steps_allowed)
    assert not kept[30:40, 40:50].any()
    assert why["views"] >= 100


def test_views_without_depth_confirm_nothing(exact: Any) -> None:
    planes, reference, sources = exact
    blind = [dataclasses.replace(source, depth=None) for source in sources]
    assert confirmed_by(planes.depth, reference, blind, SETTINGS).max() == 0
    kept, _ = rejected_pixels(planes, reference, blind, SETTINGS)
    assert not kept.any()
    kept, _ = rejected_pixels(planes, reference, blind, SETTINGS.replace({"min_views": 0}))
    assert kept.any()


def test_every_pixel_counts_once_for_its_first_reason(exact: Any) -> None:
    planes, reference, sources = exact
    grey = reference.grey.copy()
    grey[10:20, 10:20] = np.nan
    cost, texture = planes.cost.copy(), planes.texture.copy()
    cost[50:60, 50:60], texture[40:45, 60:70] = 0.9, 0.0
    changed = dataclasses.replace(planes, cost=cost, texture=texture)
    kept, counts = rejected_pixels(changed, dataclasses.replace(reference, grey=grey), sources, SETTINGS)
    assert sum(counts.values()) == kept.size
    assert counts["kept"] == kept.sum()
    assert counts["masked"] == 14 * 14 - 4 * 3  # two steps about the mask, none of them diagonal
    assert counts["texture"] == 50
    assert counts["confidence"] == 100
    assert counts["border"] == 72 * 96 - 64 * 88
    assert not kept[8:22, 12:18].any()


def test_a_slope_is_no_edge_and_a_step_is_one(exact: Any) -> None:
    planes, reference, _ = exact
    trusted = np.ones(planes.depth.shape, bool)
    assert not depth_edges(planes, reference, trusted, 0.001).any()
    stepped = planes.depth.copy()
    stepped[:, 48:] *= np.float32(1.1)
    edges = depth_edges(dataclasses.replace(planes, depth=stepped), reference, trusted, 0.03)
    assert np.array_equal(np.flatnonzero(edges.all(axis=0)), [47, 48])
    assert not edges[:, :47].any()
    assert not depth_edges(dataclasses.replace(planes, depth=stepped), reference, trusted, 0.0).any()
    trusted[:, 48:] = False  # what is not sure itself makes no edge
    assert not depth_edges(dataclasses.replace(planes, depth=stepped), reference, trusted, 0.03)[:, :48].any()


def test_islands_and_borders() -> None:
    kept = np.zeros((10, 10), bool)
    kept[1:3, 1:3], kept[5:9, 5:9] = True, True
    small = small_islands(kept, 5)
    assert small[1:3, 1:3].all()
    assert small.sum() == 4
    assert not small_islands(kept, 0).any()
    assert border_pixels((10, 10), 3).sum() == 100 - 16
    assert border_pixels((10, 10), 5).all()
    assert not border_pixels((10, 10), 0).any()
