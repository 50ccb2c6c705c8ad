"""Where satellite pictures lie on the ground, and which of them overlap there."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.rpc_camera import RpcCamera

Array = NDArray[np.float64]

# Heights at which footprints are compared: so many over the range of all RPCs, and each one's ends and middle.
_HEIGHTS = 9
# Metres by which ranges of heights that touch may be apart for rounding.
_ROUNDING = 1e-6


def footprint(camera: RpcCamera, altitude: float) -> Array:
    """Return the corners (4, 3) of a picture on the ground, in metres east, north and up of the camera's origin.

    The corners are those of the image, clockwise from the top left one, with the camera's correction.

    Parameters
    ----------
    camera:
        Of the picture.
    altitude:
        Metres above the ellipsoid; it may be outside the RPC's range.

    Raises
    ------
    DataError
        Where the RPC has no place for a corner.
    """
    width, height = camera.width, camera.height
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float64)
    return dataclasses.replace(camera, extrapolate=True).locate(corners, altitude)


def named_footprint(name: str, camera: RpcCamera, altitude: float) -> Array:
    """Return :func:`footprint`, with the picture's name in the error."""
    try:
        return footprint(camera, altitude)
    except DataError as error:
        raise DataError(f"The RPC of {name} has no footprint", found=str(error).rstrip(".")) from error


def overlapping_groups(cameras: Mapping[str, RpcCamera]) -> list[list[str]]:
    """Return which views hang together by overlapping on the ground, the largest group first.

    Two views overlap where their footprints do at some height that both RPCs were made for: what does not overlap
    by this shows no place in common.

    Parameters
    ----------
    cameras:
        By the views' names, of one origin.
    """
    ranges = {name: camera.rpc.height_range for name, camera in cameras.items()}
    lowest, highest = min(low for low, _ in ranges.values()), max(high for _, high in ranges.values())
    middles = [camera.rpc.height_offset for camera in cameras.values()]
    # The ends, too: ranges that only touch have no other height in common.
    altitudes = np.unique([*np.linspace(lowest, highest, _HEIGHTS), *middles, *np.ravel(list(ranges.values()))])
    corners = {
        name: {
            altitude: named_footprint(name, camera, altitude)[:, :2]
            for altitude in altitudes.tolist()
            if ranges[name][0] - _ROUNDING <= altitude <= ranges[name][1] + _ROUNDING
        }
        for name, camera in cameras.items()
    }
    group = {name: {name} for name in cameras}
    for one, other in itertools.combinations(cameras, 2):
        common = corners[one].keys() & corners[other].keys()
        if other not in group[one] and any(_overlap(corners[one][at], corners[other][at]) for at in common):
            joined = group[one] | group[other]
            group |= dict.fromkeys(joined, joined)
    order = {name: i for i, name in enumerate(cameras)}
    sets = {min(names, key=order.__getitem__): names for names in group.values()}
    return sorted((sorted(names, key=order.__getitem__) for names in sets.values()), key=len, reverse=True)


def _overlap(one: Array, other: Array) -> bool:
    """Return whether two convex polygons (n, 2) meet: no side keeps them apart (separating axis theorem)."""
    sides = np.concatenate([np.roll(polygon, -1, axis=0) - polygon for polygon in (one, other)])
    normals = np.stack([-sides[:, 1], sides[:, 0]])
    mine, theirs = one @ normals, other @ normals
    return bool(np.all((mine.max(axis=0) >= theirs.min(axis=0)) & (theirs.max(axis=0) >= mine.min(axis=0))))
