"""The box around the points and rays through it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from toolkit.errors import StageError
from toolkit.nerf.space import Space, space_of
from toolkit.scene import Scene

BOX = Space((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.1, True)


def test_the_box_holds_the_points_with_a_margin_and_leaves_wrong_ones_out(plane: Scene) -> None:
    assert plane.points is not None
    xyz = plane.points.xyz.copy()
    xyz[0] = 1000.0
    space = space_of(plane.replace(points=type(plane.points)(xyz, plane.points.rgb)), margin=0.1, contracted=True)
    assert -1.6 < space.low[0] < -0.9
    assert 0.9 < space.high[0] < 1.6
    assert space.high[2] > space.low[2]  # the points lie in a plane: the box has some thickness all the same
    assert 0.5 < space.near < 2.0


def test_contraction_keeps_the_box_and_puts_the_far_within_twice_of_it() -> None:
    points = torch.tensor([[0.5, -0.2, 1.0], [2.0, 0.0, 0.0], [1e6, -1e6, 0.0]], dtype=torch.float64)
    found = BOX.normalised(points)
    assert found[0].tolist() == [0.5, -0.2, 1.0]
    assert found[1].tolist() == [1.5, 0.0, 0.0]
    torch.testing.assert_close(found[2], torch.tensor([2.0, -2.0, 0.0], dtype=torch.float64), rtol=0, atol=1e-5)
    cube = BOX.unit_cube(points)
    assert ((cube >= 0) & (cube <= 1)).all()


def test_rays_are_divided_inside_the_box_and_behind_it() -> None:
    origins, directions = torch.tensor([[0.0, 0.0, -3.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    edges = BOX.edges(origins, directions, torch.linspace(0, 1, 9))[0]
    torch.testing.assert_close(edges[:7], torch.linspace(2, 4, 7))
    assert edges[-1] > 40
    assert (edges.diff() > 0).all()


def test_inside_the_box_a_ray_begins_before_the_camera_and_a_ray_beside_it_has_only_what_is_behind() -> None:
    origins = torch.tensor([[0.0, 0.0, 0.0], [0.0, 5.0, -3.0]])
    directions = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    edges = BOX.edges(origins, directions, torch.linspace(0, 1, 9))
    assert float(edges[0, 0]) == pytest.approx(0.1)
    assert float(edges[0, 6]) == pytest.approx(1.0)
    assert torch.equal(edges[1, :7], torch.full((7,), 3.0))
    assert (edges[1, 7:] > 3).all()


def test_without_points_nothing_says_where_the_scene_is(make_plane: Callable[..., Scene]) -> None:
    scene = make_plane(points=20)
    with pytest.raises(StageError, match="at least 8 sparse points before the training cameras; found 0"):
        space_of(scene.replace(points=None), margin=0.1, contracted=True)
    behind = type(scene.points)(np.full((20, 3), -50.0), scene.points.rgb) if scene.points else None
    with pytest.raises(StageError, match="found 0"):
        space_of(scene.replace(points=behind), margin=0.1, contracted=False)
