"""Samples and runs that go into the bundle: those of the notebooks, under the names that notebooks look for."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest
from fake_recipe import RECIPE, write_photos

from scripts.workshop import precomputed
from scripts.workshop.precomputed import PLAN, Planned, make_run, put_into_bundle
from scripts.workshop.samples import MAKER, cells_of, make_samples, sample_statements
from toolkit.errors import DataError, StageError
from toolkit.notebook import sample_folder
from toolkit.recipes import registry
from toolkit.runs.folder import RunFolder
from toolkit.samples.make import SampleSettings

NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))


def write_notebook(path: Path, *cells: str) -> Path:
    kinds = [{"cell_type": "markdown", "source": ["text"]}]
    kinds += [{"cell_type": "code", "source": cell.splitlines(keepends=True)} for cell in cells]
    path.write_text(json.dumps({"cells": kinds}), encoding="utf-8")
    return path


def kept(*cells: str) -> list[str]:
    return [ast.unparse(statement) for statement in sample_statements(cells)]


def test_only_what_a_sample_depends_on_is_kept() -> None:
    first = "import os\nfrom a import b as c, d\nsize = 3\nother = heavy()"
    second = "opts = {'n': size}\nopts |= {'m': 1}\nopts['k'] = c\nDATA = sample_folder(d, opts)\nlast(DATA)"
    assert kept(first, second) == [
        "from a import b as c, d",
        "size = 3",
        "opts = {'n': size}",
        "opts |= {'m': 1}",
        "opts['k'] = c",
        "DATA = sample_folder(d, opts)",
    ]


def test_a_value_that_is_replaced_is_not_followed() -> None:
    assert kept("size = slow()\nsize = 2", "D = sample_folder(size)") == ["size = 2", "D = sample_folder(size)"]


def test_branches_are_kept_whole_and_of_a_loop_only_what_makes_samples() -> None:
    cells = ("n = 1\nif FAST:\n    n = 2", "for k in kinds:\n    s = sample_folder(n, k)\n    answers[k] = slow(s)")
    assert kept(*cells) == ["n = 1", "if FAST:\n    n = 2", "for k in kinds:\n    s = sample_folder(n, k)"]


def test_a_notebook_without_samples_has_none(tmp_path: Path) -> None:
    assert make_samples(write_notebook(tmp_path / "n.ipynb", "1 + 1"), tmp_path) == []


def test_what_is_no_notebook_is_told(tmp_path: Path) -> None:
    (tmp_path / "n.ipynb").write_text("[]", encoding="utf-8")
    with pytest.raises(DataError, match=r"n.ipynb cannot be read; expected a notebook"):
        cells_of(tmp_path / "n.ipynb")


def test_samples_lie_where_the_notebook_will_look_at_full_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAST", "1")
    tiny = {"town.trees": 0, "flight.frames": 2, "flight.image_width": 32, "flight.image_height": 24}
    cells = (
        "import os\nfrom toolkit.notebook import sample_folder, work_folder\n"
        "from toolkit.samples.make import SampleSettings\nassert 'FAST' not in os.environ",
        f"WORK = work_folder('tour')\nD = sample_folder(WORK, SampleSettings().replace({tiny}))\nraise SystemExit",
    )
    notebook = write_notebook(tmp_path / "00_tour.ipynb", *cells)
    (made,) = make_samples(notebook, tmp_path)
    assert made.parent == tmp_path / "runs" / "tour"
    assert len(list((made / "images").iterdir())) == 2
    before = (made / "scene.json").stat().st_mtime_ns
    # The notebook's own call, and a second one of ours, find it.
    assert sample_folder(tmp_path / "runs" / "tour", SampleSettings().replace(tiny)) == made
    assert make_samples(notebook, tmp_path) == [made]
    assert (made / "scene.json").stat().st_mtime_ns == before


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_each_notebook_gives_its_samples_without_its_methods(notebook: Path) -> None:
    statements = sample_statements(cells_of(notebook))
    source = "\n".join(ast.unparse(statement) for statement in statements)
    assert source.count(f"{MAKER}(") == "\n".join(cells_of(notebook)).count(f"{MAKER}(") > 0
    for slow in ("recipe_run(", "extract_sift(", "train_splat(", "localize_batch(", "match_scene("):
        assert slow not in source


def test_what_is_planned_is_there() -> None:
    stems = {path.stem for path in NOTEBOOKS}
    for planned in PLAN:
        assert planned.notebook in stems
        recipe = registry.find_recipe(planned.recipe)
        recipe.settings_type().replace(dict(planned.changes))
    assert {planned.notebook for planned in PLAN} == stems


@pytest.fixture
def finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunFolder:
    monkeypatch.setattr(precomputed, "find_recipe", lambda _: RECIPE)
    monkeypatch.setattr("toolkit.runs.recipe_run.find_recipe", lambda _: RECIPE)
    data = write_photos(tmp_path / "bundle" / "runs" / "tour" / "town")
    return make_run(Planned("00_tour", RECIPE.name), data, tmp_path / "work")


def test_a_run_goes_into_the_bundle_with_its_data_named_from_there(tmp_path: Path, finished: RunFolder) -> None:
    placed = put_into_bundle(finished, Planned("00_tour", RECIPE.name), tmp_path / "bundle")
    record = RunFolder(placed).record()
    assert record.data == "runs/tour/town"
    assert record.name == f"made beforehand, tour, {RECIPE.name}"
    assert not (placed / "checkpoint").exists()
    assert RunFolder(placed).status().state == "finished"
    # The second time it is the same run, and nothing is computed.
    again = make_run(Planned("00_tour", RECIPE.name), tmp_path / "bundle/runs/tour/town", tmp_path / "work")
    assert again.id == finished.id


def test_a_run_on_other_data_does_not_go_into_the_bundle(tmp_path: Path, finished: RunFolder) -> None:
    with pytest.raises(StageError, match=r"cannot go into the bundle; expected data below .*other"):
        put_into_bundle(finished, Planned("00_tour", RECIPE.name), tmp_path / "other")
