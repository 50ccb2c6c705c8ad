"""What is said of recipes and captures where a person chooses one."""

from __future__ import annotations

from toolkit.recipes.available import missing_here
from toolkit.recipes.base import Recipe
from toolkit.runs.markup import Content, element
from toolkit.scene.capture_folders import CaptureFolder


def recipe_label(recipe: Recipe) -> str:
    """Return how a recipe is called in the list, and in a word or two what it lacks here with its defaults."""
    lacking = missing_here(recipe.settings_type())
    return f"{recipe.title} · {recipe.name}" + (f" ({lacking.partition(':')[0]})" if lacking else "")


def about_recipe(recipe: Recipe) -> Content:
    """Return what a recipe does and the paper that it is from."""
    paper = ["Paper: ", element("b", recipe.paper)] if recipe.paper else ["In none of the papers: our own."]
    return [element("p", recipe.description, class_="about"), element("p", paper, class_="note")]


def about_capture(capture: CaptureFolder | None) -> Content:
    """Return where a capture lies, nothing for none."""
    return element("p", "In ", element("code", str(capture.path)), class_="note") if capture is not None else None
