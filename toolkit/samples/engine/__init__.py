"""A procedural engine: a ring of near-identical blades filmed by a borescope, with ground truth."""

from toolkit.samples.engine.make import make_engine, open_engine
from toolkit.samples.engine.motion import borescope_camera
from toolkit.samples.engine.sample import EngineSample
from toolkit.samples.engine.settings import BorescopeSettings, EngineSettings, FilmSettings, RotorSettings

__all__ = [
    "BorescopeSettings",
    "EngineSample",
    "EngineSettings",
    "FilmSettings",
    "RotorSettings",
    "borescope_camera",
    "make_engine",
    "open_engine",
]
