"""What the site's pages on methods get from the registry of recipes: head, table of settings, overview."""

from __future__ import annotations

import re
from collections.abc import Iterator

from toolkit.recipes.base import Recipe
from toolkit.recipes.presets import recipe_presets, with_preset
from toolkit.recipes.registry import all_recipes
from toolkit.settings import Group, SettingRow, Settings

#: Sections of the list of methods by the paper that its methods belong to.
FAMILIES = {
    "a-3dgs": "Drone video and photos",
    "blade-inspection-sfm": "Inspection video and surfaces",
    "satellite-3d": "Satellite pictures",
    "uav-splat-localization": "Maps to localise in",
}
PAPERS = {
    "a-3dgs": "A-3DGS: Accelerated 3D Gaussian Splatting from Aerial Imagery with SLAM and Sensor-Based Priors",
    "blade-inspection-sfm": "SfM applications for 3D reconstruction from 2D avionics industrial inspection videos "
    "(master's thesis, TU Delft)",
    "satellite-3d": "3D Reconstruction from Satellite Imagery (Fischer, Gollreiter, Won)",
    "uav-splat-localization": "Evaluating Gaussian Splatting Maps for Absolute Visual Localization of UAVs "
    "(Matzke, Maas, Eltner)",
}


def method_families() -> dict[str, list[Recipe]]:
    """Return the recipes by the section that they are listed in, in the registry's order."""
    families: dict[str, list[Recipe]] = {title: [] for title in FAMILIES.values()}
    title = next(iter(families))
    for recipe in all_recipes().values():
        # A method of our own stands in the registry behind those of the paper that it goes beyond.
        title = FAMILIES[recipe.paper] if recipe.paper else title
        families[title].append(recipe)
    return families


def method_page(recipe: Recipe, written: str) -> str:
    """Return the page of a method: its name and paper, what was written by hand, and the table of its settings."""
    body = re.sub(r"\A#[^\n]*\n", "", written.lstrip())
    return "\n\n".join([_head(recipe), body.strip(), settings_text(recipe)])


def _head(recipe: Recipe) -> str:
    paper = (
        f"For the tables of *{PAPERS[recipe.paper]}*; not every row there is the paper's own method."
        if recipe.paper
        else "A method of this toolkit's own."
    )
    return (
        f"# {recipe.title}\n\n"
        f"{paper}\n\n"
        f"```sh\ntoolkit run {recipe.name} --data FOLDER\n```\n\n"
        f'!!! abstract "In short"\n    {recipe.description}'
    )


def methods_index() -> str:
    """Return the overview of all methods."""
    parts = [
        "# Methods\n\nA method is a *recipe*: a short list of stages, run by its name. Every page says what the "
        "method does, where it comes from, what it cannot do, and every setting with its default and range, read "
        "from the code's own declarations. `toolkit recipes` lists the same on the command line."
    ]
    for title, recipes in method_families().items():
        rows = [
            f"| [`{recipe.name}`]({recipe.name}.md) | {recipe.title} | {_first(recipe)} |" for recipe in recipes
        ]
        parts.append("\n".join([f"## {title}\n", "| name | method | in short |", "|---|---|---|", *rows]))
    return "\n\n".join(parts)


def _first(recipe: Recipe) -> str:
    """Return the first sentence of a description."""
    return re.split(r"(?<=[a-z)])\. ", recipe.description)[0].rstrip(".")


def settings_text(recipe: Recipe) -> str:
    """Return the presets of a recipe and its settings, one table for each stage."""
    lines = ["## Settings", ""]
    lines.append(
        "Set with `--set name=value` on the command line, with the form of the dashboard, or with "
        "`settings.replace({name: value})` in Python."
    )
    presets = recipe_presets(recipe)
    if presets:
        lines += ["", "| preset | |", "|---|---|"]
        lines += [f"| `{name}` | {_cell(preset.doc)} |" for name, preset in presets.items()]
        lines += ["", "`--preset NAME` makes all changes of a preset; the tables name them in italics."]
    changes = {name: dict(with_preset(recipe.settings_type(), name).items()) for name in presets}
    for title, doc, rows in _groups(recipe.settings_type):
        lines += ["", f"### {title}", "", *([doc, ""] if doc else [])]
        lines += ["| setting | default | takes | meaning |", "|---|---|---|---|"]
        lines += [_row(row, changes) for row in rows]
    return "\n".join(lines)


def _groups(kind: type[Settings]) -> Iterator[tuple[str, str, list[SettingRow]]]:
    """Yield name, meaning and rows of each stage's settings; those that belong to none first."""
    rows = kind.table()
    own = [row for row in rows if "." not in row.name]
    if own:
        yield "of the method itself", "", own
    for name in dict.fromkeys(row.name.split(".")[0] for row in rows if "." in row.name):
        group = kind.declaration(name)
        assert isinstance(group, Group)
        yield name, _sentence(group.doc or ""), [row for row in rows if row.name.startswith(f"{name}.")]


def _sentence(text: str) -> str:
    text = " ".join(text.split())
    return text if not text or text.endswith((".", ":")) else text + "."


def _row(row: SettingRow, presets: dict[str, dict[str, object]]) -> str:
    unit = f" {row.unit}" if row.unit else ""
    changed = [
        f"*{name}: {_value(values[row.name])}*"
        for name, values in presets.items()
        if values[row.name] != row.default
    ]
    default = f"{_value(row.default)}{unit}" + "".join(f"<br>{text}" for text in changed)
    cells = (f"`{row.name}`", default, _takes(row.allowed), row.doc)
    return "| " + " | ".join(_cell(cell) for cell in cells) + " |"


def _value(value: object) -> str:
    """Return a value as it is typed after ``--set``."""
    if isinstance(value, bool):
        return str(value).lower()
    if value == "":
        return "–"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _takes(allowed: str) -> str:
    choices = allowed.split(" | ")
    return ", ".join(f"`{choice}`" for choice in choices) if len(choices) > 1 else allowed


def _cell(text: str) -> str:
    """Return text that does not end its cell of a table."""
    return text.replace("|", "\\|").replace("\n", " ")
