"""Where the sun stands."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np

_J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)


def sun_angles(time: datetime, latitude: float, longitude: float) -> tuple[float, float]:
    """Return the sun's azimuth, clockwise from north, and its elevation above the horizon, both in degrees.

    Low-precision formulas of the Astronomical Almanac (section C, "low precision formulas for the Sun"), in the
    arrangement of Michalsky, Solar Energy 40(3), 1988: within 0.01 degrees from 1950 to 2050. The air's refraction,
    0.02 degrees at 40 degrees of elevation, is left out, as is the parallax of 0.002.

    Parameters
    ----------
    time:
        With its time zone.
    latitude, longitude:
        In degrees, east positive.

    Raises
    ------
    ValueError
        For a time without zone.
    """
    if time.tzinfo is None:
        raise ValueError("expected a time with its zone, got one without")
    days = (time - _J2000).total_seconds() / 86400.0
    anomaly = np.radians(357.528 + 0.9856003 * days)
    mean_longitude = 280.460 + 0.9856474 * days
    ecliptic = np.radians(mean_longitude + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly))
    obliquity = np.radians(23.439 - 4e-7 * days)
    right_ascension = np.arctan2(np.cos(obliquity) * np.sin(ecliptic), np.cos(ecliptic))
    declination = np.arcsin(np.sin(obliquity) * np.sin(ecliptic))
    # Greenwich mean sidereal time: the stars gain 0.9856 degrees a day on the mean sun.
    sidereal = np.radians(280.46062 + 360.98564737 * days + longitude)
    hour_angle, phi = sidereal - right_ascension, np.radians(latitude)
    east = -np.cos(declination) * np.sin(hour_angle)
    north = np.sin(declination) * np.cos(phi) - np.cos(declination) * np.cos(hour_angle) * np.sin(phi)
    up = np.sin(declination) * np.sin(phi) + np.cos(declination) * np.cos(hour_angle) * np.cos(phi)
    return float(np.degrees(np.arctan2(east, north)) % 360.0), float(np.degrees(np.arcsin(up)))
