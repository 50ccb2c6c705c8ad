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

from toolkit.splat.cpu.kernels import launching, parallel_kernel

BETA1: Final = 0.9
BETA2: Final = 0.999
EPSILON: Final = 1e-15  # gradients of a mean over pixels are tiny; the value is that of Kerbl et al.'s code

_BLOCK: Final = 4096
Floats = NDArray[np.float32]


def adam_update(
    parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, rates: Tensor, step: int
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
    """
    if parameter.device.type != "cpu" or parameter.dtype != torch.float32:
        return adam_update_reference(parameter, gradient, first, second, rates, step)
    pattern = rates.reshape(-1).repeat(max(1, _BLOCK // max(1, rates.numel())))
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
) -> None:
    """Update flat arrays (n,) in blocks of ``len(pattern)``.

    ``sums`` (blocks,) become finite where everything in a block is.
    """
    beta1, beta2, epsilon = np.float32(BETA1), np.float32(BETA2), np.float32(EPSILON)
    rest1, rest2 = np.float32(1 - BETA1), np.float32(1 - BETA2)
    correct1, correct2 = np.float32(scale_first), np.float32(scale_second)
    size, n = len(pattern), len(parameter)
    for block in prange(len(sums)):
        start = block * size
        end = min(n, start + size)
        x, m, v, g = parameter[start:end], first[start:end], second[start:end], gradient[start:end]
        total = np.float32(0)
        for i in range(end - start):
            m[i] = beta1 * m[i] + rest1 * g[i]
            v[i] = beta2 * v[i] + rest2 * g[i] * g[i]
            x[i] -= pattern[i] * (m[i] * correct1) / (np.sqrt(v[i]) * correct2 + epsilon)
            total += x[i] + g[i]
        sums[block] = total


def adam_update_reference(
    parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, rates: Tensor, step: int
) -> bool:
    """Do what :func:`adam_update` does, with torch operations, on any device and in any precision."""
    with torch.no_grad():
        first.lerp_(gradient, 1 - BETA1)
        second.mul_(BETA2).addcmul_(gradient, gradient, value=1 - BETA2)
        mean = first / (1 - BETA1**step)
        deviation = (second / (1 - BETA2**step)).sqrt()
        parameter -= rates * mean / (deviation + EPSILON)
        return bool(torch.isfinite(gradient).all() & torch.isfinite(parameter).all())
