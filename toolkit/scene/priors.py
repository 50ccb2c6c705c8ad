"""From what sensors say in degrees to priors in metres, for photos and for video alike."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from toolkit.geometry.attitude import Attitude, cam_from_enu
from toolkit.geometry.geodesy import enu_from_geodetic
from toolkit.scene.scene import Georeference, PosePrior


@dataclass(frozen=True, slots=True)
class GeodeticReading:
    """What sensors say of one picture.

    Attributes
    ----------
    position:
        WGS84 latitude and longitude in degrees and altitude in metres, or None.
    attitude:
        Of the camera, or None.
    position_sigma:
        Standard deviation east, north and up in metres, or None where unknown.
    angle_sigma:
        Standard deviation of the attitude about each camera axis in degrees, or None where unknown.
    """

    position: tuple[float, float, float] | None = None
    attitude: Attitude | None = None
    position_sigma: tuple[float, float, float] | None = None
    angle_sigma: float | None = None


def priors_from_readings(readings: Sequence[GeodeticReading], origin: Georeference) -> tuple[PosePrior | None, ...]:
    """Return a prior for each reading in metres east, north and up of ``origin``; None where nothing is known.

    The rotation is relative to east, north and up at the picture, which differ from those at the origin by 0.01
    degrees a kilometre.
    """
    placed = [reading.position for reading in readings if reading.position is not None]
    rows = iter(enu_from_geodetic(placed, (origin.latitude, origin.longitude, origin.altitude)))
    priors: list[PosePrior | None] = []
    for reading in readings:
        if reading.position is None and reading.attitude is None:
            priors.append(None)
            continue
        position, rotation = reading.position, reading.attitude
        sigma, angle = reading.position_sigma, reading.angle_sigma
        priors.append(
            PosePrior(
                position=None if position is None else next(rows),
                position_sigma=None if position is None or sigma is None else np.array(sigma, dtype=np.float64),
                rotation=None if rotation is None else cam_from_enu(rotation),
                rotation_sigma=None if rotation is None or angle is None else np.full(3, math.radians(angle)),
            )
        )
    return tuple(priors)
