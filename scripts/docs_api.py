"""Pages of the API reference: one for each room of the package, all of its public modules below each other."""

from __future__ import annotations

import ast
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "toolkit"
#: Rooms in the order in which data flow through them; every other one follows by its name.
ORDER = (
    *("scene", "geometry", "samples", "capture", "matching", "poses", "views", "depth"),
    *("splat", "nerf", "localize", "metrics", "recipes", "runs", "plots", "widgets", "teach"),
)
#: What is in the package but is no library: the command line is told by its own help.
LEFT_OUT = {"cli", "__main__"}
GROUND = "ground"


def api_pages() -> dict[str, str]:
    """Return the text of every page by its name."""
    rooms = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file()} - LEFT_OUT
    ordered = [room for room in ORDER if room in rooms] + sorted(rooms - set(ORDER))
    ground = sorted(path for path in PACKAGE.glob("*.py") if path.stem not in {"__init__", *LEFT_OUT})
    pages = {GROUND: _page("toolkit", "What every room stands on, and helpers for notebooks.", ground)}
    for room in ordered:
        files = sorted((PACKAGE / room).rglob("*.py"), key=lambda path: (path.stem != "__init__", path))
        first = ast.get_docstring(ast.parse((PACKAGE / room / "__init__.py").read_text(encoding="utf-8"))) or ""
        # The page says so itself; only what an __init__ declares beyond its imports is told again below.
        pages[room] = _page(f"toolkit.{room}", first.split("\n\n")[0], [file for file in files if _declares(file)])
    return pages


def _declares(file: Path) -> bool:
    """Whether a module declares anything public: a function, a class or a documented constant."""
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    body = ast.parse(file.read_text(encoding="utf-8")).body
    return any(isinstance(node, kinds) and not node.name.startswith("_") for node in body)


def _page(title: str, text: str, files: list[Path]) -> str:
    modules = [module_name(file) for file in files]
    return "\n\n".join([f"# {title}", text, *(f"::: {module}" for module in modules)])


def module_name(file: Path) -> str:
    """Return the dotted name of a module of the package."""
    parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
