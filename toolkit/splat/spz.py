"""SPZ files: Niantic's small container of splats, a fifth of the PLY or less.

One gzip stream of a header (16 bytes) and, one after the other for all Gaussians: positions, alphas, base colours,
log scales, rotations, higher spherical harmonics. Format: github.com/nianticlabs/spz, README, versions 2 and 3.

=================== ============================================ ======================================
what                stored as                                    largest error; what does not fit
=================== ============================================ ======================================
mean                3 x 24-bit fixed point, b fractional bits    2^-(b+1); an error
opacity             8 bits of the sigmoid                        1/510 of opacity; logits end at +-13.8
sh, degree 0        8 bits of 0.15 sh + 0.5                      1/76.5; clamped to +-3.33
log scale           8 bits of 16 (s + 10)                        1/32; clamped to -10 ... 5.94
rotation, version 3 the three smallest of four, 10 bits each     0.3 degrees
rotation, version 2 x, y and z, 8 bits each                      13 degrees, near half turns; mostly below 1
sh, degree 1        8 bits of 128 sh + 128, in steps of 8        4.5/128; clamped to -1 ... 127/128
sh, degrees 2, 3    the same in steps of 16                      8.5/128; the same
=================== ============================================ ======================================

The steps (5 and 4 bits) are those of Niantic's writer: they are what makes the file small.

The format's axes are RUB (x right, y up, z backward); INRIA's PLY files, and so ours, are taken as RDF (x right,
y down, z forward) by Niantic's library. Between the two lies half a turn about x. Niantic's library turns when it
is told where the numbers come from; its command-line tools, PlayCanvas' splat-transform and gsply copy the numbers
as they are. So do we unless ``axes`` says otherwise: our numbers are those of a scene's world, which has no camera
axes, and a splat should lie the same way as PLY and as SPZ.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.files import atomic_path
from toolkit.progress import Progress, silent, track
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.ply import finite_array

Axes = Literal["RUB", "RDF"]
Bytes = NDArray[np.uint8]

_MAGIC = 0x5053474E
_HEADER = struct.Struct("<IIIBBBB")
_ANTIALIASED = 1
_MOST_BITS = 24
_LARGEST = 2**23 - 1
_COLOUR_SCALE = 0.15
# Alphas of 0 and 255 become logits of finite size; gsply and splat-transform choose the same.
_ALPHA_EDGE = 1e-6
_STEP_DEGREE_1, _STEP_HIGHER = 8, 16
# Splats compress two to five times. What claims to unfold further than this, and is large, is a bomb.
_MOST_TIMES, _ALWAYS_ALLOWED = 100, 256 * 2**20
_CHUNK = 4 * 2**20
# Rows: which of x, y, z, w is the largest; columns: the others.
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
# Half a turn about x. Harmonics change their sign with the factors y and z of their polynomials.
_TURN_XYZ = np.array([1, -1, -1])
_TURN_SH = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)[:, None]


@dataclass(frozen=True, slots=True)
class _Layout:
    """What the header says, and so how many bytes each Gaussian has."""

    version: int
    count: int
    degree: int
    bits: int

    @property
    def higher(self) -> int:
        """Coefficients above degree 0 of each channel."""
        return (self.degree + 1) ** 2 - 1

    @property
    def widths(self) -> tuple[int, ...]:
        """Bytes of a Gaussian for positions, alphas, colours, scales, rotations and harmonics."""
        return 9, 1, 3, 3, 4 if self.version == 3 else 3, 3 * self.higher

    @property
    def size(self) -> int:
        return self.count * sum(self.widths)


def read_spz(path: Path, *, axes: Axes = "RDF") -> Gaussians:
    """Read Gaussians from an SPZ file of version 2 or 3 as float32 tensors on the CPU.

    Parameters
    ----------
    axes:
        The axes of the file's numbers: ``"RUB"`` as the format says, turned to our RDF, or ``"RDF"`` for a file
        whose writer did not turn (see above), read as it is. Nothing in the file tells.

    Notes
    -----
    That a splat was trained with antialiasing (flag 1) is not kept.

    Raises
    ------
    DataError
        Where the file is missing, cut off or damaged, is of another version or degree, has extensions, holds more
        or less than its header says, or unfolds to more than 256 MiB and a hundred times its size. Nothing of the
        claimed size is allocated before.
    """
    layout, body = _unfolded(path)
    blocks, start = [], 0
    for width in layout.widths:
        blocks.append(body[start : start + layout.count * width].reshape(layout.count, width))
        start += layout.count * width
    positions, alphas, colours, scales, rotations, higher = blocks
    fixed = np.zeros((layout.count, 3, 4), np.uint8)
    # Into the upper three bytes, so that the shift back carries the sign.
    fixed[:, :, 1:] = positions.reshape(-1, 3, 3)
    means = (fixed.view("<i4")[:, :, 0] >> 8) / 2.0**layout.bits
    quaternions = _three_smallest_read(rotations) if layout.version == 3 else _first_three_read(rotations)
    alpha = np.clip(alphas[:, 0] / 255.0, _ALPHA_EDGE, 1 - _ALPHA_EDGE)
    base = (colours / 255.0 - 0.5) / _COLOUR_SCALE
    rest = (higher.reshape(layout.count, layout.higher, 3).astype(np.float32) - 128) / 128
    if axes == "RUB":
        means, quaternions, rest = _half_turn(means, quaternions, rest)
    return Gaussians(
        means=_tensor(means),
        quaternions=_tensor(quaternions[:, [3, 0, 1, 2]]),
        log_scales=_tensor(scales / 16.0 - 10.0),
        opacity_logits=_tensor(np.log(alpha / (1 - alpha))),
        sh=_tensor(np.concatenate([base[:, None], rest], axis=1)),
    )


def write_spz(
    gaussians: Gaussians,
    path: Path,
    *,
    axes: Axes = "RDF",
    version: Literal[2, 3] = 3,
    progress: Progress = silent,
) -> None:
    """Write Gaussians as an SPZ file in one step, with the losses of the table above.

    As many fractional bits are used, up to 24, as leave room for the farthest mean.

    Parameters
    ----------
    axes:
        ``"RUB"`` turns our RDF as the format asks; ``"RDF"`` writes the numbers as they are (see above).
    version:
        3 is what gsply, splat-transform, Babylon and Niantic's library since 2025 read; 2 is for older readers
        and keeps rotations badly.

    Raises
    ------
    NumericalError
        Where a parameter is not finite in float32; the message names it and the row.
    DataError
        Where a mean is farther from the origin than 24 bits can say, or a rotation has length zero.
    RunError
        When the disk is full or the folder may not be written.
    """
    sh = finite_array(gaussians.sh, "sh")
    means = finite_array(gaussians.means, "means").astype(np.float64)
    quaternions = _unit_xyzw(finite_array(gaussians.quaternions, "quaternions").astype(np.float64))
    scales = finite_array(gaussians.log_scales, "log_scales").astype(np.float64)
    logits = finite_array(gaussians.opacity_logits, "opacity_logits").astype(np.float64)
    rest = sh[:, 1:]
    if axes == "RUB":
        means, quaternions, rest = _half_turn(means, quaternions, rest)
    layout = _Layout(version, len(means), gaussians.sh_degree, _fractional_bits(means))
    fixed = np.rint(means * 2.0**layout.bits).astype("<i4", order="C")
    blocks = (
        fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3],
        # The tanh is the sigmoid without its overflow.
        _byte((np.tanh(logits / 2) + 1) / 2 * 255),
        _byte((sh[:, 0].astype(np.float64) * _COLOUR_SCALE + 0.5) * 255),
        _byte((scales + 10) * 16),
        _three_smallest(quaternions) if version == 3 else _first_three(quaternions),
        _stepped(rest),
    )
    header = _HEADER.pack(_MAGIC, version, layout.count, layout.degree, layout.bits, 0, 0)
    content = memoryview(header + b"".join(block.tobytes() for block in blocks))
    packer = zlib.compressobj(wbits=31)
    with atomic_path(path) as temporary, temporary.open("wb") as handle:
        for start in track(range(0, len(content), _CHUNK), "spz.write", progress):
            handle.write(packer.compress(content[start : start + _CHUNK]))
        handle.write(packer.flush())


def _unfolded(path: Path) -> tuple[_Layout, Bytes]:
    """Return the layout and all bytes after the header, never unfolding more than the header asks for."""
    try:
        content = path.read_bytes()
    except FileNotFoundError as error:
        raise DataError(f"{path} is missing", expected="an SPZ file") from error
    except OSError as error:
        raise DataError(f"Cannot read {path}", expected="an SPZ file", found=str(error)) from error
    version = int.from_bytes(content[4:8], "little")
    if content[:4] == struct.pack("<I", _MAGIC) and version > 3:
        # From version 4 on the header lies open.
        raise _wrong_version(path, version)
    if content[:2] != b"\x1f\x8b":
        raise DataError(
            f"{path} is no SPZ file", expected="a gzip stream that begins 1f 8b", found=repr(content[:8])
        )
    unpacker = zlib.decompressobj(wbits=31)
    try:
        head = unpacker.decompress(content, _HEADER.size)
        if len(head) < _HEADER.size:
            raise _cut_off(path, f"a header of {_HEADER.size} bytes", f"{len(head)}")
        layout = _checked(head, len(content), path)
        body = unpacker.decompress(unpacker.unconsumed_tail, layout.size + 1)
    except zlib.error as error:
        raise _cut_off(path, "a sound gzip stream", str(error)) from error
    need = f"{layout.count} Gaussians of {sum(layout.widths)} bytes"
    if len(body) > layout.size or unpacker.unused_data:
        raise DataError(
            f"{path} is longer than its header says", expected=need, found="more", todo="Export it again"
        )
    if len(body) < layout.size:
        raise _cut_off(path, need, f"{len(body)} bytes for them")
    if not unpacker.eof:
        raise _cut_off(path, "the checksum of the gzip stream at its end", "the end of the file")
    return layout, np.frombuffer(body, np.uint8)


def _checked(head: bytes, size: int, path: Path) -> _Layout:
    """Return the layout of a header in a file of ``size`` bytes, or say what is wrong with it."""
    magic, version, count, degree, bits, flags, reserved = _HEADER.unpack(head)
    if magic != _MAGIC:
        raise DataError(
            f"{path} is no SPZ file", expected="the magic number b'NGSP' after unfolding", found=repr(head[:4])
        )
    if version not in (2, 3):
        raise _wrong_version(path, version)
    if degree > 3:
        raise DataError(
            f"{path} has spherical harmonics that cannot be read",
            expected="degree 0, 1, 2 or 3",
            found=f"degree {degree}",
            todo="Export it again with degree 3",
        )
    if bits > _MOST_BITS:
        raise DataError(f"{path} has odd positions", expected="0 to 24 fractional bits", found=str(bits))
    if flags & ~_ANTIALIASED or reserved:
        raise DataError(
            f"{path} has extensions or flags that are not known (an extension may change the axes)",
            expected="flags 0 or 1 and a reserved byte of 0",
            found=f"flags {flags} and reserved byte {reserved}",
            todo="Export it without extensions",
        )
    layout = _Layout(version, count, degree, bits)
    most = max(_ALWAYS_ALLOWED, _MOST_TIMES * size)
    if layout.size > most:
        raise DataError(
            f"{path} is cut off or lies, or was made to fill the memory",
            expected=f"at most {most} bytes from a file of {size}",
            found=f"{count} Gaussians of {sum(layout.widths)} bytes",
            todo="Copy or export it again",
        )
    return layout


def _wrong_version(path: Path, version: int) -> DataError:
    return DataError(
        f"{path} is of a version that cannot be read",
        expected="SPZ version 2 or 3",
        found=f"version {version}" + (" (Zstandard instead of gzip)" if version == 4 else ""),
        todo="Export it as version 3, or as PLY",
    )


def _cut_off(path: Path, expected: str, found: str) -> DataError:
    return DataError(
        f"{path} is cut off or damaged", expected=expected, found=found, todo="Copy or export it again"
    )


def _tensor(values: NDArray[Any]) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def _half_turn(
    means: NDArray[Any], quaternions: NDArray[Any], rest: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return means, quaternions (N, 4) ``xyzw`` and higher harmonics (N, K, 3) after half a turn about x."""
    # The frame turns at both ends of the rotation (world and ellipsoid), so that the components keep their places.
    turned = quaternions * np.append(_TURN_XYZ, 1)
    return means * _TURN_XYZ, turned, rest * _TURN_SH[: rest.shape[1]]


def _fractional_bits(means: NDArray[np.float64]) -> int:
    """Return the largest number of fractional bits with which all means fit."""
    farthest = float(np.abs(means).max(initial=0.0))
    for bits in range(_MOST_BITS, 0, -1):
        if np.rint(farthest * 2.0**bits) <= _LARGEST:
            return bits
    raise DataError(
        "The splat is too large for an SPZ file",
        expected=f"means of {-_LARGEST / 2:.0f} to {_LARGEST / 2:.0f} on each axis",
        found=f"{means.min():.6g} to {means.max():.6g}",
        todo="Move the scene to the origin, or write it as PLY",
    )


def _unit_xyzw(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit quaternions (N, 4) ``xyzw`` of those ``wxyz``."""
    lengths = np.linalg.norm(quaternions, axis=1, keepdims=True)
    zero = np.flatnonzero(lengths == 0)
    if len(zero):
        raise DataError(
            f"Cannot write a splat that has a rotation of length zero in row {zero[0]}",
            expected="a quaternion wxyz",
        )
    return quaternions[:, [1, 2, 3, 0]] / lengths


def _byte(values: NDArray[np.floating[Any]]) -> Bytes:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _stepped(rest: NDArray[np.float32]) -> Bytes:
    """Return higher harmonics (N, K, 3) as bytes at the centres of their steps; 128 is zero and such a centre."""
    step = np.where(np.arange(rest.shape[1]) < 3, _STEP_DEGREE_1, _STEP_HIGHER)[:, None]
    whole = np.rint(np.clip(rest, -1, 1) * 128) + 128
    return _byte(np.floor((whole + step // 2) / step) * step)


def _three_smallest(quaternions: NDArray[np.float64]) -> Bytes:
    """Return (N, 4) bytes: two bits name the largest of x, y, z, w, made positive; 10 for each other, in order."""
    largest = np.abs(quaternions).argmax(axis=1)
    values = np.take_along_axis(quaternions, largest[:, None], axis=1)
    small = np.take_along_axis(quaternions, _OTHERS[largest], axis=1) * np.where(values < 0, -1, 1)
    # No component but the largest exceeds sqrt(1/2).
    size = np.minimum(np.rint(np.abs(small) * np.sqrt(2) * 511), 511).astype(np.uint32)
    fields = size | (small < 0).astype(np.uint32) << 9
    packed = largest.astype(np.uint32) << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    return packed.astype("<u4").view(np.uint8).reshape(-1, 4)


def _three_smallest_read(packed: Bytes) -> NDArray[np.float64]:
    """Return quaternions (N, 4) ``xyzw``, the inverse of :func:`_three_smallest`."""
    words = np.ascontiguousarray(packed).view("<u4")
    largest = (words[:, 0] >> 30).astype(np.intp)
    fields = words >> np.array([20, 10, 0], np.uint32)
    small = (fields & 511) / 511 / np.sqrt(2) * np.where(fields & 512, -1, 1)
    quaternions = np.empty((len(packed), 4))
    np.put_along_axis(quaternions, _OTHERS[largest], small, axis=1)
    rest = np.sqrt(np.maximum(1 - (small**2).sum(axis=1, keepdims=True), 0))
    np.put_along_axis(quaternions, largest[:, None], rest, axis=1)
    return quaternions


def _first_three(quaternions: NDArray[np.float64]) -> Bytes:
    """Return (N, 3) bytes: x, y and z of the quaternion whose w is positive (version 2)."""
    return _byte(quaternions[:, :3] * np.where(quaternions[:, 3:] < 0, -127.5, 127.5) + 127.5)


def _first_three_read(packed: Bytes) -> NDArray[np.float64]:
    """Return quaternions (N, 4) ``xyzw``, the inverse of :func:`_first_three`."""
    xyz = packed / 127.5 - 1
    return np.concatenate([xyz, np.sqrt(np.maximum(1 - (xyz**2).sum(axis=1, keepdims=True), 0))], axis=1)
