"""Splats as PLY files in INRIA's layout."""

from __future__ import annotations

import random
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from toolkit.errors import DataError, NumericalError
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.ply import read_splats, write_splats

SCALES = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
FEWEST = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *SCALES, *ROTATION)


def some(count: int, coefficients: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> Gaussians:
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=draw, dtype=dtype)

    return Gaussians(
        normal(count, 3), normal(count, 4), normal(count, 3), normal(count), normal(count, coefficients, 3)
    )


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 20), st.sampled_from([1, 4, 9, 16]), st.integers(0, 2**31))
def test_splats_survive_to_the_bit(count: int, coefficients: int, seed: int) -> None:
    gaussians = some(count, coefficients, seed)
    with tempfile.TemporaryDirectory() as folder:
        write_splats(gaussians, Path(folder) / "a.ply")
        again = read_splats(Path(folder) / "a.ply")
    for (name, mine), (_, theirs) in zip(gaussians.named(), again.named(), strict=True):
        assert torch.equal(mine, theirs), name
        assert theirs.dtype == torch.float32
        assert theirs.is_contiguous()


def test_the_layout_is_inrias(tmp_path: Path) -> None:
    gaussians = some(5, 16)
    write_splats(gaussians, tmp_path / "a.ply")
    data = PlyData.read(str(tmp_path / "a.ply"))
    vertex = data["vertex"]
    assert (data.text, data.byte_order) == (False, "<")
    names = [prop.name for prop in vertex.properties]
    rest = [f"f_rest_{i}" for i in range(45)]
    assert names == [*FEWEST[:3], "nx", "ny", "nz", *FEWEST[3:6], *rest, *FEWEST[6:]]
    assert {prop.val_dtype for prop in vertex.properties} == {"f4"}
    # All coefficients of red come first, then those of green, then those of blue.
    np.testing.assert_array_equal(vertex["f_rest_2"], gaussians.sh[:, 3, 0])
    np.testing.assert_array_equal(vertex["f_rest_15"], gaussians.sh[:, 1, 1])
    np.testing.assert_array_equal(vertex["f_rest_44"], gaussians.sh[:, 15, 2])
    np.testing.assert_array_equal(vertex["f_dc_1"], gaussians.sh[:, 0, 1])
    np.testing.assert_array_equal(vertex["rot_0"], gaussians.quaternions[:, 0])
    np.testing.assert_array_equal(vertex["opacity"], gaussians.opacity_logits)
    np.testing.assert_array_equal(vertex["nx"], np.zeros(5))


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_gsply_reads_ours_and_we_read_gsplys(tmp_path: Path, coefficients: int) -> None:
    gsply = pytest.importorskip("gsply")
    gaussians = some(7, coefficients)
    write_splats(gaussians, tmp_path / "a.ply")
    theirs = gsply.plyread(str(tmp_path / "a.ply"))
    np.testing.assert_array_equal(theirs.means, gaussians.means)
    np.testing.assert_array_equal(theirs.quats, gaussians.quaternions)
    np.testing.assert_array_equal(theirs.scales, gaussians.log_scales)
    np.testing.assert_array_equal(theirs.opacities, gaussians.opacity_logits)
    np.testing.assert_array_equal(theirs.sh0, gaussians.sh[:, 0])
    if coefficients > 1:
        np.testing.assert_array_equal(np.asarray(theirs.shN).reshape(7, -1, 3), gaussians.sh[:, 1:])
    gsply.plywrite(str(tmp_path / "b.ply"), theirs)
    again = read_splats(tmp_path / "b.ply")
    for (name, mine), (_, other) in zip(gaussians.named(), again.named(), strict=True):
        assert torch.equal(mine, other), name


@pytest.mark.parametrize("coefficients", [1, 4, 16])
def test_we_read_what_gsplat_exports(tmp_path: Path, coefficients: int) -> None:
    exporter = pytest.importorskip("gsplat.exporter")
    gaussians = some(7, coefficients)
    exporter.export_splats(
        means=gaussians.means,
        scales=gaussians.log_scales,
        quats=gaussians.quaternions,
        opacities=gaussians.opacity_logits,
        sh0=gaussians.sh[:, :1],
        shN=gaussians.sh[:, 1:],
        format="ply",
        save_to=str(tmp_path / "theirs.ply"),
    )
    again = read_splats(tmp_path / "theirs.ply")
    for (name, mine), (_, other) in zip(gaussians.named(), again.named(), strict=True):
        assert torch.equal(mine, other), name


@pytest.mark.parametrize("coefficients", [1, 4, 16])
def test_ours_is_gsplats_file_but_for_the_normals(tmp_path: Path, coefficients: int) -> None:
    """The same properties in the same order with the same numbers; gsplat leaves out INRIA's normals."""
    exporter = pytest.importorskip("gsplat.exporter")
    gaussians = some(7, coefficients)
    write_splats(gaussians, tmp_path / "ours.ply")
    exporter.export_splats(
        means=gaussians.means,
        scales=gaussians.log_scales,
        quats=gaussians.quaternions,
        opacities=gaussians.opacity_logits,
        sh0=gaussians.sh[:, :1],
        shN=gaussians.sh[:, 1:],
        format="ply",
        save_to=str(tmp_path / "theirs.ply"),
    )
    ours, theirs = (PlyData.read(str(tmp_path / name))["vertex"] for name in ("ours.ply", "theirs.ply"))
    kept = [prop for prop in ours.properties if prop.name not in ("nx", "ny", "nz")]
    assert [str(prop) for prop in kept] == [str(prop) for prop in theirs.properties]
    for prop in kept:
        np.testing.assert_array_equal(ours[prop.name], theirs[prop.name], err_msg=prop.name)


def test_a_header_that_claims_too_many_is_refused_before_anything_is_allocated(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_splats(some(3, 4), path)
    path.write_bytes(path.read_bytes().replace(b"element vertex 3", b"element vertex 90000000000000000"))
    with pytest.raises(
        DataError, match=r"expected 90000000000000000 vertices of 104 bytes; found 312 bytes for them"
    ):
        read_splats(path)


def test_other_types_orders_and_more_properties_are_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    names = [*reversed(FEWEST), "confidence", *(f"f_rest_{i}" for i in reversed(range(9)))]
    table = np.zeros(4, [(name, "f8") for name in names])
    for name in names:
        table[name] = rng.normal(size=4).astype(np.float32)
    for number, (text, order) in enumerate([(True, "="), (False, ">"), (False, "<")]):
        path = tmp_path / f"{number}.ply"
        PlyData([PlyElement.describe(table, "vertex")], text=text, byte_order=order).write(str(path))
        gaussians = read_splats(path)
        np.testing.assert_array_equal(gaussians.means[:, 1], table["y"])
        np.testing.assert_array_equal(gaussians.sh[:, 2, 1], table["f_rest_4"])


def test_gradients_and_double_precision_are_left_behind(tmp_path: Path) -> None:
    gaussians = some(3, 4, dtype=torch.float64).map(lambda tensor: tensor.requires_grad_())
    write_splats(gaussians, tmp_path / "a.ply")
    assert torch.equal(read_splats(tmp_path / "a.ply").sh, gaussians.sh.detach().float())


def write(path: Path, names: tuple[str, ...], **values: float) -> None:
    table = np.ones(3, [(name, "f4") for name in names])
    for name, value in values.items():
        table[name][1] = value
    PlyData([PlyElement.describe(table, "vertex")], byte_order="<").write(str(path))


def rest(count: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(count))


@pytest.mark.parametrize(
    ("names", "values", "message"),
    [
        (("x", "y", "z", "red", "green", "blue"), {}, r"holds no splat.*no f_dc_0.*Is it a point cloud\?"),
        (("packed_position", "packed_color"), {}, r"found a compressed splat\. Export it as an uncompressed PLY"),
        (FEWEST[:-1], {}, r"holds no splat that can be read; .*found no rot_3"),
        ((*FEWEST, *rest(8)), {}, r"wrong number of spherical harmonics; expected 0, 9, 24 or 45.*; found 8"),
        ((*FEWEST, *rest(72)), {}, r"wrong number of spherical harmonics; .*found 72"),
        ((*FEWEST, *rest(8), "f_rest_9"), {}, r"wrong number of spherical harmonics; .*found 9"),
        (FEWEST, {"scale_1": np.nan}, r"not finite in row 1, field scale_1; found nan, and 0 more"),
        (FEWEST, {"opacity": np.inf}, r"not finite in row 1, field opacity; found inf"),
        ((*FEWEST, *rest(9)), {"f_rest_7": -np.inf}, r"not finite in row 1, field f_rest_7; found -inf"),
        (
            FEWEST,
            {"rot_0": 0.0, "rot_1": 0.0, "rot_2": 0.0, "rot_3": 0.0},
            r"rotation of length zero in row 1; expected a quaternion wxyz",
        ),
    ],
)
def test_each_fault_is_named(
    tmp_path: Path, names: tuple[str, ...], values: dict[str, float], message: str
) -> None:
    write(tmp_path / "a.ply", names, **values)
    with pytest.raises(DataError, match=message):
        read_splats(tmp_path / "a.ply")


def test_a_double_too_large_for_single_precision_is_named(tmp_path: Path) -> None:
    table = np.ones(2, [(name, "f8") for name in FEWEST])
    table["z"][0] = 1e40
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "a.ply"))
    with pytest.raises(DataError, match=r"row 0, field z; found 1e\+40"):
        read_splats(tmp_path / "a.ply")


def test_a_file_cut_off_at_any_byte_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_splats(some(2, 4), path)
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"a\.ply"):
            read_splats(path)


def test_damaged_bytes_are_an_error_or_splats(tmp_path: Path) -> None:
    path, rng = tmp_path / "a.ply", random.Random(2)
    write_splats(some(2, 4), path)
    whole = path.read_bytes()
    for _ in range(300):
        damaged = bytearray(whole)
        for _ in range(rng.choice([1, 2, 8])):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        path.write_bytes(damaged)
        try:
            gaussians = read_splats(path)
        except DataError:
            continue
        assert all(torch.isfinite(tensor).all() for _, tensor in gaussians.named())


@pytest.mark.parametrize("name", ["means", "quaternions", "log_scales", "opacity_logits", "sh"])
def test_splats_that_are_not_finite_are_not_written(tmp_path: Path, name: str) -> None:
    gaussians = some(3, 4)
    write_splats(gaussians, tmp_path / "a.ply")
    before = (tmp_path / "a.ply").read_bytes()
    getattr(gaussians, name)[2].fill_(float("nan"))
    with pytest.raises(
        NumericalError, match=rf"Cannot write a splat whose {name} are not finite; found nan in row 2"
    ):
        write_splats(gaussians, tmp_path / "a.ply")
    assert (tmp_path / "a.ply").read_bytes() == before
