"""Splat PLY files in the layout of Kerbl et al. 2023 (INRIA), which SuperSplat, gsplat and others read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from toolkit.errors import DataError, NumericalError
from toolkit.scene.ply import read_vertices, write_vertices
from toolkit.splat.gaussians import Gaussians

# Stored for the sake of other readers; always zero.
_NORMALS = ("nx", "ny", "nz")
_MEANS = ("x", "y", "z")
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATERNION = ("rot_0", "rot_1", "rot_2", "rot_3")
_COLOUR = ("f_dc_0", "f_dc_1", "f_dc_2")
_NEEDED = (*_MEANS, *_COLOUR, "opacity", *_SCALES, *_QUATERNION)


def read_splats(path: Path) -> Gaussians:
    """Read Gaussians from a splat PLY file as float32 tensors on the CPU.

    Opacity is a logit, scales are logarithms, ``rot`` is a quaternion ``wxyz``, and ``f_rest`` holds first all
    coefficients of red, then of green, then of blue. Properties that are not known are not read.

    Raises
    ------
    DataError
        Where the file is damaged (see :func:`toolkit.scene.ply.read_vertices`), is no splat, has a number of
        ``f_rest`` that belongs to no degree, or numbers that are not finite; the message names row and field.
    """
    vertices = read_vertices(path)
    names = vertices.dtype.names or ()
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        packed = "packed_position" in names
        raise DataError(
            f"{path} holds no splat that can be read",
            expected=f"the properties {', '.join(_NEEDED)}",
            found="a compressed splat" if packed else f"no {', '.join(missing[:5])}",
            todo="Export it as an uncompressed PLY" if packed else "Is it a point cloud?",
        )
    rest = [name for name in names if name.startswith("f_rest_")]
    if len(rest) not in (0, 9, 24, 45) or set(rest) != {f"f_rest_{i}" for i in range(len(rest))}:
        raise DataError(
            f"{path} has a wrong number of spherical harmonics",
            expected="0, 9, 24 or 45 properties f_rest_0, f_rest_1, ...",
            found=str(len(rest)),
        )
    higher = _columns(vertices, tuple(f"f_rest_{i}" for i in range(len(rest))), path)
    higher = higher.reshape(len(vertices), 3, len(rest) // 3).transpose(0, 2, 1)
    base = _columns(vertices, _COLOUR, path)[:, None, :]
    quaternions = _columns(vertices, _QUATERNION, path)
    zero = np.flatnonzero(~quaternions.any(axis=1))
    if len(zero):
        raise DataError(f"{path} has a rotation of length zero in row {zero[0]}", expected="a quaternion wxyz")
    return Gaussians(
        means=torch.from_numpy(_columns(vertices, _MEANS, path)),
        quaternions=torch.from_numpy(quaternions),
        log_scales=torch.from_numpy(_columns(vertices, _SCALES, path)),
        opacity_logits=torch.from_numpy(_columns(vertices, ("opacity",), path)[:, 0].copy()),
        sh=torch.from_numpy(np.ascontiguousarray(np.concatenate([base, higher], axis=1))),
    )


def _columns(vertices: NDArray[Any], names: tuple[str, ...], path: Path) -> NDArray[np.float32]:
    """Return fields (N, len(names)) as float32, all finite."""
    with np.errstate(over="ignore"):
        table = structured_to_unstructured(vertices[list(names)], dtype=np.float32, copy=True)
    bad = np.argwhere(~np.isfinite(table))
    if len(bad):
        row, column = bad[0]
        raise DataError(
            f"{path} has a number that is not finite in row {row}, field {names[column]}",
            found=f"{vertices[names[column]][row]}, and {len(bad) - 1} more like it",
            todo="Export it again, or remove these Gaussians",
        )
    return table.reshape(len(vertices), len(names))


def write_splats(gaussians: Gaussians, path: Path) -> None:
    """Write Gaussians as a splat PLY file (float32, binary little-endian) in one step.

    Raises
    ------
    NumericalError
        Where a parameter is not finite in float32; the message names it and the row.
    RunError
        When the disk is full or the folder may not be written.
    """
    sh = finite_array(gaussians.sh, "sh")
    count, rest = len(sh), 3 * (sh.shape[1] - 1)
    blocks = {
        _MEANS: finite_array(gaussians.means, "means"),
        _NORMALS: np.zeros((count, 3), np.float32),
        _COLOUR: sh[:, 0, :],
        tuple(f"f_rest_{i}" for i in range(rest)): sh[:, 1:, :].transpose(0, 2, 1).reshape(count, rest),
        ("opacity",): finite_array(gaussians.opacity_logits, "opacity_logits")[:, None],
        _SCALES: finite_array(gaussians.log_scales, "log_scales"),
        _QUATERNION: finite_array(gaussians.quaternions, "quaternions"),
    }
    names = [name for block in blocks for name in block]
    table = np.concatenate(list(blocks.values()), axis=1).astype("<f4")
    write_vertices(table.view([(name, "<f4") for name in names])[:, 0], path)


def finite_array(parameter: torch.Tensor, name: str) -> NDArray[np.float32]:
    """Return a parameter as float32 on the CPU, all finite.

    Raises
    ------
    NumericalError
        Where it is not; the message names it by ``name``, and the row.
    """
    values = parameter.detach().to(device="cpu", dtype=torch.float32).numpy()
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        raise NumericalError(
            f"Cannot write a splat whose {name} are not finite",
            found=f"{values[tuple(bad[0])]} in row {bad[0][0]}, and {len(bad) - 1} more",
        )
    return values
