"""The site: what it is made of, piece by piece, and that the whole is built without a warning and loads nothing."""

from __future__ import annotations

import importlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import nbformat
import pytest
from doc_blocks import ROOT

from toolkit.recipes.registry import built_in_recipes, find_recipe

pytest.importorskip("mkdocs", reason="the extra 'docs' brings mkdocs")
pytest.importorskip("mkdocstrings", reason="the extra 'docs' brings mkdocstrings")
pytest.importorskip("latex2mathml", reason="the extra 'docs' brings latex2mathml")

#: What makes a browser fetch something: pages may link elsewhere, not load from there.
LOADS = re.compile(
    r"<(?:script|img|iframe|source|video)\b[^>]*\bsrc=[\"']?((?:https?:)?//[^\"'\s>]+)"
    r"|<link\b(?=[^>]*\brel=[\"']?(?:stylesheet|preload|preconnect|icon|modulepreload))[^>]*"
    r"\bhref=[\"']?((?:https?:)?//[^\"'\s>]+)",
    re.IGNORECASE,
)
STYLE_LOADS = re.compile(r"@import\s+[^;]*//|url\(\s*[\"']?(?:https?:)?//")


@pytest.fixture
def scripts(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that imports one of the site's scripts."""
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))

    def module(name: str) -> ModuleType:
        return importlib.import_module(name)

    return module


def test_a_method_has_its_settings_with_defaults_ranges_and_presets(scripts: Any) -> None:
    page = scripts("docs_methods").method_page(find_recipe("colmap-3dgs"), "# COLMAP + 3DGS\n\nWhat it does.\n")
    assert page.startswith("# COLMAP + 3DGS\n\nFor the tables of *A-3DGS")
    assert page.count("\n# ") == 0
    assert "What it does." in page
    for row in find_recipe("colmap-3dgs").settings_type.table():
        assert f"| `{row.name}` |" in page
    (steps,) = (line for line in page.splitlines() if line.startswith("| `train.steps`"))
    assert "3000" in steps
    assert "*draft: 1000*" in steps
    assert "*paper: 30000*" in steps
    (method,) = (line for line in page.splitlines() if line.startswith("| `pairs.method`"))
    assert "`exhaustive`" in method
    assert "\\|" not in method.split("`pairs.method`")[1].split("|")[2]


def test_every_method_is_in_the_overview_once(scripts: Any) -> None:
    text = scripts("docs_methods").methods_index()
    assert re.findall(r"^\| \[`([^`]+)`\]\(\1\.md\)", text, re.MULTILINE) == list(built_in_recipes())


def test_every_room_has_a_page_with_its_modules(scripts: Any) -> None:
    pages = scripts("docs_api").api_pages()
    rooms = {path.parent.name for path in (ROOT / "toolkit").glob("*/__init__.py")} - {"cli"}
    assert set(pages) == rooms | {"ground"}
    assert "::: toolkit.matching.added" in pages["matching"].splitlines()
    assert "::: toolkit.settings" in pages["ground"].splitlines()


def test_formulas_become_mathml(scripts: Any) -> None:
    page = '<p><span class="arithmatex">\\(a &lt; b^2\\)</span></p><div class="arithmatex">\\[\\frac{x}{y}\\]</div>'
    made = scripts("docs_math").with_formulas(page)
    assert made.count("<math") == 2
    assert "<msup>" in made
    assert "<mfrac>" in made
    assert "arithmatex" not in made


def test_a_formula_that_cannot_be_drawn_is_refused(scripts: Any) -> None:
    page = '<p><span class="arithmatex">\\(\\big\\lVert x\\)</span></p>'
    with pytest.raises(Exception, match=r"has a command that cannot be drawn"):
        scripts("docs_math").with_formulas(page)


def test_empty_lines_of_an_output_stay_but_for_those_after_progress_bars(scripts: Any) -> None:
    said = "\nsfm:  50%|█    | 1/2\rsfm: 100%|██| 2/2 [00:01<00:00,  2.00it/s]\n\nmade\n\n\n\nTimes\n  all\n\n"
    shown = scripts("docs_notebooks")._text(said).split("\n")[1:-1]
    assert shown == ["sfm: 100%|██| 2/2 [00:01<00:00,  2.00it/s]", "made", "", "Times", "  all"]


def test_headings_of_a_page_with_several_titles_go_down(scripts: Any) -> None:
    one_title = scripts("docs_site").one_title
    assert one_title("# A\n\n# B\n\n```sh\n# no\n```\n\n## C") == "# A\n\n## B\n\n```sh\n# no\n```\n\n### C"
    assert one_title("# A\n\n## B") == "# A\n\n## B"


def test_references_settings_and_constants_of_docstrings_are_read(scripts: Any, tmp_path: Path) -> None:
    griffe = pytest.importorskip("griffe")
    (tmp_path / "house.py").write_text(
        '"""House. See :func:`~house.open`, :class:`Gone` and :data:`LIMIT`::\n\n    code\n\nEnd.\n"""\n'
        "#: Most of them.\nLIMIT = 3\n"
        'class Kind:\n    most = Integer(3, doc="How "\n    "many.")\n\n    other = other(4)\n\n'
        'def open(here: int, there: str):\n    """Open.\n\n    Parameters\n    ----------\n'
        '    here, there:\n        A place.\n\n        Or none.\n    """\n'
    )
    extensions = griffe.load_extensions(scripts("docs_docstrings").ProjectDocstrings)
    found = griffe.load("house", search_paths=[tmp_path], extensions=extensions)
    assert "[`open`][house.open], `Gone` and [`LIMIT`][house.LIMIT]:\n\n    code" in found.docstring.value
    assert found["LIMIT"].docstring.value == "Most of them."
    assert found["Kind.most"].docstring.value == "How many."
    assert found["Kind.other"].docstring is None
    sections = found["open"].docstring.parse("numpy")
    told = {parameter.name: (str(parameter.annotation), parameter.description) for parameter in sections[1].value}
    assert told == {"here": ("int", "A place.\n\nOr none."), "there": ("str", "A place.\n\nOr none.")}


def notebook(*cells: Any) -> Any:
    made = nbformat.v4.new_notebook(cells=list(cells))
    made.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return made


@pytest.fixture
def executed(tmp_path: Path) -> tuple[Path, Path]:
    """Return the path of a small notebook and the folder in which it was executed at its small size."""
    text = nbformat.v4.new_markdown_cell("# Title\n\nWith $x^2$.")
    figure = {"data": [{"y": [1, 2]}], "layout": {"title": {"text": "</script>"}, "height": 300}}
    outputs = [
        nbformat.v4.new_output("stream", name="stdout", text="50%\r100%\nwhole"),
        nbformat.v4.new_output("stream", name="stdout", text=" line\n"),
        nbformat.v4.new_output("display_data", data={"application/vnd.plotly.v1+json": figure}),
        nbformat.v4.new_output("display_data", data={"image/png": "AAAA", "text/plain": "picture"}),
        nbformat.v4.new_output("display_data", data={"text/html": "<b>told</b>", "text/plain": "told"}),
        nbformat.v4.new_output(
            "display_data", data={"text/html": '<script src="https://x.y/z.js"></script>', "text/plain": "plain"}
        ),
        nbformat.v4.new_output(
            "display_data", data={"application/vnd.jupyter.widget-view+json": {}, "text/plain": "Box()"}
        ),
    ]
    source, folder = tmp_path / "07_small.ipynb", tmp_path / "executed"
    nbformat.write(notebook(text, nbformat.v4.new_code_cell("print(1)")), source)
    (folder / "fast").mkdir(parents=True)
    nbformat.write(
        notebook(text, nbformat.v4.new_code_cell("print(1)", outputs=outputs)), folder / "fast" / source.name
    )
    record = {"seconds": 12.3, "date": "2030-01-02", "machine": "Linux x86_64", "cores": 2, "python": "3.11.9"}
    (folder / "fast" / "times.json").write_text(json.dumps({"07_small": record}))
    return source, folder


def test_an_executed_notebook_becomes_a_page(
    scripts: Any, executed: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    source, folder = executed
    module, runner = scripts("docs_notebooks"), scripts("run_notebooks")
    monkeypatch.setattr(module, "executed_version", lambda path: runner.executed_version(path, executed=folder))
    page = module.notebook_page(source)
    assert page.text.startswith('# Title\n\n!!! info "Executed notebook"\n    Executed on 2030-01-02 in 12 s')
    assert "at the small size that tests use" in page.text
    assert "[07_small.ipynb](07_small.ipynb)" in page.text
    assert "```py\nprint(1)\n```" in page.text
    assert "100%\nwhole line\n" in page.text
    assert "50%" not in page.text
    assert page.pictures == {"07_small_0.png": b"\0\0\0"}
    assert "![Output of the cell](07_small_0.png)" in page.text
    assert "only the running notebook shows" in page.text
    assert "x.y/z.js" not in page.text + "".join(page.outputs.values())
    assert "plain" in page.text
    assert page.has_figures
    html = module.with_outputs("".join(f"<p>{mark}</p>" for mark in page.outputs), page.outputs)
    assert "<b>told</b>" in html
    assert "OUTPUT" not in html
    inside = re.search(r'<script type="application/json">(.*?)</script>', html)
    assert inside is not None
    assert json.loads(inside[1])["layout"]["title"]["text"] == "</script>"


def test_a_notebook_that_changed_since_does_not_count_as_executed(
    scripts: Any, executed: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    source, folder = executed
    module, runner = scripts("docs_notebooks"), scripts("run_notebooks")
    changed = nbformat.read(source, as_version=4)
    changed.cells[1].source = "print(2)"
    nbformat.write(changed, source)
    assert runner.executed_version(source, executed=folder) is None
    monkeypatch.setattr(module, "executed_version", lambda path: None)
    assert "Not executed yet" in module.notebook_page(source).text


def test_a_notebook_is_executed_at_the_size_that_is_asked_for_and_timed(scripts: Any, tmp_path: Path) -> None:
    runner = scripts("run_notebooks")
    source = tmp_path / "08_size.ipynb"
    code = "import os, pathlib\nprint('FAST', os.environ['FAST'], sorted(os.listdir()))"
    nbformat.write(notebook(nbformat.v4.new_code_cell(code)), source)
    seconds, error = runner.execute(source, "fast", executed=tmp_path / "made")
    assert error == ""
    found = runner.executed_version(source, executed=tmp_path / "made")
    assert found is not None
    made, size, record = found
    assert size == "fast"
    assert made.cells[0].outputs[0].text == "FAST 1 []\n"
    assert record["seconds"] == pytest.approx(seconds, abs=0.1)
    assert record["cores"] == os.cpu_count()
    assert not (tmp_path / "made" / "fast" / "work" / "08_size").exists()


def test_a_notebook_that_fails_is_told_and_not_kept(scripts: Any, tmp_path: Path) -> None:
    runner = scripts("run_notebooks")
    source = tmp_path / "09_bad.ipynb"
    nbformat.write(notebook(nbformat.v4.new_code_cell("1 / 0")), source)
    _, error = runner.execute(source, "fast", executed=tmp_path / "made")
    assert error == "ZeroDivisionError: division by zero"
    assert runner.executed_version(source, executed=tmp_path / "made") is None


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_site_is_built_without_a_warning_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=1700)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout + done.stderr == ""
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > 60
    for page in pages:
        assert not LOADS.findall(page.read_text(encoding="utf-8")), page
    for style in (tmp_path / "site").rglob("*.css"):
        assert not STYLE_LOADS.search(style.read_text(encoding="utf-8")), style


def test_what_is_loaded_from_elsewhere_would_be_found() -> None:
    assert LOADS.search('<script src="https://a.b/c.js">')
    assert LOADS.search('<link rel="stylesheet" href="//fonts.example/css">')
    assert LOADS.search("<img alt=x src=http://a.b/c.png>")
    assert not LOADS.search('<a href="https://a.b/c">x</a> <link rel="canonical" href="https://a.b/">')
    assert STYLE_LOADS.search("src: url('https://a.b/f.woff')")
