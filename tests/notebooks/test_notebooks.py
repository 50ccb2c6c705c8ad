"""Every notebook runs from top to bottom at its small size, and is stored as a newcomer should find it."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from toolkit.teach.registry import exercises_of, lessons

FOLDER = Path(__file__).parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
PLOTLY = "application/vnd.plotly.v1+json"
#: Functions that return a figure end in this; such a cell must show one.
FIGURE_NAMES = ("_figure", "_map", "_render")
MOST_LINES = 12
MOST_CELLS = 25
FEWEST_EXERCISES = 2

pytestmark = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path: Path) -> nbformat.NotebookNode:
    return nbformat.read(path, as_version=4)


def code_cells(path: Path) -> list[nbformat.NotebookNode]:
    return [cell for cell in read(path).cells if cell.cell_type == "code"]


def lesson_of(path: Path) -> str:
    """Return the module of exercises of a notebook: its name without the number."""
    return path.stem.partition("_")[2]


def solutions_of(path: Path) -> list[str]:
    """Return the blocks of Python on a notebook's page of solutions."""
    page = FOLDER / "solutions" / f"{path.stem}.md"
    assert page.is_file(), f"{path.name} has no page of solutions: {page} is missing"
    return re.findall(r"^```python\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def checked(source: str) -> list[str]:
    """Return the names of the exercises that a piece of code checks."""
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    named = [call for call in calls if isinstance(call.func, ast.Name) and call.func.id == "check"]
    return [ast.literal_eval(call.args[0]) for call in named]


def verdicts(cells: list[nbformat.NotebookNode]) -> list[str]:
    """Return what the checks in executed cells said, in order."""
    said = [
        output.data["text/plain"]
        for cell in cells
        for output in cell.outputs
        if "text/plain" in output.get("data", {})
    ]
    return [text for text in said if re.match(r"\w+\.\w+: (open|wrong|right)\. ", text)]


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


def test_it_is_short_enough_for_a_course(path: Path) -> None:
    assert len(read(path).cells) <= MOST_CELLS


def test_every_exercise_is_asked_once_and_solved_once(path: Path) -> None:
    assert lesson_of(path) in lessons(), f"toolkit/teach/exercises/{lesson_of(path)}.py is missing"
    declared = sorted(exercises_of(lesson_of(path)))
    assert len(declared) >= FEWEST_EXERCISES
    assert sorted(name for cell in code_cells(path) for name in checked(cell.source)) == declared
    blocks = [checked(block) for block in solutions_of(path)]
    assert all(len(names) == 1 for names in blocks), "one check in each block"
    assert sorted(name for names in blocks for name in names) == declared


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
    own, solutions = list(notebook.cells), [nbformat.v4.new_code_cell(block) for block in solutions_of(path)]
    notebook.cells += solutions
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
            assert figures, cell.source
            assert all(figure["data"] for figure in figures), cell.source
            drew += 1
    assert drew > 0
    unanswered = verdicts([cell for cell in own if cell.cell_type == "code"])
    assert unanswered, "a check has to show what it says"
    assert all(": open. " in said for said in unanswered), unanswered
    solved = verdicts(solutions)
    assert len(solved) == len(solutions)
    assert all(": right. " in said for said in solved), solved
    written = {entry.name for entry in folder.iterdir()}
    assert written == {"runs"}, "notebooks write below runs/ only"
