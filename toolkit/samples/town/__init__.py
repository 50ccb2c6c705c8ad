"""A procedural small town, and exact pictures of it by ray casting."""

from toolkit.samples.town.builder import Material
from toolkit.samples.town.layout import TownPlan, TownSettings
from toolkit.samples.town.model import Town, build_town
from toolkit.samples.town.render import SKY, RenderedView, render_view

__all__ = [
    "SKY",
    "Material",
    "RenderedView",
    "Town",
    "TownPlan",
    "TownSettings",
    "build_town",
    "render_view",
]
