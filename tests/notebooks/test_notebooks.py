"""Every notebook runs from top to bottom at its small size, and is stored as a newcomer should find it."""

from __future__ import annotations

import ast
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
PLOTLY = "application/vnd.plotly.v1+json"
#: Functions that return a figure end in this; such a cell must show one.
FIGURE_NAMES = ("_figure", "_map", "_render")
MOST_LINES = 12

pytestmark = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path: Path) -> nbformat.NotebookNode:
    return nbformat.read(path, as_version=4)


def code_cells(path: Path) -> list[nbformat.NotebookNode]:
    return [cell for cell in read(path).cells if cell.cell_type == "code"]


def ends_in_figure(source: str) -> bool:
    """Say whether the last expression of a cell is a call of a function whose name says that it draws."""
    last = ast.parse(source).body[-1]
    if not (isinstance(last, ast.Expr) and isinstance(last.value, ast.Call)):
        return False
    called = last.value.func
    name = called.id if isinstance(called, ast.Name) else called.attr if isinstance(called, ast.Attribute) else ""
    return name.endswith(FIGURE_NAMES)


def test_it_is_stored_without_outputs_for_the_usual_kernel(path: Path) -> None:
    notebook = read(path)
    nbformat.validate(notebook)
    assert notebook.metadata.kernelspec.name == "python3"
    # As nbstripout numbers them: ids made by chance would change with every save.
    assert [cell.id for cell in notebook.cells] == [str(i) for i in range(len(notebook.cells))]
    for cell in code_cells(path):
        assert cell.outputs == []
        assert cell.execution_count is None


def test_cells_are_short_and_explained_before(path: Path) -> None:
    cells = read(path).cells
    for before, cell in zip([None, *cells], cells, strict=False):
        if cell.cell_type == "code":
            assert len(cell.source.splitlines()) <= MOST_LINES, cell.source
            assert before is not None, "a notebook begins with text"
            assert before.cell_type == "markdown", cell.source


def test_it_holds_no_algorithm(path: Path) -> None:
    for cell in code_cells(path):
        kinds = {type(node) for node in ast.walk(ast.parse(cell.source))}
        assert not kinds & {ast.FunctionDef, ast.ClassDef, ast.While, ast.Lambda}, cell.source


@pytest.mark.slow
def test_it_runs_from_top_to_bottom(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAST", "1")
    # Nothing is read from or written to the user's own folders.
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    monkeypatch.setenv("JUPYTER_RUNTIME_DIR", str(tmp_path / "jupyter"))
    folder = tmp_path / "work"
    folder.mkdir()
    notebook = read(path)
    # jupyter_client starts the kernel python3 with the interpreter that it runs in.
    client = NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    )
    client.execute()
    drew = 0
    for cell in (cell for cell in notebook.cells if cell.cell_type == "code"):
        assert not [output for output in cell.outputs if output.output_type == "error"]
        figures = [output.data[PLOTLY] for output in cell.outputs if PLOTLY in output.get("data", {})]
        if ends_in_figure(cell.source):
            assert len(figures) == 1, cell.source
            assert figures[0]["data"], cell.source
            drew += 1
    assert drew > 0
    written = {entry.name for entry in folder.iterdir()}
    assert written == {"runs"}, "notebooks write below runs/ only"
