"""Files of visual words: checked before they are loaded.

A tree of binary words, k branches wide and L levels deep (Galvez-Lopez and Tardos, "Bags of binary words for fast
place recognition in image sequences", T-RO 2012), in the text format of DBoW2 as ORB-SLAM reads it: a line
``k L scoring weighting``, then for each node but the root ``parent is_leaf b0 ... b31 weight``. Nodes are numbered
by their lines from 1; the root is 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError

#: ORB-SLAM3 sorts features into buckets by the node this many levels above the words.
BUCKET_LEVELS = 4
#: Of an ORB descriptor.
BYTES = 32
_LINES_AT_ONCE = 50_000
_FORMAT = "a vocabulary in DBoW2's text format"
_NODE = np.dtype([("parent", "i8"), ("leaf", "i8"), ("bytes", "i8", (BYTES,)), ("weight", "f8")])


@dataclass(frozen=True, slots=True)
class VocabularyShape:
    """What :func:`check_vocabulary` found in a file."""

    branches: int
    levels: int
    nodes: int
    words: int


def check_vocabulary(path: Path) -> VocabularyShape:
    """Read a vocabulary to its end; ORB-SLAM3 itself ends without a word where one is damaged.

    Raises
    ------
    DataError
        Where the file is missing, cut off or damaged, the tree contradicts itself, or it has fewer than 5 levels;
        the message names the line.
    """
    try:
        lines = path.read_text(encoding="ascii").split("\n")
    except FileNotFoundError as error:
        raise DataError(
            f"Vocabulary {path} is missing", todo="Train one: toolkit vocabulary PICTURES_FOLDER OUT"
        ) from error
    except (OSError, ValueError) as error:
        raise DataError(f"Cannot read the vocabulary {path}", expected=_FORMAT, found=str(error)) from error
    if lines[-1] == "":
        lines.pop()
    branches, levels = _header(path, lines)
    parents, leaf = _nodes(path, lines[1:])
    _check_tree(path, parents, leaf, branches, levels)
    return VocabularyShape(branches, levels, len(parents) - 1, int(leaf.sum()))


def _header(path: Path, lines: Sequence[str]) -> tuple[int, int]:
    words = lines[0].split() if lines else []
    numbers = [int(word) for word in words if word.isdecimal() and len(word) < 4]
    low, high = (2, BUCKET_LEVELS + 1, 0, 0), (20, 10, 5, 3)
    if (
        len(words) != 4
        or len(numbers) != 4
        or not all(a <= n <= b for a, n, b in zip(low, numbers, high, strict=True))
    ):
        raise _bad(
            path,
            1,
            "'k L scoring weighting' with 2 to 20 branches, 5 to 10 levels, scoring 0 to 5 and weighting 0 to 3",
            repr(lines[0][:60]) if lines else "nothing",
        )
    return numbers[0], numbers[1]


def _nodes(path: Path, lines: Sequence[str]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the parent of each node and whether it is a leaf, the root (its own parent) first."""
    parents, leaves = [np.zeros(1, np.int64)], [np.zeros(1, np.bool_)]
    for first in range(0, len(lines), _LINES_AT_ONCE):
        some = lines[first : first + _LINES_AT_ONCE]
        try:
            read = _parsed(some)
        except ValueError as error:
            raise _first_bad(path, some, first) from error
        numbers = np.arange(first + 1, first + 1 + len(read))
        for wrong, expected in (
            ((read["parent"] < 0) | (read["parent"] >= numbers), "a parent that came before"),
            ((read["leaf"] != 0) & (read["leaf"] != 1), "0 or 1 in the second place"),
            (((read["bytes"] < 0) | (read["bytes"] > 255)).any(axis=1), "32 bytes of 0 to 255"),
            (~(np.isfinite(read["weight"]) & (read["weight"] >= 0)), "a finite weight that is not negative"),
        ):
            if wrong.any():
                at = int(np.argmax(wrong))
                raise _bad(path, first + at + 2, expected, repr(some[at][:80]))
        parents.append(read["parent"])
        leaves.append(read["leaf"] == 1)
    return np.concatenate(parents), np.concatenate(leaves)


def _parsed(lines: Sequence[str]) -> NDArray[Any]:
    # loadtxt passes over empty lines, and warns where nothing is left.
    if any(not line.strip() for line in lines):
        raise ValueError("an empty line")
    return np.loadtxt(lines, dtype=_NODE, comments=None, ndmin=1)


def _first_bad(path: Path, lines: Sequence[str], first: int) -> DataError:
    for number, line in enumerate(lines):
        try:
            _parsed([line])
        except ValueError:
            return _bad(path, first + number + 2, "'parent is_leaf b0 ... b31 weight'", repr(line[:80]))
    raise AssertionError("lines that can be read one by one can be read together")


def _check_tree(
    path: Path, parents: NDArray[np.int64], leaf: NDArray[np.bool_], branches: int, levels: int
) -> None:
    if len(parents) < 3:
        raise _bad(path, len(parents), "a tree of at least two words", "the end of the file")
    depth = np.zeros(len(parents), np.int64)
    above = np.arange(len(parents))
    for _ in range(levels + 1):
        depth += above != 0
        above = parents[above]
    children = np.bincount(parents[1:], minlength=len(parents))
    for wrong, expected in (
        (depth > levels, f"at most the {levels} levels of the first line"),
        (children > branches, f"at most the {branches} children of the first line"),
        (leaf & (children > 0), "no children of a word (a leaf)"),
        (~leaf & (children == 0), "children of a node that is no word"),
        (leaf & (depth < levels - BUCKET_LEVELS), f"words at level {levels - BUCKET_LEVELS} or below"),
    ):
        if wrong.any():
            node = int(np.argmax(wrong))
            raise _bad(
                path, node + 1, expected, f"node {node} at level {depth[node]} with {children[node]} children"
            )


def _bad(path: Path, line: int, expected: str, found: str) -> DataError:
    return DataError(
        f"Vocabulary {path}, line {line} is damaged",
        expected=expected,
        found=found,
        todo="Train it anew: toolkit vocabulary PICTURES_FOLDER OUT",
    )
