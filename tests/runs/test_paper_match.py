"""Runs that are rows of the paper's table stand beside its figures; others do not."""

from __future__ import annotations

import dataclasses

import pytest
from fake_recipe import MakeRun

from toolkit.recipes.base import StageTime
from toolkit.runs.compare import ComparedRun, Comparison, compare_runs
from toolkit.runs.paper_match import paper_pairs, paper_row
from toolkit.runs.report_tables import paper_section


@pytest.fixture
def comparison(finished: MakeRun, queued: MakeRun) -> Comparison:
    return compare_runs([finished(name="<i>ours"), finished(name="other"), queued(name="waiting")])


def made_by(item: ComparedRun, recipe: str, **settings: object) -> ComparedRun:
    dotted = {name.replace("__", "."): value for name, value in settings.items()}
    record = dataclasses.replace(item.record, recipe=recipe, settings=dotted)
    if item.result is None:
        return dataclasses.replace(item, record=record)
    result = dataclasses.replace(
        item.result,
        metrics={"test.psnr": 25.0, "test.lpips_vgg": 0.25, "poses.sim3.pos": 0.5},
        times=(StageTime("sfm", 60.0), StageTime("train", 120.0), StageTime("measure", 5.0)),
    )
    return dataclasses.replace(item, record=record, result=result)


def test_the_row_follows_from_recipe_and_settings(comparison: Comparison) -> None:
    item = comparison.runs[0]
    assert paper_row(item.record) is None
    exhaustive = paper_row(made_by(item, "colmap-3dgs", pairs__method="exhaustive").record)
    assert exhaustive is not None
    assert exhaustive.key == "colmap-3dgs"
    spatial = paper_row(made_by(item, "colmap-3dgs", pairs__method="spatial").record)
    assert spatial is not None
    assert (spatial.key, spatial.paper) == ("colmap-3dgs-spatial", None)
    plane = paper_row(made_by(item, "noposegs", start="plane").record)
    assert plane is not None
    assert plane.key == "noposegs-plane"  # the more particular of two that fit
    assert paper_row(made_by(item, "colmap-3dgs").record) is None


def test_ours_and_the_papers_stand_side_by_side(comparison: Comparison) -> None:
    runs = (
        made_by(comparison.runs[0], "colmap-3dgs", pairs__method="exhaustive"),
        comparison.runs[1],
        made_by(comparison.runs[2], "colmap-3dgs", pairs__method="exhaustive"),  # without a result
    )
    pairs = paper_pairs(runs)
    assert [(pair.position, pair.label) for pair in pairs] == [(0, "<i>ours")]
    assert pairs[0].both("psnr") == (25.0, 31.219)
    assert pairs[0].both("lpips") == (0.25, 0.122)
    assert pairs[0].both("ate") == (None, None)
    assert pairs[0].both("total") == (180.0, 3581.0)
    text = str(paper_section(dataclasses.replace(comparison, runs=runs)))
    for part in (
        "Beside the paper",
        "&lt;i&gt;ours",
        "paper: COLMAP + 3DGS",
        "<td>25.000</td><td>31.219</td>",
        "<td>00:01:00</td><td>00:29:10</td>",
        "not of these pictures",
        "Only the order of methods can be compared",
    ):
        assert part in text
    assert "<i>" not in text


def test_without_rows_of_the_table_there_is_no_section(comparison: Comparison) -> None:
    assert paper_section(comparison) is None
