"""Adam (Kingma and Ba 2015, algorithm 1) with a learning rate for every column: a fast update and its twin.

PyTorch's optimiser has one rate a tensor, and the colours of a Gaussian need two in one tensor; and here the state
is nothing but two tensors, which makes density control and exact checkpoints simple.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from toolkit.geometry.compiled import kernel, launching, parallel_kernel
from toolkit.geometry.simd import LANES, fma, root, splat, total
from toolkit.geometry.simd_memory import load, store

BETA1: Final = 0.9
BETA2: Final = 0.999
EPSILON: Final = 1e-15  # gradients of a mean over pixels are tiny; the value is that of Kerbl et al.'s code

_BLOCK: Final = 4096
_REST1: Final = np.float32(1 - BETA1)
_REST2: Final = np.float32(1 - BETA2)
Floats = NDArray[np.float32]


def adam_update(
    parameter: Tensor,
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    rates: Tensor,
    step: int,
    rows: Tensor | None = None,
) -> bool:
    """Move ``parameter`` one step, in place, and say whether gradient and parameter are finite.

    Parameters
    ----------
    parameter, gradient, first, second:
        (N, ...) float32: the parameter, its gradient, and the moments, which are updated in place.
    rates:
        Learning rates, of the shape of one row of the parameter.
    step:
        Number of this update, from 1 on, for the correction of the moments' bias.
    rows:
        (N,) bool: only these rows and their moments move; None: all.
    """
    if parameter.device.type != "cpu" or parameter.dtype != torch.float32:
        return adam_update_reference(parameter, gradient, first, second, rates, step, rows)
    # Whole vectors: a multiple of eight rows.
    pattern = rates.reshape(-1).repeat(LANES * max(1, _BLOCK // (LANES * max(1, rates.numel()))))
    sums = np.zeros(-(-parameter.numel() // len(pattern)), np.float32)
    with launching():
        _update_blocks(
            _flat(parameter),
            _flat(first),
            _flat(second),
            _flat(gradient.contiguous()),
            _flat(pattern),
            1 / (1 - BETA1**step),
            1 / math.sqrt(1 - BETA2**step),
            sums,
            None if rows is None else rows.numpy(),
            rates.numel(),
        )
    return bool(np.isfinite(sums).all())


def _flat(tensor: Tensor) -> Floats:
    """Return the memory of a contiguous tensor as a flat array: what is written there is in the tensor."""
    return tensor.detach().view(-1).numpy()


@parallel_kernel
def _update_blocks(
    parameter: Floats,
    first: Floats,
    second: Floats,
    gradient: Floats,
    pattern: Floats,
    scale_first: float,
    scale_second: float,
    sums: Floats,
    chosen: NDArray[np.bool_] | None,
    width: int,
) -> None:
    """Update flat arrays (n,) in blocks of ``len(pattern)``, or of their rows of ``width`` those that are chosen.

    ``sums`` (blocks,) become finite where everything in a block that was updated is.
    """
    size, n = len(pattern), len(parameter)
    for block in prange(len(sums)):
        start = np.uint64(block * size)
        end = min(np.uint64(n), start + np.uint64(size))
        arrays = parameter, first, second, gradient, pattern
        corrections = np.float32(scale_first), np.float32(scale_second)
        if chosen is None:
            sums[block] = _update_block(arrays, start, end, corrections)
        else:
            sums[block] = _update_chosen(arrays, start, end, corrections, chosen, np.uint64(width))


@kernel
def _update_chosen(
    arrays: tuple[Floats, ...],
    start: int,
    end: int,
    corrections: tuple[float, float],
    chosen: NDArray[np.bool_],
    width: int,
) -> float:
    """Update the chosen rows in ``[start, end)``, neighbours together; return as :func:`_update_block`."""
    first, last = start // width, end // width
    result = 0.0
    begin = np.uint64(first)  # of the chosen rows before this one
    for row in range(first, last):
        if not chosen[row]:
            if begin < row:
                result += _update_block(arrays, begin * width, row * width, corrections)
            begin = row + np.uint64(1)
    if begin < last:
        result += _update_block(arrays, begin * width, last * width, corrections)
    return result


@kernel
def _update_block(arrays: tuple[Floats, ...], start: int, end: int, corrections: tuple[float, float]) -> float:
    """Update ``[start, end)``, whole rows; return a number that is finite where everything in it is."""
    parameter, first, second, gradient, pattern = arrays
    correct1, correct2 = corrections
    lanes = np.uint64(LANES)
    whole = start + (end - start) // lanes * lanes
    sum8 = splat(0.0)
    for i in range(start, whole, lanes):
        g = load(gradient, i)
        m = fma(splat(BETA1), load(first, i), g * _REST1)
        v = fma(splat(BETA2), load(second, i), g * g * _REST2)
        x = load(parameter, i) - load(pattern, i - start) * (m * correct1) / fma(
            root(v), splat(correct2), splat(EPSILON)
        )
        store(first, i, m)
        store(second, i, v)
        store(parameter, i, x)
        sum8 = sum8 + x + g
    result = total(sum8)
    for i in range(whole, end):
        g = gradient[i]
        first[i] = np.float32(BETA1) * first[i] + _REST1 * g
        second[i] = np.float32(BETA2) * second[i] + _REST2 * g * g
        deviation = np.sqrt(second[i]) * correct2 + np.float32(EPSILON)
        parameter[i] -= pattern[i - start] * (first[i] * correct1) / deviation
        result += parameter[i] + g
    return result


def adam_update_reference(
    parameter: Tensor,
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    rates: Tensor,
    step: int,
    rows: Tensor | None = None,
) -> bool:
    """Do what :func:`adam_update` does, with torch operations, on any device and in any precision."""
    with torch.no_grad():
        if rows is not None:
            chosen, m, v = parameter[rows], first[rows], second[rows]
            finite = adam_update_reference(chosen, gradient[rows], m, v, rates, step)
            parameter[rows], first[rows], second[rows] = chosen, m, v
            return finite
        first.lerp_(gradient, 1 - BETA1)
        second.mul_(BETA2).addcmul_(gradient, gradient, value=1 - BETA2)
        mean = first / (1 - BETA1**step)
        deviation = (second / (1 - BETA2**step)).sqrt()
        parameter -= rates * mean / (deviation + EPSILON)
        return bool(torch.isfinite(gradient).all() & torch.isfinite(parameter).all())
