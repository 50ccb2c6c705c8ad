"""Which room may import which: the house's rule, written down once and held here."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import toolkit

ROOT = Path(toolkit.__file__).parent

GROUND_FLOOR = {"checkpoint", "errors", "files", "optional", "pretrained", "progress", "settings", "workspace"}

# What each room may import besides itself and the ground floor. A room that is not listed may not exist.
MAY_IMPORT: dict[str, set[str]] = {
    "geometry": set(),
    "scene": {"geometry"},
    "metrics": {"geometry", "scene"},
    "samples": {"geometry", "scene"},
    "capture": {"geometry", "scene"},
    "matching": {"geometry", "scene"},
    "poses": {"geometry", "scene", "metrics", "matching"},
    "depth": {"geometry", "scene"},
    "views": {"geometry", "scene"},
    "splat": {"geometry", "scene", "metrics"},
    "nerf": {"geometry", "scene", "metrics"},
    "localize": {"geometry", "scene", "metrics", "matching", "splat"},
    "recipes": {
        *("geometry", "scene", "metrics", "samples", "capture", "matching", "poses", "depth", "views"),
        *("splat", "nerf", "localize"),
    },
    "plots": {"geometry", "scene", "metrics", "views"},
    "runs": {"geometry", "scene", "metrics", "matching", "views", "splat", "localize", "recipes", "plots"},
    "widgets": {"scene", "metrics", "samples", "localize", "views", "recipes", "plots", "runs"},
    "cli": {"samples", "capture", "poses", "recipes", "runs", "demo", "widgets"},
    "demo": {"samples", "scene", "recipes", "runs"},
    "teach": set(),
    "notebook": {"samples", "scene", "poses", "views", "plots", "runs"},
}

# The ground floor knows nobody above it; these are its own inner steps.
GROUND_MAY_IMPORT: dict[str, set[str]] = {
    "checkpoint": {"errors", "files"},
    "errors": set(),
    "files": {"errors"},
    "optional": {"errors"},
    "pretrained": {"errors"},
    "progress": {"errors"},
    "settings": {"errors"},
    "workspace": {"errors", "files"},
}


def room_of(file: Path) -> str:
    return file.relative_to(ROOT).parts[0].removesuffix(".py")


def imported_rooms(file: Path) -> set[str]:
    rooms: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file.name}:{node.lineno}: imports are absolute in this project"
            modules = [node.module or ""]
            if node.module == "toolkit":
                modules = [f"toolkit.{alias.name}" for alias in node.names]
        else:
            continue
        rooms |= {name.split(".")[1] for name in modules if name.startswith("toolkit.")}
    return rooms - {"__version__"}


FILES = sorted(
    file for file in ROOT.rglob("*.py") if file.parent != ROOT or file.name not in {"__init__.py", "__main__.py"}
)


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_a_room_imports_only_what_its_row_in_the_table_allows(file: Path) -> None:
    room = room_of(file)
    if room in GROUND_FLOOR:
        allowed = GROUND_MAY_IMPORT[room]
    else:
        assert room in MAY_IMPORT, f"room '{room}' is not in the table: say which rooms it may import"
        allowed = MAY_IMPORT[room] | GROUND_FLOOR
    assert imported_rooms(file) <= allowed | {room}


def test_the_table_has_no_circles() -> None:
    settled: set[str] = set()
    while len(settled) < len(MAY_IMPORT):
        ready = {room for room, below in MAY_IMPORT.items() if below <= settled} - settled
        assert ready, f"these rooms import each other in a circle: {set(MAY_IMPORT) - settled}"
        settled |= ready
