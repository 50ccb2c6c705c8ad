"""Splats as SPZ files: Niantic's container, versions 2 and 3."""

from __future__ import annotations

import gzip
import math
import struct
import tempfile
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from toolkit.errors import Cancelled, DataError, NumericalError
from toolkit.progress import CancelToken, ProgressEvent
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.reference import rotation_matrices
from toolkit.splat.sh import sh_basis
from toolkit.splat.spz import read_spz, write_spz

MAGIC = 0x5053474E
# Three components of at most sqrt(1/2) are off by half a step each; the fourth follows from them.
DEGREES_V3 = 0.3
# Version 2 drops w; where w is near zero, an error of 1/255 in each of x, y and z becomes one of its root in w.
DEGREES_V2 = 13.5


def some(count: int, coefficients: int, seed: int = 0, spread: float = 20.0) -> Gaussians:
    """Gaussians that an SPZ file can hold without clamping."""
    draw = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(*shape, generator=draw)

    return Gaussians(
        means=uniform(-spread, spread, count, 3),
        quaternions=torch.randn(count, 4, generator=draw) * uniform(0.1, 5, count, 1),
        log_scales=uniform(-10, 5.9, count, 3),
        opacity_logits=uniform(-5, 5, count),
        sh=torch.cat([uniform(-3, 3, count, 1, 3), uniform(-0.99, 0.97, count, coefficients - 1, 3)], dim=1),
    )


def turn_between(mine: torch.Tensor, theirs: torch.Tensor) -> torch.Tensor:
    """Angles in degrees between rotations (N, 4), either sign of which is the same rotation."""
    mine, theirs = (torch.nn.functional.normalize(q.double(), dim=-1) for q in (mine, theirs))
    # The difference keeps small angles exact where the cosine loses them.
    off = torch.minimum((mine - theirs).norm(dim=-1), (mine + theirs).norm(dim=-1))
    return torch.rad2deg(4 * torch.asin(off / 2))


def assert_close(mine: Gaussians, theirs: Gaussians, bits: int, degrees: float) -> None:
    """Hold both together within the quantisation that the module's table states (and float32)."""
    tiny = 1e-5
    assert len(mine) == len(theirs)
    assert mine.sh.shape == theirs.sh.shape
    if not len(mine):
        return
    assert (mine.means - theirs.means).abs().max() <= 2.0 ** -(bits + 1) + tiny
    assert (mine.log_scales - theirs.log_scales).abs().max() <= 1 / 32 + tiny
    opacity = mine.opacity_logits.sigmoid() - theirs.opacity_logits.sigmoid()
    assert opacity.abs().max() <= 1 / 510 + tiny
    off = (mine.sh - theirs.sh).abs().amax(dim=(0, 2))
    limits = [1 / 76.5] + [4.5 / 128] * 3 + [8.5 / 128] * 12
    assert (off <= torch.tensor(limits[: len(off)]) + tiny).all()
    assert turn_between(mine.quaternions, theirs.quaternions).max() <= degrees
    for name, tensor in theirs.named():
        assert tensor.dtype == torch.float32, name
        assert tensor.is_contiguous(), name


@settings(max_examples=60)
@given(
    st.integers(0, 40),
    st.sampled_from([1, 4, 9, 16]),
    st.integers(0, 2**31),
    st.sampled_from([(3, DEGREES_V3), (2, DEGREES_V2)]),
    st.sampled_from(["RUB", "RDF"]),
)
def test_a_round_trip_loses_what_the_table_says(
    count: int, coefficients: int, seed: int, version: tuple[Any, float], axes: Any
) -> None:
    gaussians = some(count, coefficients, seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.spz"
        write_spz(gaussians, path, axes=axes, version=version[0])
        bits = gzip.decompress(path.read_bytes())[13]
        assert_close(gaussians, read_spz(path, axes=axes), bits, version[1])


@pytest.mark.parametrize("version", [2, 3])
def test_rotations_where_the_encodings_branch(tmp_path: Path, version: Any) -> None:
    half = math.sqrt(0.5)
    rows = [np.eye(4), -np.eye(4), np.full((1, 4), 0.5), np.full((1, 4), -0.5)]
    rows += [[[half, half, 0, 0], [half, 0, -half, 0], [0, -half, 0, -half], [-half, 0, 0, half], [0, 0, 1, 1e-7]]]
    quaternions = torch.tensor(np.concatenate(rows), dtype=torch.float32)
    count = len(quaternions)
    zero = torch.zeros
    gaussians = Gaussians(zero(count, 3), quaternions, zero(count, 3), zero(count), zero(count, 1, 3))
    write_spz(gaussians, tmp_path / "a.spz", version=version)
    off = turn_between(quaternions, read_spz(tmp_path / "a.spz").quaternions)
    assert off.max() <= (DEGREES_V3 if version == 3 else DEGREES_V2)


def test_a_second_round_trip_loses_nothing(tmp_path: Path) -> None:
    write_spz(some(50, 16), tmp_path / "a.spz")
    once = read_spz(tmp_path / "a.spz")
    write_spz(once, tmp_path / "b.spz")
    again = read_spz(tmp_path / "b.spz")
    for (name, mine), (_, other) in zip(once.named(), again.named(), strict=True):
        if name == "quaternions":
            # Normalising in another order may move one by a last step.
            assert turn_between(mine, other).max() <= DEGREES_V3
        else:
            torch.testing.assert_close(mine, other, atol=1e-6, rtol=1e-6)


def test_the_same_splat_makes_the_same_file(tmp_path: Path) -> None:
    for name in ("a.spz", "b.spz"):
        write_spz(some(5, 4), tmp_path / name)
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()


def header(
    version: int = 3, count: int = 1, degree: int = 0, bits: int = 12, flags: int = 0, last: int = 0
) -> bytes:
    return struct.pack("<IIIBBBB", MAGIC, version, count, degree, bits, flags, last)


def test_the_bytes_are_those_of_the_format(tmp_path: Path) -> None:
    """A file made by hand from the format's description."""
    positions = b"\x00\x10\x00" + b"\x00\xf0\xff" + b"\x01\x00\x00"  # 1, -1 and 1/4096 at 12 bits
    alpha, colours, scales = b"\xff", bytes([0, 127, 255]), bytes([0, 160, 255])
    # The largest is w (3); x = sqrt(1/2), y = -256/511 sqrt(1/2), z = 0.
    rotation = struct.pack("<I", 3 << 30 | 511 << 20 | (512 | 256) << 10 | 0)
    harmonics = bytes([0, 128, 255, 129, 130, 131, 64, 192, 128])
    body = positions + alpha + colours + scales + rotation + harmonics
    (tmp_path / "a.spz").write_bytes(gzip.compress(header(degree=1, flags=1) + body, mtime=0))
    gaussians = read_spz(tmp_path / "a.spz", axes="RDF")
    np.testing.assert_allclose(gaussians.means, [[1, -1, 1 / 4096]])
    np.testing.assert_allclose(gaussians.log_scales, [[-10, 0, 5.9375]])
    np.testing.assert_allclose(gaussians.opacity_logits, [math.log((1 - 1e-6) / 1e-6)], rtol=1e-5)
    np.testing.assert_allclose(gaussians.sh[0, 0], [-0.5 / 0.15, -0.5 / 255 / 0.15, 0.5 / 0.15], rtol=1e-5)
    np.testing.assert_allclose(
        gaussians.sh[0, 1:], np.array([[-128, 0, 127], [1, 2, 3], [-64, 64, 0]]) / 128, rtol=1e-6
    )
    x, y = math.sqrt(0.5), -256 / 511 * math.sqrt(0.5)
    np.testing.assert_allclose(gaussians.quaternions, [[math.sqrt(0.5 - y**2), x, y, 0]], atol=1e-6)
    body = body[:16] + bytes([255, 64, 128]) + harmonics
    (tmp_path / "b.spz").write_bytes(gzip.compress(header(version=2, degree=1) + body, mtime=0))
    quaternion = read_spz(tmp_path / "b.spz", axes="RDF").quaternions[0]
    np.testing.assert_allclose(quaternion[1:], [1, 64 / 127.5 - 1, 128 / 127.5 - 1], rtol=1e-6)
    assert quaternion[0] == 0


def test_our_bytes_are_those_of_the_format(tmp_path: Path) -> None:
    sh = torch.tensor([[[0.0, 1, -9], [0.04, -0.04, 2], [0, -2, 0.5], [0, 0, 0.02]]])
    gaussians = Gaussians(
        torch.tensor([[1.0, -1.0, 100.0]]),
        torch.tensor([[-2.0, 0, 0, 0]]),
        torch.tensor([[0.0, -20, 20]]),
        torch.tensor([0.0]),
        sh,
    )
    write_spz(gaussians, tmp_path / "a.spz", axes="RDF")
    content = gzip.decompress((tmp_path / "a.spz").read_bytes())
    # 100 needs 7 whole bits beside the sign: 16 are left.
    assert content[:16] == header(degree=1, bits=16)
    assert content[16:25] == b"\x00\x00\x01" + b"\x00\x00\xff" + b"\x00\x00\x64"
    assert content[25:26] == b"\x80"
    assert content[26:29] == bytes([128, 166, 0])
    assert content[29:32] == bytes([160, 0, 255])
    # w is the largest, made positive.
    assert content[32:36] == struct.pack("<I", 3 << 30)
    # Steps of eight, of which 128 is a centre; what is out of range is clamped.
    assert content[36:] == bytes([136, 120, 255, 128, 0, 192, 128, 128, 128])


def test_the_turn_to_rub_keeps_shape_and_colour(tmp_path: Path) -> None:
    """Half a turn about x: as if the whole scene were turned, with what it looks like from each side."""
    gaussians = some(30, 16)
    write_spz(gaussians, tmp_path / "a.spz", axes="RUB")
    kept, turned = read_spz(tmp_path / "a.spz", axes="RUB"), read_spz(tmp_path / "a.spz")
    half_turn = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    torch.testing.assert_close(turned.means, kept.means @ half_turn)
    torch.testing.assert_close(covariances(turned), half_turn @ covariances(kept) @ half_turn, rtol=1e-4, atol=1e-3)
    directions = torch.nn.functional.normalize(
        torch.randn(30, 3, generator=torch.Generator().manual_seed(1)), dim=1
    )
    colours = [
        (sh_basis(3, seen)[:, :, None] * splat.sh).sum(dim=1)
        for seen, splat in ((directions, kept), (directions @ half_turn, turned))
    ]
    torch.testing.assert_close(*colours, rtol=1e-4, atol=1e-5)
    # And without the turn they would differ: the test can fail.
    assert not torch.allclose((sh_basis(3, directions)[:, :, None] * turned.sh).sum(dim=1), colours[0], atol=0.1)


def covariances(gaussians: Gaussians) -> torch.Tensor:
    """(N, 3, 3) of Gaussians whose scales are brought near one."""
    rotation = rotation_matrices(gaussians.quaternions)
    shaped = rotation * (gaussians.log_scales / 5).exp()[:, None, :]
    return shaped @ shaped.transpose(1, 2)


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("version", [2, 3])
def test_gsply_reads_ours_and_we_read_gsplys(tmp_path: Path, coefficients: int, version: Any) -> None:
    """gsply does not turn: its numbers are those of the file."""
    gsply_spz = pytest.importorskip("gsply.spz")
    gaussians = some(25, coefficients)
    write_spz(gaussians, tmp_path / "a.spz", version=version)
    theirs, mine = gsply_spz.read_spz(tmp_path / "a.spz"), read_spz(tmp_path / "a.spz", axes="RDF")
    same(mine, theirs)
    if version == 3:
        # It writes no version 2.
        gsply_spz.write_spz(tmp_path / "b.spz", theirs, version=version)
        same(read_spz(tmp_path / "b.spz", axes="RDF"), gsply_spz.read_spz(tmp_path / "b.spz"))


def same(mine: Gaussians, theirs: Any) -> None:
    """Both decode the same bytes: float32 is all that may differ, and more so at logits of alphas near one."""
    close = {"rtol": 1e-5, "atol": 2e-4}
    np.testing.assert_allclose(theirs.means, mine.means, **close)
    np.testing.assert_allclose(theirs.scales, mine.log_scales, **close)
    np.testing.assert_allclose(theirs.quats, mine.quaternions, **close)
    np.testing.assert_allclose(theirs.opacities, mine.opacity_logits, **close)
    np.testing.assert_allclose(theirs.sh0, mine.sh[:, 0], **close)
    if mine.sh.shape[1] > 1:
        np.testing.assert_allclose(np.asarray(theirs.shN).reshape(len(mine), -1, 3), mine.sh[:, 1:], **close)


@pytest.mark.parametrize(("farthest", "bits"), [(0.0, 24), (0.4, 24), (1.0, 22), (2000.0, 12), (4_194_303.5, 1)])
def test_as_many_fractional_bits_as_leave_room(tmp_path: Path, farthest: float, bits: int) -> None:
    gaussians = some(4, 1, spread=farthest)
    gaussians.means[2, 1] = -farthest
    write_spz(gaussians, tmp_path / "a.spz")
    assert gzip.decompress((tmp_path / "a.spz").read_bytes())[13] == bits
    off = (read_spz(tmp_path / "a.spz").means - gaussians.means).abs().max()
    assert off <= 2.0 ** -(bits + 1) + 1e-7 * farthest


def test_a_scene_too_large_is_refused_with_its_range(tmp_path: Path) -> None:
    gaussians = some(3, 1)
    gaussians.means[1, 0], gaussians.means[2, 0] = -5e6, 3000
    with pytest.raises(DataError, match=r"means of -4194304 to 4194304 .*; found -5e\+06 to 3000\. Move the scene"):
        write_spz(gaussians, tmp_path / "a.spz")
    assert not (tmp_path / "a.spz").exists()


@pytest.mark.parametrize("name", ["means", "quaternions", "log_scales", "opacity_logits", "sh"])
@pytest.mark.parametrize("value", [math.nan, -math.inf])
def test_splats_that_are_not_finite_are_not_written(tmp_path: Path, name: str, value: float) -> None:
    gaussians = some(3, 4)
    getattr(gaussians, name)[2].fill_(value)
    with pytest.raises(NumericalError, match=rf"whose {name} are not finite; found (nan|-inf) in row 2"):
        write_spz(gaussians, tmp_path / "a.spz")
    assert not (tmp_path / "a.spz").exists()


def test_a_rotation_of_length_zero_is_refused(tmp_path: Path) -> None:
    gaussians = some(3, 1)
    gaussians.quaternions[1] = 0
    with pytest.raises(DataError, match=r"rotation of length zero in row 1; expected a quaternion wxyz"):
        write_spz(gaussians, tmp_path / "a.spz")


def test_the_largest_numbers_are_clamped_without_a_warning(tmp_path: Path) -> None:
    gaussians = some(2, 16)
    for name in ("log_scales", "opacity_logits", "sh", "quaternions"):
        getattr(gaussians, name)[0].fill_(3e38)
        getattr(gaussians, name)[1].fill_(-3e38)
    write_spz(gaussians, tmp_path / "a.spz")
    again = read_spz(tmp_path / "a.spz", axes="RDF")
    assert again.log_scales[:, 0].tolist() == [5.9375, -10]
    assert again.opacity_logits.sigmoid().round().tolist() == [1, 0]
    assert all(torch.isfinite(tensor).all() for _, tensor in again.named())


def test_splats_that_compress_to_almost_nothing_are_read(tmp_path: Path) -> None:
    gaussians = some(1, 16).map(lambda tensor: tensor.expand(20_000, *tensor.shape[1:]))
    write_spz(gaussians, tmp_path / "a.spz")
    assert (tmp_path / "a.spz").stat().st_size < 20_000
    assert torch.equal(read_spz(tmp_path / "a.spz").sh[0], read_spz(tmp_path / "a.spz").sh[-1])


def test_gradients_and_double_precision_are_left_behind(tmp_path: Path) -> None:
    gaussians = some(3, 4).to(dtype=torch.float64).map(lambda tensor: tensor.requires_grad_())
    write_spz(gaussians, tmp_path / "a.spz")
    assert not read_spz(tmp_path / "a.spz").sh.requires_grad


def test_writing_reports_and_can_be_cancelled(tmp_path: Path) -> None:
    events: list[ProgressEvent] = []
    write_spz(some(5, 1), tmp_path / "a.spz", progress=events.append)
    assert (events[-1].stage, events[-1].done) == ("spz.write", events[-1].total)
    token = CancelToken()
    token.cancel()
    with pytest.raises(Cancelled):
        write_spz(some(5, 1), tmp_path / "b.spz", progress=token)
    assert [path.name for path in tmp_path.iterdir()] == ["a.spz"]


@pytest.mark.parametrize("version", [2, 3])
def test_a_file_cut_off_at_any_byte_is_an_error(tmp_path: Path, version: Any) -> None:
    path = tmp_path / "a.spz"
    write_spz(some(3, 4), path, version=version)
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"a\.spz (is no SPZ file|is cut off or damaged)"):
            read_spz(path)


def test_damaged_bytes_are_an_error_or_splats(tmp_path: Path) -> None:
    """With and without gzip's checksum to catch them."""
    path, rng = tmp_path / "a.spz", np.random.default_rng(0)
    write_spz(some(3, 4), path)
    whole = path.read_bytes()
    for number in range(400):
        damaged = bytearray(gzip.decompress(whole) if number % 2 else whole)
        for _ in range(rng.choice([1, 2, 8])):
            damaged[rng.integers(min(len(damaged), rng.choice([24, 1000])))] = rng.integers(256)
        path.write_bytes(gzip.compress(bytes(damaged), mtime=0) if number % 2 else bytes(damaged))
        try:
            gaussians = read_spz(path)
        except DataError:
            continue
        assert all(torch.isfinite(tensor).all() for _, tensor in gaussians.named())
        assert gaussians.quaternions.any(dim=1).all()


ONE = bytes(20)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", r"a\.spz is no SPZ file; expected a gzip stream .*; found b''"),
        (b"ply\nformat", r"is no SPZ file; .*found b'ply"),
        (
            header(version=4) + bytes(99),
            r"expected SPZ version 2 or 3; found version 4 \(Zstand.*as version 3, or as PLY",
        ),
        (header(version=2) + ONE, r"expected a gzip stream that begins 1f 8b; found b'NGSP"),
        (
            gzip.compress(b"SPNG" + header()[4:] + ONE, mtime=0),
            r"the magic number b'NGSP' after unfolding; found b'SPNG'",
        ),
        (
            gzip.compress(header(version=1) + ONE, mtime=0),
            r"expected SPZ version 2 or 3; found version 1\. Export it",
        ),
        (gzip.compress(header(version=4) + ONE, mtime=0), r"expected SPZ version 2 or 3; found version 4"),
        (
            gzip.compress(header(degree=4) + bytes(92), mtime=0),
            r"expected degree 0, 1, 2 or 3; found degree 4\. Export it",
        ),
        (
            gzip.compress(header(bits=25) + ONE, mtime=0),
            r"odd positions; expected 0 to 24 fractional bits; found 25",
        ),
        (
            gzip.compress(header(flags=2) + ONE, mtime=0),
            r"found flags 2 and reserved byte 0\. Export it without extensions",
        ),
        (gzip.compress(header(last=7) + ONE, mtime=0), r"found flags 0 and reserved byte 7"),
        (gzip.compress(header()[:9], mtime=0), r"expected a header of 16 bytes; found 9\. Copy or export it again"),
        (
            gzip.compress(header(count=2) + ONE, mtime=0),
            r"expected 2 Gaussians of 20 bytes; found 20 bytes for them",
        ),
        (
            gzip.compress(header(count=2**32 - 1) + ONE, mtime=0),
            r"made to fill the memory; .*found 4294967295 Gaussians",
        ),
        (
            gzip.compress(header(count=10**7) + ONE, mtime=0),
            r"expected 10000000 Gaussians of 20 bytes; found 20 bytes",
        ),
        (
            gzip.compress(header() + ONE + b"\0", mtime=0),
            r"longer than its header says; expected 1 Gaussians of 20 bytes",
        ),
        (gzip.compress(header() + ONE, mtime=0) + b"\0", r"longer than its header says"),
        (gzip.compress(header() + ONE, mtime=0)[:-1], r"expected the checksum of the gzip stream at its end"),
        (
            gzip.compress(header() + ONE, mtime=0)[:-8] + bytes(8),
            r"expected a sound gzip stream; found .*incorrect data check",
        ),
        (b"\x1f\x8b" + bytes(40), r"expected a sound gzip stream; found "),
    ],
)
def test_each_fault_is_named(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.spz").write_bytes(content)
    with pytest.raises(DataError, match=message):
        read_spz(tmp_path / "a.spz")


def test_what_is_no_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.spz is missing; expected an SPZ file"):
        read_spz(tmp_path / "none.spz")
    with pytest.raises(DataError, match=r"Cannot read .*; expected an SPZ file"):
        read_spz(tmp_path)


@pytest.mark.parametrize("count", [1, 50_000_000])
def test_a_bomb_does_not_fill_the_memory(tmp_path: Path, count: int) -> None:
    """64 MiB of zeros behind a header that claims one splat, or a gigabyte of them."""
    packer = zlib.compressobj(wbits=31)
    bomb = packer.compress(header(count=count)) + packer.compress(bytes(64 * 2**20)) + packer.flush()
    (tmp_path / "a.spz").write_bytes(bomb)
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=r"longer than its header says|made to fill the memory"):
            read_spz(tmp_path / "a.spz")
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # The file itself (65 kB), a buffer and the message.
    assert peak < 2**20
