"""The samples that the notebooks use, made beforehand under the names by which the notebooks look for them.

Their settings stand in the notebooks and nowhere else: of each notebook those statements are run on which a call
of ``sample_folder`` depends, and nothing more.
"""

from __future__ import annotations

import ast
import contextlib
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final
from unittest import mock

import toolkit.notebook
from toolkit.errors import DataError

#: The function by which notebooks ask for a sample.
MAKER: Final = "sample_folder"


def cells_of(notebook: Path) -> list[str]:
    """Return the source of a notebook's code cells.

    Raises
    ------
    DataError
        Where it is none.
    """
    try:
        cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
        return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{notebook} cannot be read", expected="a notebook", found=str(error)) from error


def sample_statements(cells: Sequence[str]) -> list[ast.stmt]:
    """Return the statements that make samples, and those before them on which they depend, in their order.

    A statement depends on every earlier one that gives a value to a name which it uses. Of a loop that makes
    samples only those statements are kept, too.
    """
    return _needed([statement for cell in cells for statement in ast.parse(cell).body], set())


def _needed(statements: Sequence[ast.stmt], wanted: set[str]) -> list[ast.stmt]:
    """Return the statements that make samples or give what is wanted; ``wanted`` grows by what they use."""
    kept: list[ast.stmt] = []
    for statement in reversed(statements):
        if not (MAKER in _used(statement) or _given(statement) & wanted):
            continue
        if isinstance(statement, ast.For) and not _given(statement) & wanted:
            statement = ast.For(statement.target, statement.iter, _needed(statement.body, set()), [], lineno=0)
        kept.append(statement)
        # What these give needs no earlier value.
        if isinstance(statement, ast.Assign | ast.Import | ast.ImportFrom):
            wanted -= _given(statement)
        wanted |= _used(statement)
    return kept[::-1]


def _used(statement: ast.stmt) -> set[str]:
    used = {
        node.id for node in ast.walk(statement) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)
    }
    changed = {
        node.target.id
        for node in ast.walk(statement)
        if isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Name)
    }
    return used | changed


def _given(statement: ast.stmt) -> set[str]:
    given = set()
    for node in ast.walk(statement):
        if isinstance(node, ast.Import | ast.ImportFrom):
            given |= {(alias.asname or alias.name).partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            given.add(node.id)
        # settings["key"] = value changes what the name stands for.
        elif (
            isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Store) and isinstance(node.value, ast.Name)
        ):
            given.add(node.value.id)
    return given


def make_samples(notebook: Path, folder: Path) -> list[Path]:
    """Make the samples of a notebook below ``folder``, as if it were run there, and return their folders.

    Those that are there already are taken. While it works, ``folder`` is the working directory of this process.

    Raises
    ------
    DataError
        For what is no notebook.
    ToolkitError
        As the samples' own functions.
    """
    statements = sample_statements(cells_of(notebook))
    code = compile(ast.fix_missing_locations(ast.Module(statements, type_ignores=[])), str(notebook), "exec")
    made: list[Path] = []
    original = toolkit.notebook.sample_folder

    def noted(*arguments: Any, **options: Any) -> Path:
        made.append(original(*arguments, **options))
        return made[-1]

    with mock.patch.object(toolkit.notebook, MAKER, noted), _full_size(), contextlib.chdir(folder):
        # The project's own notebooks, as running them in Jupyter would.
        exec(code, {"__name__": notebook.stem})
    return [path if path.is_absolute() else folder / path for path in made]


@contextlib.contextmanager
def _full_size() -> Iterator[None]:
    """Take away what makes notebooks small."""
    with mock.patch.dict(os.environ):
        os.environ.pop("FAST", None)
        yield
