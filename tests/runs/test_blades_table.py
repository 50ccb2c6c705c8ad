"""The table of arcs from results that were written by hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from toolkit.files import write_json
from toolkit.recipes.registry import find_recipe
from toolkit.runs.blades_table import PAPER, ROWS, START_FOCAL, arc_tables, write_arc_tables
from toolkit.runs.folder import RunFolder
from toolkit.runs.paper_runs import Attempt, TableOptions, row_settings

METRICS = {
    "sfm.registered": 85.0,
    "sfm.images": 246.0,
    "sfm.points": 2183.0,
    "sfm.reprojection_error_px": 0.5644,
    "circle.arc_deg": 42.66,
    "circle.arc_error_deg": -8.81,
    "circle.arc_sigma_deg": 0.62,
    "circle.radius_spread": 0.00241,
    "lens.focal_widths": 0.0459,
}


def finished(folder: Path) -> RunFolder:
    run = RunFolder(folder)
    times = [{"name": name, "seconds": s, "reused": False} for name, s in (("sfm", 180.4), ("measure", 50.0))]
    write_json(run.result_file, {"metrics": METRICS, "times": times, "reports": {}, "test_views": []})
    return run


def test_a_row_has_the_arc_with_its_sigma_beside_the_papers(tmp_path: Path) -> None:
    attempts = [
        Attempt(ROWS[0], "engine", "finished", run=finished(tmp_path / "run")),
        Attempt(ROWS[3], "engine", "failed", "No first pair; expected more"),
        Attempt(ROWS[0], "other", "failed", "dark"),
    ]
    first, second = arc_tables(attempts)

    line = "| 85 of 246 | 42.7 | 0.6 | -8.8 | 0.046 | 0.0024 | – | 2183 | 0.564 | 180 | 290 |"
    assert f"| SIMPLE_RADIAL, distorted pictures {line}" in first.markdown()
    assert "| OPENCV_FISHEYE, undistorted | failed: No first pair |" in first.markdown()
    assert first.markdown().count("| 102 |") == 1
    # As many cells in each line as in the head.
    assert len({text.count("|") for text in first.markdown().splitlines() if text.startswith("|")}) == 1
    file = write_arc_tables([first, second], tmp_path / "out")
    assert file.read_text(encoding="utf-8").count("## ") == 2
    assert "failed: dark" in file.read_text(encoding="utf-8")


def test_the_papers_figures_are_those_of_its_table() -> None:
    assert PAPER == {"a": 290, "b": 175, "c": 107, "d": 102}
    assert [row.key for row in ROWS[:4]] == list(PAPER)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.key)
def test_each_row_changes_settings_that_its_recipe_has(row, tmp_path: Path) -> None:
    settings = row_settings(row, find_recipe(row.recipe), TableOptions(tmp_path, {"pairs.overlap": 4}))

    assert settings.pairs.overlap == 4
    assert settings.lens.way == row.changes["lens.way"]
    # What is not known starts from a guess, not from the capture's own camera.
    assert settings.lens.way == "known" or settings.lens.start_focal == START_FOCAL
