"""The project's docstrings as Markdown: references become links, settings and constants tell what they are."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path
from typing import Any

import griffe

# :func:`name`, :class:`~toolkit.scene.Scene` and their like.
_ROLE = re.compile(r":(?:[a-z]+:)?(?:func|class|mod|meth|data|attr|exc|obj):`([^`]+)`")
# Parameters that share a text: "settings, seed:" and what is indented below.
_SHARED = re.compile(r"^((?:\*{0,2}\w+, )+\*{0,2}\w+):\n((?:[ \t]+\S.*(?:\n|\Z)|\n(?=[ \t]))+)", re.MULTILINE)
_LITERAL_BLOCK = re.compile(r"::(?=\n\s*\n)")
#: Declarations of toolkit.settings whose ``doc`` says what they are for.
_SETTINGS = {"Number", "Integer", "Boolean", "Choice", "Text", "Group"}


class ProjectDocstrings(griffe.Extension):
    """Read what the docstrings of the project hold beside Markdown."""

    def on_package(self, *, pkg: griffe.Module, **kwargs: Any) -> None:
        """Document what has no docstring, then translate all, when it is known what there is to link to."""
        _document(pkg)
        _translate(pkg, pkg)


def _document(obj: griffe.Object) -> None:
    """Give a setting the text of its declaration, and a constant that of the comment above it."""
    for member in obj.members.values():
        if isinstance(member, griffe.Attribute):
            if member.docstring is None and (doc := _declared_doc(member) or _comment_above(member)):
                member.docstring = griffe.Docstring(doc, lineno=member.lineno, parent=member)
        elif isinstance(member, griffe.Object):
            _document(member)


def _translate(obj: griffe.Object, package: griffe.Module) -> None:
    if obj.docstring is not None:
        obj.docstring.value = as_markdown(obj.docstring.value, obj, package)
    for member in obj.members.values():
        if isinstance(member, griffe.Object):
            _translate(member, package)


def as_markdown(text: str, obj: griffe.Object, package: griffe.Module) -> str:
    """Return a docstring with its roles as links and its literal blocks as Markdown has them.

    Parameters that share a text each get it, for griffe would take the type of the first for that of all.
    """
    text = _SHARED.sub(_each, _LITERAL_BLOCK.sub(":", text))
    return _ROLE.sub(lambda found: _link(found[1], obj, package), text)


def _each(found: re.Match[str]) -> str:
    text = found[2] if found[2].endswith("\n") else found[2] + "\n"
    return "".join(f"{name}:\n{text}" for name in found[1].split(", "))


def _link(target: str, obj: griffe.Object, package: griffe.Module) -> str:
    """Return a link to what is named where it has a place in the reference, else its name."""
    path = target.removeprefix("~").removesuffix("()")
    shown = path.rsplit(".", 1)[-1] if target.startswith("~") else path
    try:
        path = path if path.startswith(f"{package.name}.") else obj.resolve(path)
        found = package[path.removeprefix(f"{package.name}.")]
        found = found.final_target if isinstance(found, griffe.Alias) else found
    except (griffe.NameResolutionError, griffe.AliasResolutionError, KeyError):
        return f"`{shown}`"
    private = any(part.startswith("_") for part in found.path.split("."))
    return f"`{shown}`" if private or found.docstring is None else f"[`{shown}`][{found.path}]"


def _declared_doc(attr: griffe.Attribute) -> str:
    value = attr.value
    if not isinstance(value, griffe.ExprCall) or str(value.function) not in _SETTINGS:
        return ""
    for argument in value.arguments:
        if isinstance(argument, griffe.ExprKeyword) and argument.name == "doc":
            try:
                return " ".join(str(ast.literal_eval(str(argument.value))).split())
            except (ValueError, SyntaxError):  # put together while the program runs
                return ""
    return ""


def _comment_above(attr: griffe.Attribute) -> str:
    """Return the text of the ``#:`` lines above an attribute."""
    if attr.lineno is None or not isinstance(attr.filepath, Path):
        return ""
    lines, found = _lines(attr.filepath), []
    for line in reversed(lines[: attr.lineno - 1]):
        if not line.strip().startswith("#:"):
            break
        found.append(line.strip().removeprefix("#:").strip())
    return " ".join(reversed(found))


@cache
def _lines(path: Path) -> list[str]:
    return path.read_text(encoding="utf-8").split("\n")
