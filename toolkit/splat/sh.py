"""Real spherical harmonics up to degree 3, in the order and with the signs of INRIA's Gaussian splats.

The basis is that of Sloan, Efficient Spherical Harmonic Evaluation (JCGT 2013), with the Condon-Shortley phase.
"""

from __future__ import annotations

import torch
from torch import Tensor

from toolkit.errors import DataError
from toolkit.splat.gaussians import SH_C0

SH_C1 = 0.4886025119029199  # sqrt(3 / (4 pi))
SH_C2_XY = 1.0925484305920792  # sqrt(15 / (4 pi))
SH_C2_ZZ = 0.31539156525252005  # sqrt(5 / (16 pi))
SH_C2_XX_YY = 0.5462742152960396  # sqrt(15 / (16 pi))
SH_C3_3 = 0.5900435899266435  # sqrt(35 / (32 pi))
SH_C3_2 = 2.890611442640554  # sqrt(105 / (4 pi))
SH_C3_1 = 0.4570457994644658  # sqrt(21 / (32 pi))
SH_C3_0 = 0.3731763325901154  # sqrt(7 / (16 pi))
SH_C3_2_XX_YY = 1.445305721320277  # sqrt(105 / (16 pi))


def sh_basis(degree: int, directions: Tensor) -> Tensor:
    """Return the (N, (degree + 1)^2) values of the basis functions in unit directions (N, 3).

    Raises
    ------
    DataError
        Where the degree is not 0, 1, 2 or 3.
    """
    if degree not in (0, 1, 2, 3):
        raise DataError("Unknown degree of spherical harmonics", expected="0, 1, 2 or 3", found=str(degree))
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        basis += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis += [
            SH_C2_XY * x * y,
            -SH_C2_XY * y * z,
            SH_C2_ZZ * (2 * zz - xx - yy),
            -SH_C2_XY * x * z,
            SH_C2_XX_YY * (xx - yy),
        ]
    if degree >= 3:
        basis += [
            -SH_C3_3 * y * (3 * xx - yy),
            SH_C3_2 * x * y * z,
            -SH_C3_1 * y * (4 * zz - xx - yy),
            SH_C3_0 * z * (2 * zz - 3 * xx - 3 * yy),
            -SH_C3_1 * x * (4 * zz - xx - yy),
            SH_C3_2_XX_YY * z * (xx - yy),
            -SH_C3_3 * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, dim=-1)


def eval_sh(degree: int, sh: Tensor, directions: Tensor) -> Tensor:
    """Return the sum of coefficients times basis functions.

    Parameters
    ----------
    degree:
        0 to 3; coefficients of higher degrees are not used.
    sh:
        (N, K, 3) coefficients, K at least (degree + 1)^2.
    directions:
        (N, 3) of length one, from the camera centre to the Gaussian.

    Returns
    -------
    Tensor
        (N, 3); the colour of a Gaussian is this plus 0.5, cut off at zero.

    Raises
    ------
    DataError
        Where the degree is unknown or fewer coefficients are stored than it needs.
    """
    basis = sh_basis(degree, directions)
    count = basis.shape[-1]
    if sh.shape[1] < count:
        raise DataError(
            f"Too few spherical harmonics for degree {degree}", expected=f"{count} or more", found=str(sh.shape[1])
        )
    return torch.einsum("nk,nkc->nc", basis, sh[:, :count])
