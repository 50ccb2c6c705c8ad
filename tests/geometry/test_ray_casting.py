"""Rays against two tables, one over the other: what they meet, how far they get, what blocks them."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.geometry.ray_casting import MeshCaster
from toolkit.geometry.surface import Mesh

#: Far from zero, where single precision alone would round to 3 cm.
PLACE = np.array([400_000.0, 5_000_000.0, 0.0])
LOW, HIGH = 1.0, 3.0


@pytest.fixture(scope="module")
def tables() -> MeshCaster:
    """A square of 4 m at 1 m (faces 0 and 1) under one of 2 m at 3 m (faces 2 and 3)."""
    square = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    vertices = PLACE + np.concatenate([2 * square + np.array([0, 0, LOW]), square + np.array([0, 0, HIGH])])
    half = np.array([[0, 1, 2], [0, 2, 3]])
    return MeshCaster(Mesh(vertices, np.concatenate([half, half + 4]).astype(np.int32)))


def test_rays_from_places_of_their_own_tell_how_far_they_get_and_which_face_they_meet(tables: MeshCaster) -> None:
    origins = np.array([[0.5, -0.5, 8], [-0.5, 0.5, 8], [1.5, 0.2, 8], [0.2, 1.5, 8], [3, 0, 8], [0.5, -0.5, 2]])
    down = np.tile([0.0, 0.0, -2.0], (6, 1))
    distance, face = tables.first(origins + PLACE, down)
    # In lengths of the directions, which are 2 m; single precision within a few metres.
    np.testing.assert_allclose(distance, [2.5, 2.5, 3.5, 3.5, np.inf, 0.5], atol=1e-6)
    assert face.tolist() == [2, 3, 0, 1, -1, 0]
    assert face.dtype == np.int64


def test_rays_tell_the_same_of_one_place_as_those_that_start_there_together(tables: MeshCaster) -> None:
    directions = np.random.default_rng(0).normal(size=(200, 3)) - [0, 0, 2]
    eye = PLACE + np.array([0.1, 0.2, 6.0])
    together = tables.cast(eye, directions)
    assert 20 < np.isfinite(together).sum() < 180
    np.testing.assert_array_equal(tables.first(np.tile(eye, (200, 1)), directions)[0], together)


def test_what_stands_in_the_way_blocks_a_ray(tables: MeshCaster) -> None:
    origins = np.array([[0.0, 0.3, 1.1], [1.8, 0.0, 1.1], [0.0, 0.3, 3.1], [1.8, 0.0, 1.1]]) + PLACE
    ways = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 1.0]])
    assert tables.blocked(origins, ways).tolist() == [True, False, False, True]


def test_no_rays_meet_nothing(tables: MeshCaster) -> None:
    none = np.zeros((0, 3))
    distance, face = tables.first(none, none)
    assert distance.shape == face.shape == tables.blocked(none, none).shape == (0,)


def test_a_mesh_without_faces_is_told() -> None:
    with pytest.raises(DataError, match="A mesh without faces meets no ray; expected triangles; found 3 vertices"):
        MeshCaster(Mesh(np.zeros((3, 3)), np.zeros((0, 3), np.int32)))
