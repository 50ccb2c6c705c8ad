"""What networks see of positions and directions: sines and cosines, or spherical harmonics."""

from __future__ import annotations

import torch
from torch import Tensor


def frequency_encoding(values: Tensor, frequencies: int) -> Tensor:
    """Return values with their sines and cosines at growing frequencies (Mildenhall et al. 2020, equation 4).

    As in the authors' code the values themselves come first, and frequencies are powers of two without pi.

    Parameters
    ----------
    values:
        (N, D).
    frequencies:
        F.

    Returns
    -------
    encoded:
        (N, D (1 + 2 F)): the values, then for each frequency the sines and the cosines.
    """
    parts = [values]
    for power in range(frequencies):
        parts += [torch.sin(2.0**power * values), torch.cos(2.0**power * values)]
    return torch.cat(parts, dim=1)


def harmonics(directions: Tensor) -> Tensor:
    """Return the real spherical harmonics of degrees 0 to 3 (N, 16) of unit directions (N, 3).

    Signs and order are those of the Condon-Shortley phase left out, by degree and then order from negative to
    positive (Sloan 2013, appendix A2).
    """
    x, y, z = directions.unbind(dim=1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        [
            torch.full_like(x, 0.28209479177387814),
            0.4886025119029199 * y,
            0.4886025119029199 * z,
            0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * zz - 1),
            1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
            0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            0.4570457994644658 * y * (5 * zz - 1),
            0.3731763325901154 * z * (5 * zz - 3),
            0.4570457994644658 * x * (5 * zz - 1),
            1.445305721320277 * z * (xx - yy),
            0.5900435899266435 * x * (xx - 3 * yy),
        ],
        dim=1,
    )
