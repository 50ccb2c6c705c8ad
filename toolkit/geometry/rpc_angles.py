"""From where a satellite looks: exactly, from its RPC at two heights, and by the paper's heuristic.

An RPC says along which line a pixel is seen, not where on that line the satellite was. So the angles are those at
the ground: the zenith angle (also called incidence angle) between the ellipsoid's normal and the direction to the
satellite, and the azimuth of that direction. The off-nadir angle, at the satellite, is smaller by the curvature of
the earth, and needs the orbit's height: :func:`off_nadir_angle`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError
from toolkit.geometry.ellipsoid import RADIUS
from toolkit.geometry.geodesy import Origin, enu_from_geodetic
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.rpc import Rpc

Array = NDArray[np.float64]

#: Mean radius of the earth in metres.
_MEAN_RADIUS = 6371008.8
#: Most metres above the RPC's middle height that the upper of the two places of a ray is.
_REACH = 500.0
#: The authors' notebook lets no off-nadir angle grow beyond this, in degrees.
_PAPER_CAP = 45.0


@dataclass(frozen=True, eq=False)
class ViewingRay:
    """The line on which a pixel is seen, at the ground.

    Attributes
    ----------
    zenith_deg:
        Angle between the ellipsoid's normal and the direction to the satellite: the incidence angle.
    azimuth_deg:
        Direction towards the satellite, clockwise from north, 0 to 360; of no meaning where the zenith angle is 0.
    direction:
        (3,) unit vector from the ground to the satellite in metres east, north and up of the ground point.
    ground:
        (3,) latitude and longitude in degrees and height in metres of the ground point.
    """

    zenith_deg: float
    azimuth_deg: float
    direction: Array
    ground: Array

    def to_dict(self) -> dict[str, Any]:
        """Return angles, direction and place as plain numbers."""
        return {
            "zenith_deg": self.zenith_deg,
            "azimuth_deg": self.azimuth_deg,
            "direction": self.direction.tolist(),
            "ground": self.ground.tolist(),
        }


@dataclass(frozen=True, eq=False)
class PaperView:
    """What the paper's heuristic takes for the view of a picture.

    Attributes
    ----------
    off_nadir_deg, azimuth_deg:
        Its angles; the azimuth is used as if clockwise from north.
    position:
        (3,) of the satellite in metres east, north and up.
    direction:
        (3,) unit vector from the ground point to that position.
    cam_from_world:
        Its rotation and translation, in a frame of east, north and up with x right, y down and z forward.
    """

    off_nadir_deg: float
    azimuth_deg: float
    position: Array
    direction: Array
    cam_from_world: RigidTransform

    def to_dict(self) -> dict[str, Any]:
        """Return angles and position as plain numbers."""
        return {
            "off_nadir_deg": self.off_nadir_deg,
            "azimuth_deg": self.azimuth_deg,
            "position": self.position.tolist(),
        }


def viewing_ray(
    rpc: Rpc,
    pixel: ArrayLike | None = None,
    *,
    heights: tuple[float, float] | None = None,
    extrapolate: bool = False,
) -> ViewingRay:
    """Return the viewing ray of a pixel, from its places at two heights.

    Parameters
    ----------
    rpc:
        The polynomials.
    pixel:
        (2,) x and y, +0.5 at the centre of a pixel; by default the middle of the RPC's picture (its offsets), which
        for an RPC that was cropped is not the middle of the piece.
    heights:
        Lower and upper height in metres; the ray starts at the lower one. By default the RPC's middle height and
        the upper end of its range, but at most 500 m above.
    extrapolate:
        Also take heights outside the RPC's range.

    Raises
    ------
    DataError
        For heights in the wrong order and what :meth:`toolkit.geometry.rpc.Rpc.locate` raises.
    """
    place = (
        np.array([rpc.sample_offset + 0.5, rpc.line_offset + 0.5]) if pixel is None else np.asarray(pixel, float)
    )
    low, high = heights or (rpc.height_offset, rpc.height_offset + min(abs(rpc.height_scale), _REACH))
    if not high > low:
        raise DataError(
            "A viewing ray needs two heights",
            expected="the lower and then the upper one",
            found=f"{low} and {high} m",
        )
    ground, above = rpc.locate(np.stack([place.reshape(2)] * 2), np.array([low, high]), extrapolate=extrapolate)
    away = enu_from_geodetic(above, (ground[0], ground[1], ground[2]))[0]
    direction = away / np.linalg.norm(away)
    return ViewingRay(
        zenith_deg=math.degrees(math.atan2(math.hypot(direction[0], direction[1]), direction[2])),
        azimuth_deg=math.degrees(math.atan2(direction[0], direction[1])) % 360.0,
        direction=direction,
        ground=ground,
    )


def off_nadir_angle(zenith_deg: float, orbit_height: float) -> float:
    """Return the angle in degrees at the satellite between its nadir and the line of sight, on a spherical earth.

    Parameters
    ----------
    zenith_deg:
        The zenith angle at the ground.
    orbit_height:
        Metres of the satellite above the ground; an RPC does not tell it.

    Raises
    ------
    DataError
        For a height that is not positive.
    """
    if not orbit_height > 0:
        raise DataError("A satellite needs a height", expected="metres above zero", found=str(orbit_height))
    sine = math.sin(math.radians(zenith_deg)) * _MEAN_RADIUS / (_MEAN_RADIUS + orbit_height)
    return math.degrees(math.asin(sine))


def paper_angles(
    rpc: Rpc, *, gain: float = 15.0, orbit_height: float = 500e3, origin: Origin | None = None
) -> PaperView:
    """Return a picture's view by the paper's heuristic (sections 4.1.2 and 4.1.3), for comparison only.

    With n_l and n_s the coefficients of height in the numerators of line and sample, whatever the scales are, the
    off-nadir angle is ``gain * atan(sqrt(n_l^2 + n_s^2))``, at most 45 degrees, and the azimuth
    ``atan2(n_s, n_l)``. The paper says so in words; the formulas, a gain of 15, an orbit of 500 km, the position
    ``h tan(off-nadir) (sin azimuth, cos azimuth)`` on a flat earth and the rotation are those of the authors'
    notebooks ``best_worest_views.ipynb`` and ``extracting_extriniscs.ipynb``. The latter takes a gain of 30, and
    counts its x to the west: here it is turned back to the east.

    Parameters
    ----------
    rpc:
        The polynomials.
    gain:
        Factor on the angle: 15 or 30 in the notebooks.
    orbit_height:
        Metres.
    origin:
        Latitude, longitude and altitude of the frame's origin; the ground point is the middle of the RPC's volume.
        By default the ground point is the origin, as where the notebook selects views. The other notebook takes the
        first picture's place, and altitude 0.
    """
    by_line, by_sample = rpc.line_num[3], rpc.sample_num[3]
    off_nadir = min(_PAPER_CAP, gain * math.degrees(math.atan(math.hypot(by_line, by_sample))))
    azimuth = math.degrees(math.atan2(by_sample, by_line)) % 360.0
    theta, alpha = math.radians(off_nadir), math.radians(azimuth)
    direction = np.array([math.sin(theta) * math.sin(alpha), math.sin(theta) * math.cos(alpha), math.cos(theta)])
    ground = np.zeros(3)
    if origin is not None:
        latitude, longitude = math.radians(origin[0]), math.radians(origin[1])
        ground[0] = RADIUS * math.cos(latitude) * (math.radians(rpc.longitude_offset) - longitude)
        ground[1] = RADIUS * (math.radians(rpc.latitude_offset) - latitude)
        ground[2] = rpc.height_offset - origin[2]
    position = ground + orbit_height / math.cos(theta) * direction
    rotation = _paper_rotation(theta, alpha)
    return PaperView(off_nadir, azimuth, position, direction, RigidTransform(rotation, -rotation @ position))


def _paper_rotation(theta: float, alpha: float) -> Array:
    """Return the notebook's rotation from world to camera, its x axis turned from west to east."""
    down = np.diag([-1.0, 1.0, -1.0])
    tilt = np.array(
        [
            [1.0, 0.0, 0.0],
            [0.0, math.cos(theta), -math.sin(theta)],
            [0.0, math.sin(theta), math.cos(theta)],
        ]
    )
    turn = np.array(
        [
            [math.cos(alpha), math.sin(alpha), 0.0],
            [math.sin(alpha), -math.cos(alpha), 0.0],
            [0.0, 0.0, 1.0],
        ]
    )
    rotation: Array = (turn @ tilt @ down).T @ np.diag([-1.0, 1.0, 1.0])
    return rotation
