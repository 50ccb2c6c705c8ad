"""Text files of numbers, one pose a line, read strictly: what every trajectory format has in common."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError

Array = NDArray[np.float64]

#: Far above what 17 numbers of 25 characters need.
_LONGEST_LINE = 4096
#: Truth files of TUM have four digits: their quaternions are off by up to 1e-4.
_QUATERNION_TOLERANCE = 1e-3
#: Files of six digits are off by up to 1e-6 (KITTI), those of four by 1e-4.
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True)
class Row:
    """A line of numbers: its place in the file (from 1), words, their values, and whether commas part them."""

    line: int
    words: tuple[str, ...]
    values: tuple[float, ...]
    commas: bool


def number_rows(path: Path, kind: str, widths: Sequence[int], *, comma: bool = False) -> list[Row]:
    """Return the lines of a text file as finite numbers; blank lines and those that begin with ``#`` are skipped.

    A last line of numbers without a line break is refused: a file that was cut off inside its last number looks
    like that, and the number that is left of it is still one.

    Parameters
    ----------
    path:
        Of the file.
    kind:
        What the file should be, for messages.
    widths:
        How many numbers a line may have. All lines have as many as the first.
    comma:
        Numbers may stand between commas; a line without commas is split at white space.

    Raises
    ------
    DataError
        Where the file is missing, unreadable, empty, cut off, or a line is no text, too long, or not as many finite
        numbers as needed; the message names file and line.
    """
    try:
        with path.open("rb") as handle:
            rows = [_row(line, text, path, widths, comma) for line, text in _lines(handle, path, kind)]
    except FileNotFoundError as error:
        raise DataError(f"{path} is missing", expected=kind) from error
    except OSError as error:
        raise DataError(f"Cannot read {path}", expected=kind, found=str(error)) from error
    if not rows:
        raise DataError(f"{path} is empty", expected=kind, found="no line of numbers")
    for row in rows:
        if len(row.values) != len(rows[0].values):
            raise _ragged(path, row.line, f"{len(rows[0].values)} numbers as in the lines before", len(row.values))
    return rows


def _lines(handle: BinaryIO, path: Path, kind: str) -> Iterator[tuple[int, str]]:
    number = 0
    # Read with a limit, so that a huge file without line breaks is not taken into memory.
    while line := handle.readline(_LONGEST_LINE + 1):
        number += 1
        if len(line) > _LONGEST_LINE:
            raise DataError(
                f"{path}, line {number} is too long",
                expected=f"{kind}, at most {_LONGEST_LINE} bytes a line",
                found=repr(line[:40]),
            )
        try:
            # Windows' editors put a mark before the text.
            text = line.decode("utf-8-sig" if number == 1 else "utf-8").strip()
        except UnicodeDecodeError as error:
            raise DataError(f"{path}, line {number} is no text", expected=kind, found=repr(line[:40])) from error
        if not text or text.startswith("#"):
            continue
        if not line.endswith(b"\n"):
            raise DataError(
                f"{path}, line {number} is cut off",
                expected="a line break after the last line",
                found=repr(line[-40:]),
                todo="Copy the file again, or end its last line where you know that it is whole",
            )
        yield number, text


def _row(line: int, text: str, path: Path, widths: Sequence[int], comma: bool) -> Row:
    commas = comma and "," in text
    words = tuple(word.strip() for word in text.split(",")) if commas else tuple(text.split())
    values = []
    for word in words:
        try:
            # float() also takes 1_000 and digits of other scripts, which no writer of trajectories means.
            values.append(float(word) if word.isascii() and "_" not in word else float("no"))
        except ValueError as error:
            raise DataError(
                f"{path}, line {line} is no line of numbers",
                expected=f"{_choice(widths)} numbers{' or a comment (#)' if line == 1 else ''}",
                found=repr(word[:40]),
            ) from error
    if len(words) not in widths:
        raise _ragged(path, line, f"{_choice(widths)} numbers", len(words))
    bad = next((word for word, value in zip(words, values, strict=True) if not math.isfinite(value)), None)
    if bad is not None:
        raise DataError(f"{path}, line {line} is not finite", expected="finite numbers", found=repr(bad[:40]))
    return Row(line, words, tuple(values), commas)


def _choice(widths: Sequence[int]) -> str:
    return " or ".join(str(width) for width in widths)


def _ragged(path: Path, line: int, expected: str, found: int) -> DataError:
    return DataError(f"{path}, line {line} has a wrong number of values", expected=expected, found=str(found))


def check_quaternions(quaternions: Array, where: Callable[[int], str]) -> None:
    """Refuse quaternions (N, 4) that are not of length one to 1e-3; ``where(i)`` names row ``i`` in the message.

    Raises
    ------
    DataError
        For the first that is not.
    """
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(quaternions, axis=1)
    bad = np.flatnonzero(~(np.abs(lengths - 1) <= _QUATERNION_TOLERANCE))
    if len(bad):
        raise DataError(
            f"The quaternion in {where(int(bad[0]))} is none",
            expected=f"length 1 within {_QUATERNION_TOLERANCE:g}",
            found=f"length {lengths[bad[0]]:.6g}",
        )


def nearest_rotations(matrices: Array, where: Callable[[int], str]) -> Array:
    """Return the rotations (N, 3, 3) nearest to ``matrices``, which few digits have left a little beside them.

    The orthogonal factor of the polar decomposition is nearest in the Frobenius norm (Higham, "Computing the polar
    decomposition", 1986).

    Raises
    ------
    DataError
        For the first matrix with ``|M M^T - I| > 1e-3`` or a mirror; ``where(i)`` names it in the message.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero(~(off <= _ROTATION_TOLERANCE))
    if len(bad):
        raise DataError(
            f"The rotation in {where(int(bad[0]))} is none",
            expected=f"orthonormal rows within {_ROTATION_TOLERANCE:g}",
            found=f"rows off by {off[bad[0]]:.3g}",
        )
    mirrored = np.flatnonzero(np.linalg.det(matrices) < 0)
    if len(mirrored):
        raise DataError(
            f"The rotation in {where(int(mirrored[0]))} is none", expected="determinant 1", found="a mirror"
        )
    left, _, right = np.linalg.svd(matrices)
    rotations: Array = left @ right
    return rotations
