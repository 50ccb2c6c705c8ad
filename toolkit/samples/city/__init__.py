"""A procedural city seen from orbit: line cameras, fitted RPCs with a bias, suns, air, and the true surface."""

from toolkit.samples.city.make import make_city, open_city
from toolkit.samples.city.sample import CitySample, CityView
from toolkit.samples.city.settings import CitySettings, ImagerSettings, OrbitSettings, PlanSettings

__all__ = [
    "CitySample",
    "CitySettings",
    "CityView",
    "ImagerSettings",
    "OrbitSettings",
    "PlanSettings",
    "make_city",
    "open_city",
]
