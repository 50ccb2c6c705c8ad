"""The satellite paper's table from results that were written by hand."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from toolkit.files import write_json
from toolkit.recipes.registry import find_recipe
from toolkit.runs.folder import RunFolder
from toolkit.runs.paper_rows import PaperRow
from toolkit.runs.paper_runs import Attempt, TableOptions, row_settings
from toolkit.runs.satellite_table import BUDGETS, PAPER, ROWS, satellite_tables, write_satellite_tables

ROW = {row.key: row for row in ROWS}


_TIMES = (("train", 300.4), ("measure", 50.0), ("measure heights", 7.0))


def finished(folder: Path, metrics: Mapping[str, float | None]) -> RunFolder:
    run = RunFolder(folder)
    times = [{"name": name, "seconds": s, "reused": False} for name, s in _TIMES]
    write_json(run.result_file, {"metrics": dict(metrics), "times": times, "reports": {}, "test_views": []})
    return run


def test_methods_and_budgets_have_the_papers_figures_beside_them(tmp_path: Path) -> None:
    colmap = {"sfm.registered": 3, "sfm.images": 20, "training.l1": 0.02116, "training.psnr": 33.456}
    splat = {"sfm.registered": 20, "sfm.images": 20, "test.psnr": 21.5, "dsm.mae": 1.234, "dsm.within_1m": 0.8412}
    budgets = {
        "sfm.registered": 8,
        "sfm.images": 20,
        "views.4.most.seconds": 21.4,
        "views.4.most.dsm_mae": 1.5,
        "views.4.least.seconds": 20.0,
        "views.6.most.seconds": 33.0,
    }
    attempts = [
        Attempt(ROW["colmap"], "city", "finished", run=finished(tmp_path / "a", colmap)),
        Attempt(ROW["colmap-depth"], "city", "weights missing", "Weights missing: no network; expected a folder"),
        Attempt(ROW["dust3r"], "city", "finished", run=finished(tmp_path / "b", budgets)),
        Attempt(ROW["splat"], "city", "finished", run=finished(tmp_path / "c", splat)),
        Attempt(ROW["dust3r"], "other", "weights missing", "no DUSt3R"),
    ]
    first, second = satellite_tables(attempts)
    lines = first.markdown().splitlines()

    assert f"| COLMAP + 3DGS | 3 of 20 | 0.0212 | 33.46 | – | – | – | – | 300 | {PAPER['colmap']} |" in lines
    told = [line for line in lines if line.startswith("| the same, held to")]
    assert told[0].startswith("| the same, held to predicted depth | weights missing: no network | | ")
    assert told[0].endswith(" | training L1 0.0196, 35.59 dB |")
    assert "| RPCs, 2D splat on these heights | 20 of 20 | – | – | 21.50 | 1.23 | – | 84.1 | 300 |  |" in lines
    assert "| 4 | 21 | 1.50 | 20 | – | 24 |" in lines
    assert "| 6 | 33 | – | – | – |  |" in lines
    assert "| 16 | – | – | – | – | 6152 |" in lines
    # As many cells in each line of a table as in its head.
    tables = "\n".join(line if line.startswith("|") else "" for line in lines).split("\n\n")
    counts = [{line.count("|") for line in table.split("\n") if line} for table in tables if table.strip()]
    assert [len(count) for count in counts] == [1, 1]
    assert "| 2 | – | – | – | – | 6 |" in second.markdown()
    file = write_satellite_tables([first, second], tmp_path / "out").read_text(encoding="utf-8")
    assert (file.count("## city"), file.count("## other")) == (1, 1)


def test_without_a_row_of_budgets_there_is_no_table_of_them(tmp_path: Path) -> None:
    (table,) = satellite_tables([Attempt(ROW["heights"], "city", "failed", "dark")])
    assert "| RPCs, heights matched over the ground | failed: dark |" in table.markdown()
    assert "DUSt3R: how many" not in table.markdown()


def test_the_papers_seconds_are_those_of_its_table() -> None:
    assert BUDGETS == {2: 6, 4: 24, 8: 58, 16: 6152}


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.key)
def test_each_row_changes_settings_that_its_recipe_has(row: PaperRow, tmp_path: Path) -> None:
    settings: Any = row_settings(row, find_recipe(row.recipe), TableOptions(tmp_path, {"train.steps": 30}))
    if hasattr(settings, "train"):
        assert settings.train.steps == 30
    if row.key == "colmap-depth":
        assert settings.depth_loss.weight > 0
    if row.key == "vggt-tracks":
        assert settings.adjust.method == "tracks"
