"""Gaussians in another frame: moved, scaled and, where their colours allow it, turned."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
import torch

from toolkit.errors import CapabilityError
from toolkit.geometry.alignment import Similarity
from toolkit.geometry.rigid import RigidTransform, rotation_angle
from toolkit.splat.chain import in_world
from toolkit.splat.gaussians import Gaussians

#: Rotations by less, in radians, are rounding.
_NO_TURN: Final = 1e-12


def scaled(gaussians: Gaussians, similarity: Similarity) -> Gaussians:
    """Return the Gaussians as ``similarity`` maps their world: centres and sizes; they look the same from there.

    Parameters
    ----------
    gaussians:
        In source units.
    similarity:
        ``target_from_source``. It may turn only Gaussians of degree 0, whose colours do not depend on the
        direction.

    Raises
    ------
    CapabilityError
        For a rotation where spherical harmonics have a degree above 0: they would have to turn as well.
    """
    turned = gaussians
    if rotation_angle(similarity.rotation) > _NO_TURN:
        if gaussians.sh_degree > 0:
            raise CapabilityError(
                "Gaussians whose colours depend on the direction are not turned",
                expected="a similarity without rotation, or spherical harmonics of degree 0",
                found=f"{math.degrees(rotation_angle(similarity.rotation)):.3g} degrees and degree "
                f"{gaussians.sh_degree}",
            )
        turned = in_world(gaussians, RigidTransform(similarity.rotation.T, np.zeros(3)))
    # Double precision until the end: a middle far from the origin would cost digits.
    means = similarity.scale * turned.means.double() + torch.from_numpy(similarity.translation).to(
        turned.means.device
    )
    return replace(
        turned,
        means=means.to(turned.means.dtype),
        log_scales=turned.log_scales + math.log(similarity.scale),
    )
