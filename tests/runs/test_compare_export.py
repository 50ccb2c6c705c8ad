"""A comparison as CSV and LaTeX says what the page says, and nothing in it is taken for a command."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest
from fake_recipe import MakeRun

from toolkit.runs.compare import compare_runs
from toolkit.runs.compare_export import comparison_csv, comparison_latex, list_csv
from toolkit.runs.folder import RunFolder
from toolkit.runs.index import list_runs
from toolkit.runs.notes import RunNotes, write_notes

ODD = '=HYPERLINK("x") & 100% _of_ {it}'


@pytest.fixture
def pair(finished: MakeRun) -> list[RunFolder]:
    return [finished(name=ODD, loop__rate=0.8), finished(name="fast", loop__rate=0.2)]


def lines_of(text: str) -> list[list[str]]:
    return list(csv.reader(io.StringIO(text)))


def test_csv_has_every_measure_time_and_differing_setting(pair: list[RunFolder]) -> None:
    comparison = compare_runs(pair)
    lines = lines_of(comparison_csv(comparison))
    assert lines[0] == ["kind", "name", f"'{ODD}", "fast"]  # no spreadsheet computes it
    table = {(line[0], line[1]): line[2:] for line in lines[1:]}
    assert [float(value) for value in table["measure", "test.psnr"]] == [
        run.result().metrics["test.psnr"] for run in pair
    ]
    assert table["measure", "test.lpips_vgg"] == ["", ""]
    assert [float(value) for value in table["seconds", "total"]] == [run.result().seconds for run in pair]
    assert table["setting", "loop.rate"] == ["0.8", "0.2"]
    assert table["fact", "id"] == [run.id for run in pair]
    assert {len(line) for line in lines} == {4}


def test_negative_numbers_stay_numbers_and_commands_become_text() -> None:
    from toolkit.runs.compare_export import _guarded

    assert [_guarded(cell) for cell in ("-1.5", "+2", "=1+1", "@x", "-x", "plain", "")] == [
        "-1.5",
        "+2",
        "'=1+1",
        "'@x",
        "'-x",
        "plain",
        "",
    ]


def test_the_list_has_a_line_a_run_with_the_columns_asked_for(pair: list[RunFolder], runs_dir: Path) -> None:
    write_notes(pair[1], RunNotes(("good", "new"), "two\nlines"))
    lines = lines_of(list_csv(list_runs(runs_dir), ["loop.rate", "test.psnr", "nothing"]))
    table = [dict(zip(lines[0], line, strict=True)) for line in lines[1:]]
    assert [entry["id"] for entry in table] == [run.id for run in pair]
    assert [entry["loop.rate"] for entry in table] == ["0.8", "0.2"]
    assert float(table[0]["test.psnr"]) == pair[0].result().metrics["test.psnr"]
    assert table[0]["nothing"] == ""
    assert (table[1]["tags"], table[1]["note"]) == ("good, new", "two\nlines")


def test_latex_escapes_names_and_marks_the_best(pair: list[RunFolder]) -> None:
    text = comparison_latex(compare_runs(pair))
    assert r'=HYPERLINK("x") \& 100\% \_of\_ \{it\}' in text
    assert r"poses.sim3.ate $\downarrow$ & 0.8000 & \textbf{0.2000} \\" in text
    assert r"test.lpips\_vgg $\downarrow$ & -- & -- \\" in text
    body = text.split("\\midrule")[1].split("\\bottomrule")[0].strip().split("\n")
    assert all(line.count(" & ") == 2 and line.endswith(r"\\") for line in body)
    assert body[-1].startswith("total time & ")
    assert text.count("{") == text.count("}")


def test_a_run_without_a_result_has_empty_cells(queued: MakeRun, pair: list[RunFolder]) -> None:
    comparison = compare_runs([pair[1], queued(name="waiting")])
    table = {(line[0], line[1]): line[2:] for line in lines_of(comparison_csv(comparison))}
    assert table["measure", "test.psnr"][1] == ""
    assert "total time & " in comparison_latex(comparison)
    assert "% waiting is queued and has no result yet." in comparison_latex(comparison)
