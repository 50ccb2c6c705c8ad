"""The rotor's triangles and its textures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from toolkit.samples.engine.render import NO_BLADE, Caster
from toolkit.samples.engine.settings import RotorSettings
from toolkit.samples.engine.shape import SHEET, Rotor, build_rotor
from toolkit.samples.engine.wear import Sheets


@pytest.fixture(scope="module")
def rotor() -> Rotor:
    return build_rotor(90, 0.25)


def test_the_rotor_has_the_size_of_a_small_turbine_and_blades_a_pitch_apart(rotor: Rotor) -> None:
    x, y, z = rotor.vertices.T
    radius = np.hypot(x, y)
    assert radius.max() == pytest.approx(0.278, abs=3e-4)  # the tip is flat: its corners are farther out
    assert 0.18 < radius.min() < 0.2
    assert z.max() == pytest.approx(0.003)  # the rim of the hub; leading edges are just below it
    whole, triangles = rotor.whole
    assert len(triangles) == 90 * len(rotor.triangles)
    turn = np.radians(4.0)
    second = whole[len(rotor.vertices) : 2 * len(rotor.vertices)]
    expected = np.stack([np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y, z], axis=1)
    np.testing.assert_allclose(second, expected, atol=1e-15)


def test_leading_edges_are_straight(rotor: Rotor) -> None:
    # The first of both sides' vertices, section after section, is where the sheet of the convex side begins.
    edge = rotor.vertices[np.abs(rotor.sheet[:, 0] - 0.0005) < 1e-12]
    assert len(edge) == 25
    along = edge[-1] - edge[0]
    assert np.linalg.norm(along) > 0.05
    off = np.cross(edge - edge[0], along / np.linalg.norm(along))
    assert np.linalg.norm(off, axis=1).max() < 1e-12


@pytest.mark.parametrize(("blades", "radius"), [(24, 0.1), (90, 0.225), (150, 2.0)])
def test_a_blade_has_the_same_shape_whatever_their_number_and_size(blades: int, radius: float) -> None:
    one, other = build_rotor(90, 0.25), build_rotor(blades, radius)
    blade = one.sheet[:, 1] <= 0.0576  # above the hub on the sheet
    scaled = (other.vertices[blade] - [radius, 0, 0]) / other.scale
    np.testing.assert_allclose(scaled, one.vertices[blade] - [0.25, 0, 0], atol=1e-12)


def test_triangles_and_normals_look_outwards(rotor: Rotor) -> None:
    a, b, c = (rotor.vertices[rotor.triangles[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    assert area.min() > 0
    normal /= area[:, None]
    smooth = rotor.normals[rotor.triangles].mean(axis=1)
    # At the sharp edges smooth normals differ most from those of the triangles: by up to 60 degrees.
    assert np.sum(normal * smooth, axis=1).min() > 0.5
    assert np.linalg.norm(rotor.normals, axis=1) == pytest.approx(1.0)
    # From a point just outside of each triangle a ray back meets it from its front, at that distance.
    vertices = rotor.whole[0]
    caster = Caster(rotor)
    tried = np.flatnonzero(rotor.sheet[rotor.triangles[:, 0], 1] <= 0.0576)[::29]
    for number in tried:
        middle = vertices[rotor.triangles[number]].mean(axis=0)
        met = caster.surface(middle + 1e-4 * normal[number], -normal[number][None])
        assert np.linalg.norm(met.points[0] - middle) < 1e-7  # single-precision triangles of decimetres


def test_every_vertex_has_a_place_of_its_own_on_the_sheet(rotor: Rotor) -> None:
    assert (rotor.sheet >= 0).all()
    assert (rotor.sheet <= SHEET).all()
    # Only the tip's narrow end, which lies along the outline, may share places with it.
    flat = rotor.sheet[np.abs(rotor.sheet[:, 1] - 0.057) > 1e-6]
    assert len(np.unique(flat.round(9), axis=0)) == len(flat)


def test_a_ray_past_the_blades_meets_nothing_and_one_at_a_blade_knows_its_number(rotor: Rotor) -> None:
    caster = Caster(rotor)
    angle = np.radians(4.0 * 17)
    over = np.array([0.25 * np.cos(angle), 0.25 * np.sin(angle), 0.05])
    met = caster.surface(over, np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))
    assert met.blades.tolist() == [NO_BLADE, 17]
    assert np.isnan(met.points[0]).all()
    np.testing.assert_allclose(met.points[1, :2], over[:2], atol=1e-12)


def test_the_mesh_on_the_disk_is_the_rotor(rotor: Rotor, tmp_path: Path) -> None:
    import open3d as o3d

    rotor.write_ply(tmp_path / "mesh.ply")
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    np.testing.assert_array_equal(np.asarray(mesh.vertices), rotor.whole[0])
    np.testing.assert_array_equal(np.asarray(mesh.triangles), rotor.whole[1])


def sheets(seed: int = 0, **changes: float) -> Sheets:
    return Sheets(RotorSettings(**changes), seed)


def top(drawn: Sheets, blade: int) -> np.ndarray:
    """Return the finest level of a blade's sheet, 0..1."""
    drawn.draw(np.array([blade]))
    start, rows, columns = drawn.layout[0]
    return drawn.pixels[blade, start : start + rows * columns].reshape(rows, columns) / 65535


def test_blades_are_alike_but_each_has_faint_wear_of_its_own() -> None:
    drawn = sheets()
    a, b = top(drawn, 3), top(drawn, 4)
    assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.3  # what the mould gave both
    differ = np.abs(a / b - 1)
    assert 0.01 < np.median(differ) < 0.1  # faint, yet there
    np.testing.assert_array_equal(top(sheets(), 3), a)  # again the same
    assert not np.array_equal(top(sheets(seed=1), 3), a)


def test_without_wear_blades_are_the_same_and_without_casting_nothing_is_shared() -> None:
    same = sheets(wear=0.0)
    np.testing.assert_array_equal(top(same, 3), top(same, 4))
    own = sheets(casting=0.0)
    assert abs(np.corrcoef(top(own, 3).ravel(), top(own, 4).ravel())[0, 1]) < 0.1


def test_coarser_levels_are_means_of_finer_ones() -> None:
    drawn = sheets()
    fine = top(drawn, 0)
    start, rows, columns = drawn.layout[1]
    coarse = drawn.pixels[0, start : start + rows * columns].reshape(rows, columns) / 65535
    mean = fine[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(coarse, mean, atol=1 / 65535)  # 16 bits
