"""What the city is, how the satellite passes over it, and what its camera does to the light."""

from __future__ import annotations

from toolkit.settings import Choice, Group, Integer, Number, Settings


class PlanSettings(Settings):
    """The ground and what stands on it; what stands where comes from the seed."""

    size = Number(256.0, bounds=(32.0, 1024.0), unit="m", doc="Side of the square whose surface is the truth.")
    tallest = Number(60.0, bounds=(20.0, 120.0), unit="m", doc="Height of the tallest walls over the ground.")
    relief = Number(
        3.0, bounds=(0.0, 20.0), unit="m", doc="How far the ground rises above and falls below its mean."
    )
    trees = Number(1.0, bounds=(0.0, 4.0), doc="Number of trees over the usual one.")


class OrbitSettings(Settings):
    """A circular orbit, about sun-synchronous as WorldView-3's, and which of its passes are used."""

    views = Integer(20, bounds=(1, 200), unit="views", doc="Pictures, each from a pass on another day.")
    altitude = Number(617.0, bounds=(300.0, 1200.0), unit="km", doc="Height of the orbit over the equator.")
    inclination = Number(97.97, bounds=(60.0, 120.0), unit="degrees", doc="Inclination of the orbit.")
    off_nadir = Number(
        30.0, bounds=(1.0, 40.0), unit="degrees", doc="Largest angle at the satellite between nadir and the city."
    )
    node_time = Number(
        10.5,
        bounds=(8.0, 16.0),
        unit="h",
        doc="Mean solar time at which the satellite crosses the equator southwards.",
    )
    year = Integer(2023, bounds=(1950, 2049), doc="Year over which the pictures are spread.")


class ImagerSettings(Settings):
    """A line camera, the air below it and the error of its delivered RPCs."""

    ground_sampling = Number(
        0.5, bounds=(0.1, 5.0), unit="m", doc="Side of a pixel on the ground at the nadir; it grows with the range."
    )
    bands = Choice("rgb", choices=("rgb", "pan"), doc="Red, green and blue, or one panchromatic band.")
    blur = Number(
        0.45,
        bounds=(0.0, 3.0),
        unit="px",
        doc="Standard deviation of the optics' blur, beside the pixel's own area.",
    )
    noise = Number(1.0, bounds=(0.0, 20.0), doc="Strength of the sensor's noise over the usual one.")
    haze = Number(0.06, bounds=(0.0, 0.5), doc="Mean light that the air adds, over a white ground's in the sun.")
    gain_spread = Number(0.15, bounds=(0.0, 0.5), doc="How far the pictures' gains lie about 1.")
    bias_least = Number(1.0, bounds=(0.0, 20.0), unit="px", doc="Smallest error of a delivered RPC.")
    bias_most = Number(3.0, bounds=(0.0, 20.0), unit="px", doc="Largest error of a delivered RPC.")


class CitySettings(Settings):
    """A city seen from orbit."""

    plan = Group(PlanSettings())
    orbit = Group(OrbitSettings())
    imager = Group(ImagerSettings())
