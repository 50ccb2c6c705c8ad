"""RPC cameras in PyTorch, so that pixels can be differentiated by places and by the corrections in the image.

The numbers are those of :mod:`toolkit.geometry.rpc` and :mod:`toolkit.geometry.rpc_camera`. Everything is float64:
a millionth of a degree is a decimetre.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from toolkit.errors import DataError
from toolkit.geometry.ellipsoid import BOWRING_ROUNDS, ECCENTRICITY2, RADIUS, enu_axes
from toolkit.geometry.geodesy import Origin, ecef_from_geodetic
from toolkit.geometry.rpc import Rpc
from toolkit.geometry.rpc_camera import RpcCamera


def project(rpc: Rpc, geodetic: Tensor, *, extrapolate: bool = False) -> Tensor:
    """Return pixels (..., 2), x and y with +0.5 at the centre of a pixel; autograd gives exact derivatives.

    Parameters
    ----------
    rpc:
        The polynomials.
    geodetic:
        (..., 3) float64: latitude and longitude in degrees, height in metres.
    extrapolate:
        Also take heights outside the RPC's range.

    Raises
    ------
    DataError
        For coordinates that are not float64 and for heights outside the RPC's range without ``extrapolate``.
    """
    _check_precision(geodetic)
    if not extrapolate:
        rpc.check_heights(geodetic[..., 2].detach().cpu().numpy())
    away = geodetic - geodetic.new_tensor(rpc.ground_offset)
    turns = torch.round(away[..., 1].detach() / 360.0)
    y, x, z = (
        away[..., 0] / rpc.latitude_scale,
        (away[..., 1] - 360.0 * turns) / rpc.longitude_scale,
        away[..., 2] / rpc.height_scale,
    )
    xx, yy, zz = x * x, y * y, z * z
    first = [torch.ones_like(x), x, y, z, x * y, x * z, y * z, xx, yy, zz]
    second = [x * y * z, xx * x, x * yy, x * zz, xx * y, yy * y, y * zz, xx * z, yy * z, zz * z]
    values = torch.stack(first + second, dim=-1)
    numerators = values @ geodetic.new_tensor([rpc.sample_num, rpc.line_num]).T
    denominators = values @ geodetic.new_tensor([rpc.sample_den, rpc.line_den]).T
    # Beyond a pole of the quotient there is no image: see Rpc.project.
    middle = geodetic.new_tensor([rpc.sample_den[0], rpc.line_den[0]])
    seen = (denominators * middle > 0).all(dim=-1, keepdim=True)
    quotient = numerators / torch.where(seen, denominators, torch.nan)
    scale = geodetic.new_tensor([rpc.sample_scale, rpc.line_scale])
    return quotient * scale + geodetic.new_tensor([rpc.sample_offset + 0.5, rpc.line_offset + 0.5])


def geodetic_from_enu(points: Tensor, origin: Origin) -> Tensor:
    """Return latitude and longitude in degrees and height in metres (..., 3) of metres east, north and up (..., 3).

    The iteration of :func:`toolkit.geometry.ellipsoid.geodetic_from_enu`. Raises :class:`DataError` for points that
    are not float64.
    """
    _check_precision(points)
    axes = points.new_tensor(enu_axes(origin[0], origin[1])[0])
    x, y, z = (points @ axes + points.new_tensor(ecef_from_geodetic([origin])[0])).unbind(-1)
    flat = math.sqrt(1.0 - ECCENTRICITY2)
    away = torch.hypot(x, y)
    above, aside = z / flat, away * flat
    for _ in range(BOWRING_ROUNDS + 1):
        length = torch.hypot(flat * above, aside)
        above, aside = (
            z + RADIUS * ECCENTRICITY2 / flat * (flat * above / length) ** 3,
            away - RADIUS * ECCENTRICITY2 * (aside / length) ** 3,
        )
    length = torch.hypot(above, aside)
    sine = above / length
    height = (away * aside + z * above) / length - RADIUS * torch.sqrt(1.0 - ECCENTRICITY2 * sine**2)
    latitude, longitude = torch.atan2(above, aside), torch.atan2(y, x)
    return torch.stack([torch.rad2deg(latitude), torch.rad2deg(longitude), height], dim=-1)


def project_camera(camera: RpcCamera, points: Tensor, correction: Tensor | None = None) -> Tensor:
    """Return pixels (..., 2) of points (..., 3) in metres east, north and up of the camera's origin.

    Parameters
    ----------
    camera:
        The camera; its ``extrapolate`` holds.
    points:
        (..., 3) float64.
    correction:
        (6,) to be used, and differentiated by, in place of the camera's own.

    Raises
    ------
    DataError
        As :func:`project` does.
    """
    own = project(camera.rpc, geodetic_from_enu(points, camera.origin), extrapolate=camera.extrapolate)
    rows = points.new_tensor(camera.correction) if correction is None else correction
    rows = rows.reshape(2, 3)
    away = (own - own.new_tensor(camera.centre)) / camera.half_side
    return own + rows[:, 0] + away @ rows[:, 1:].T


def _check_precision(values: Tensor) -> None:
    if values.dtype != torch.float64:
        raise DataError(
            "Places on the earth need double precision", expected="a float64 tensor", found=str(values.dtype)
        )
