"""The tables of the paper on localisation from results that were written by hand."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from toolkit.files import write_json
from toolkit.plots.localization import mte_bars
from toolkit.recipes.map_geometry import geometry_metrics
from toolkit.recipes.map_steps import _map_metrics
from toolkit.recipes.registry import find_recipe
from toolkit.runs.folder import RunFolder
from toolkit.runs.localization_rows import PAPER_DENSE, PAPER_MAPS, PAPER_POSES, PAPER_SPARSE, ROWS, SCENARIOS
from toolkit.runs.localization_table import PUBLISHED, localization_tables, write_localization_tables
from toolkit.runs.paper_rows import PaperRow
from toolkit.runs.paper_runs import Attempt, TableOptions, row_settings
from toolkit.runs.record import RunRecord

ROW = {row.key: row for row in ROWS}
_TIMES = (
    ("map-sfm", 40.0),
    ("queries", 5.0),
    ("fusion", 60.4),
    ("train-map", 1300.2),
    ("map-geometry", 30.0),
    ("measure", 50.0),
    ("localize ours sfm-test", 900.0),
)
MAP = {
    "sfm.position_residual": 0.0456,
    "sfm.points": 21_500.0,
    "fused.points": 860_000.0,
    "fused.per_sparse": 40.0,
    "splat.initial": 150_000.0,
    "splat.gaussians.early": 160_000.0,
    "splat.gaussians": 200_000.0,
    "test.psnr.early": 25.123,
    "test.psnr": 27.456,
    "training.psnr": 28.9,
    "train.seconds": 1280.2,
    "queries": 76.0,
    "queries.placed": 75.0,
    "map.c2c_median": 0.0812,
    "map.depth_c2c_median": 0.0423,
    "map.moved_horizontal": 0.31,
    "map.moved_vertical": 0.12,
    "map.depth_bias": -0.012,
    "map.depth_spread": 0.143,
}


def poses(mode: str, scenario: str, scale: float, **more: float | None) -> dict[str, float | None]:
    """Return made-up measures of one way and scenario, and those of its starts."""
    values: dict[str, float | None] = {
        "mte_m": 0.1 * scale,
        "rmse_t_m": 0.12 * scale,
        "mre_deg": 0.05 * scale,
        "rmse_r_deg": 0.06 * scale,
        "found": 0.987,
        "recall_01": 0.5,
        "recall_05": 0.9,
        "recall_5": 0.98,
        "seconds": 7.654,
        "true_mte_m": 0.11 * scale,
    }
    below = {f"localize.{mode}.{scenario}.{name}": value for name, value in (values | more).items()}
    start = {"mte_m": 9.612, "mre_deg": 0.0, "photos": 76.0}
    return below | {f"localize.start.{scenario}.{name}": value for name, value in start.items()}


def finished(
    folder: Path, metrics: Mapping[str, float | None], reports: Mapping[str, Any] | None = None
) -> RunFolder:
    run = RunFolder(folder)
    times = [{"name": name, "seconds": s, "reused": False} for name, s in _TIMES]
    content = {"metrics": dict(metrics), "times": times, "reports": dict(reports or {}), "test_views": []}
    write_json(run.result_file, content)
    settings = {"train": {"steps": 6000}}
    record = RunRecord("2dgs-sparse", settings, 0, "cpu", "flight", "abc", "", "2026-01-01T00:00:00Z", {}, {}, {})
    write_json(run.record_file, record.to_dict())
    return run


def lines_of(text: str, title: str) -> list[str]:
    """Return the lines of the table below a heading."""
    part = text.split(f"### {title}")[1].split("\n\n")[1]
    return part.splitlines()


@pytest.fixture
def attempts(tmp_path: Path) -> list[Attempt]:
    sparse = MAP | poses("ours", "sfm-test", 1.0) | poses("one-shot-aliked", "sfm-test", 3.0)
    sparse |= poses("ours", "sfm-test-pos10", 1.1) | poses("paper", "sfm-test-pos10", 30.0)
    sparse |= poses("one-shot-orb", "sfm-test-pos10", 40.0)
    dense = MAP | poses("ours", "sfm-test", 1.0, mte_m=None, rmse_t_m=None, found=0.0)
    reason = {"reason": "Query 'a.jpg' has no start by sensors; expected position and attitude of every query."}
    del dense["map.depth_bias"]
    return [
        Attempt(ROW["2dgs-sparse"], "nadir", "finished", run=finished(tmp_path / "a", sparse)),
        Attempt(
            ROW["2dgs-dense"],
            "nadir",
            "finished",
            run=finished(tmp_path / "b", dense, {"localize.calc-test": reason}),
        ),
        Attempt(ROW["2dgs-dense-pos"], "nadir", "failed", "No dense cloud; expected points; found none"),
        Attempt(ROW["2dgs-sparse"], "other", "not applicable", "the data have no gps"),
    ]


def test_maps_have_the_papers_rows_below_them(attempts: list[Attempt]) -> None:
    first, second = localization_tables(attempts)
    lines = lines_of(first.markdown(), "Table 1: the maps")
    assert lines[2] == (
        "| 2DGS, sparse start | 0.05 | 21,500 | 860,000 | 40.0 | 150,000 | 160,000 | 200,000 | 25.12 | 27.46 | "
        "28.90 | 1,280 | 1,401 | 6,000 | 75 of 76 |"
    )
    assert lines[3] == (
        "| *paper* | *0.25* | *154,563* | *9,629,581* | *62.3* | *154,563* | *–* | *3,676,541* | *27.74* | *31.54* "
        "| *–* | *3,593* | *–* | *30,000* | *–* |"
    )
    # The third map's figures are of 7,000 steps: they stand there.
    assert lines[6].startswith("| 2DGS, dense start, positions held | failed: No dense cloud |  |")
    assert "| *9,629,581* | *5,989,063* | *–* | *27.68* | *–* | *–* | *1,107* | *–* | *7,000* |" in lines[7]
    assert "| 2DGS, sparse start | not applicable: the data have no gps |" in second.markdown()


class _Whole(dict[str, Any]):
    """A report that has all that is asked for, as far down as it is asked."""

    def get(self, key: str, default: object = None) -> Any:
        return self

    def __missing__(self, key: str) -> Any:
        return self

    def __bool__(self) -> bool:
        return True

    def __float__(self) -> float:
        return 1.0


def test_the_tables_ask_for_measures_by_the_names_that_the_recipes_give_them() -> None:
    looks = {"checkpoints": [_Whole(), _Whole()]}
    reports = dict.fromkeys(("map-sfm", "queries"), _Whole()) | {"train-map": _Whole(looks), "fusion": _Whole()}
    written = {**_map_metrics(reports), **geometry_metrics(_Whole())}
    assert set(MAP) <= set(written)


def test_distances_have_the_papers_beside_them(attempts: list[Attempt]) -> None:
    lines = lines_of(localization_tables(attempts)[0].markdown(), "Table 2: how near")
    assert lines[2] == "| 2DGS, sparse start | 0.081 | 0.042 | 0.310 | 0.120 | -0.012 | 0.143 | 0.88 |"
    assert lines[3] == "| 2DGS, dense start | 0.081 | 0.042 | 0.310 | 0.120 | – | 0.143 | 0.85 |"
    assert lines[4].startswith("| 2DGS, dense start, positions held | failed: No dense cloud |")
    assert lines[4].endswith("| 0.05 |")


def test_poses_tell_every_way_that_ran_and_those_that_did_not(attempts: list[Attempt]) -> None:
    lines = lines_of(localization_tables(attempts)[0].markdown(), "Table 3: poses")
    sparse = [line for line in lines if line.startswith("| 2DGS, sparse start | sfm-test |")]
    ours = "98.7 | 0.100 | 0.110 | 0.120 | 0.050 | 0.060 | 50.0 | 90.0 | 98.0 | 7.65 | 9.61 | 0.00 | 76 |"
    assert [line.split(" | ")[2] for line in sparse] == [
        "one shot, SuperPoint + LightGlue (the paper's method)",
        "one shot, ALIKED + LightGlue",
        "ours",
    ]
    assert sparse[0].endswith("| not run |  |  |  |  |  |  |  |  |  | 9.61 | 0.00 | 76 |")
    assert sparse[2].endswith(ours)
    far = [line for line in lines if line.startswith("| 2DGS, sparse start | sfm-test-pos10 |")]
    # A way that the table does not know stands under its own name, after the known ones.
    assert [line.split(" | ")[2] for line in far] == [
        "one shot, SuperPoint + LightGlue (the paper's method)",
        "ours",
        "one-shot-orb",
    ]
    assert "| 98.7 | 3.000 | 3.300 | 3.600 |" in far[0]
    # Nothing of this scenario ran: both expected ways say so.
    nothing = [line for line in lines if line.startswith("| 2DGS, sparse start | calc-test |")]
    assert [line.split(" | ")[3] for line in nothing] == ["not run", "not run"]
    published = [line for line in lines if line.startswith("| *2DGS, sparse start* | *sfm-test-pos10* |")]
    assert "| *3.24* |  | *3.91* | *0.67* | *1.20* |" in published[0]
    assert "| *9.55* |" in published[0]
    # Where there was nothing to start from, the reason stands there.
    blind = [line for line in lines if line.startswith("| 2DGS, dense start | calc-test |")]
    assert "| ours | not run: Query 'a.jpg' has no start by sensors |" in blind[1]
    # None found: no error, and it is said how many were found.
    lost = [line for line in lines if line.startswith("| 2DGS, dense start | sfm-test | ours |")]
    assert "| ours | 0.0 | – | 0.110 | – | 0.050 |" in lost[0]
    failed = [line for line in lines if line.startswith("| 2DGS, dense start, positions held |")]
    assert len(failed) == 1
    assert "failed: No dense cloud" in failed[0]
    # The paper's figures stand there all the same.
    assert sum(line.startswith("| *2DGS, dense start, positions held* |") for line in lines) == 4


def test_each_line_has_as_many_cells_as_its_head(attempts: list[Attempt], tmp_path: Path) -> None:
    tables = localization_tables(attempts)
    path = write_localization_tables(tables, tmp_path / "out")
    assert path.name == "tables1to3.md"
    text = path.read_text(encoding="utf-8")
    assert (text.count("## nadir"), text.count("## other")) == (1, 1)
    blocks = [block for block in text.split("\n\n") if block.startswith("|")]
    assert len(blocks) == 6
    for block in blocks:
        assert len({line.count("|") for line in block.splitlines()}) == 1


def test_mean_errors_are_what_the_bars_draw(attempts: list[Attempt]) -> None:
    errors = localization_tables(attempts)[0].mean_errors()
    assert list(errors) == [
        "one shot, SuperPoint + LightGlue (the paper's method)",
        "one shot, ALIKED + LightGlue",
        "ours",
        "one-shot-orb",
        PUBLISHED,
    ]
    nothing = dict.fromkeys(SCENARIOS)
    assert errors["ours"] == {
        "2DGS, sparse start": nothing | {"sfm-test": 0.1, "sfm-test-pos10": pytest.approx(0.11)},
        "2DGS, dense start": nothing,
        "2DGS, dense start, positions held": nothing,
    }
    assert errors[PUBLISHED]["2DGS, dense start, positions held"]["sfm-test-pos10"] == 3.77
    drawn = mte_bars(errors, reference=PUBLISHED)
    assert len(drawn.data) == 5


def test_the_papers_figures_are_those_of_its_tables() -> None:
    assert [row.c2c for row in PAPER_MAPS.values()] == [0.88, 0.85, 0.05]
    assert round(PAPER_DENSE / PAPER_SPARSE, 1) == 62.3
    assert [row.seconds for row in PAPER_MAPS.values()] == [3593, 4202, 1107]
    for by_scenario in PAPER_POSES.values():
        assert tuple(by_scenario) == SCENARIOS
        assert by_scenario["sfm-test-pos10"].start_mte in {9.55, 9.73, 9.60}
        for row in by_scenario.values():
            # A root mean square is no less than the mean.
            assert row.rmse_t >= row.mte
            assert row.rmse_r >= row.mre


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.key)
def test_each_row_changes_settings_that_its_recipe_has(row: PaperRow, tmp_path: Path) -> None:
    options = TableOptions(tmp_path, {"train.steps": 30, "train.max_side": 200})
    settings: Any = row_settings(row, find_recipe(row.recipe), options)
    assert (settings.train.steps, settings.train.max_side) == (30, 200)
