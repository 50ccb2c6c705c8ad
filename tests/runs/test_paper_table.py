"""The paper's table from results that were written by hand: means, times, failures, and three kinds of text."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from fake_recipe import RECIPE, FakeSettings, MakeRun, write_photos
from PIL import Image

from toolkit.errors import Cancelled, MissingDependencyError, WeightsMissingError
from toolkit.progress import ProgressEvent
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult, StageTime
from toolkit.recipes.registry import all_recipes
from toolkit.runs.folder import RunFolder
from toolkit.runs.index import list_runs
from toolkit.runs.paper_figures import render_grid, write_trajectories
from toolkit.runs.paper_rows import MEASURES, ROWS, PaperFigures, PaperRow
from toolkit.runs.paper_runs import Attempt, TableOptions, make_attempts, row_settings
from toolkit.runs.paper_table import Entry, PaperTable, TableRow, paper_table, stage_seconds
from toolkit.runs.paper_text import clock, table_csv, table_latex, table_markdown, write_table
from toolkit.runs.record import RunRecord

SUBSTITUTING = {"depth.provider", "start"}
FAKE = PaperRow("fake", "Fake & Co_100%", "fake", paper_title="Fake", paper=ROWS[2].paper)
STRICT = PaperRow("strict", "Strict", "fake", {"loop.rate": 1.0}, needs="gps and gimbal")
ABSENT = PaperRow("absent", "Absent", "nothing-of-this-name")
FAILING = PaperRow("failing", "Failing", "fake", {"fail_at": 3})


def read_csv(table: PaperTable) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(table_csv(table))))


@pytest.fixture
def options(runs_dir: Path) -> TableOptions:
    return TableOptions(runs_dir, {"loop.steps": 5, "train.steps": 7})


def attempts_of(finished: MakeRun, rates: dict[str, float], failed: dict[str, str]) -> list[Attempt]:
    """Return attempts of one row: finished ones on data sets by their rate, failed ones with a reason."""
    done = [Attempt(FAKE, name, "finished", run=finished(loop__rate=rate)) for name, rate in rates.items()]
    return [*done, *(Attempt(FAKE, name, "failed", reason) for name, reason in failed.items())]


def test_means_leave_out_failed_scenes_and_say_how_many_are_in_them(finished: MakeRun) -> None:
    table = paper_table(attempts_of(finished, {"a": 0.5, "b": 1.5}, {"c": "it ran out of memory"}))
    (row,) = table.rows
    assert row.finished == 2
    assert row.mean.values["ate"] == pytest.approx(1.0)  # the fake recipe's ATE is its rate
    psnr = [row.entries[name].values["psnr"] for name in "ab"]
    assert row.mean.values["psnr"] == pytest.approx(np.mean([value for value in psnr if value is not None]))
    assert row.mean.values["lpips"] is None
    assert (row.entries["a"].registered, row.entries["a"].frames) == (6, 6)
    assert (row.mean.registered, row.mean.frames) == (12, 12)
    text = table_markdown(table)
    assert "| 2 of 3 |" in text
    assert "failed: it ran out of memory" in text
    assert "LPIPS: weights missing (test.lpips_vgg)." in text


def test_a_method_that_failed_everywhere_has_its_reason_instead_of_means(finished: MakeRun) -> None:
    table = paper_table(attempts_of(finished, {}, {"a": "first", "b": "second"}))
    assert "| 0 of 2 | failed: first; failed: second |" in table_markdown(table)
    assert r"0/2 & \multicolumn{9}{l}{failed: first; failed: second} \\" in table_latex(table)


def test_narrow_cells_have_the_first_clause_and_no_word_twice() -> None:
    reason = "Weights missing: no DPT; expected a folder; found nothing."
    attempt = Attempt(FAKE, "a", "weights missing", reason)
    assert attempt.text == "weights missing: no DPT; expected a folder; found nothing."
    assert attempt.brief == "weights missing: no DPT"
    text = table_markdown(paper_table([attempt]))
    assert "| 0 of 1 | weights missing: no DPT |" in text
    assert "| – | weights missing: no DPT |" in text  # of the data set
    # All of it is in the file for other programs.
    assert "weights missing: no DPT; expected a folder; found nothing." in table_csv(paper_table([attempt]))


def test_times_are_summed_by_part_without_measuring_and_compiling() -> None:
    times = [
        StageTime("features", 2.0, reused=True),
        StageTime("matches", 3.0),
        StageTime("sfm", 5.0),
        StageTime("intrinsics", 100.0),
        StageTime("undistort", 1.0),
        StageTime("compile", 20.0),
        StageTime("train", 30.0),
        StageTime("measure", 1000.0),
        StageTime("tea", 4.0),
    ]
    found = stage_seconds(times)
    assert (found.poses, found.scene, found.total) == (10.0, 31.0, 45.0)
    assert found.unknown == ("tea",)


def test_methods_without_a_stage_for_poses_have_a_total_only() -> None:
    found = stage_seconds([StageTime("undistort", 1.0), StageTime("train", 2.0)])
    assert (found.poses, found.scene, found.total) == (None, None, 3.0)


def test_stages_in_no_list_are_told(finished: MakeRun) -> None:
    # The fake recipe's stages are "prepare", which the table does not know, and "train".
    table = paper_table(attempts_of(finished, {"a": 0.5}, {}))
    assert "These stages count in the total only: prepare." in table.notes


def test_the_papers_figures_are_those_of_its_table() -> None:
    paper = {row.key: row.paper for row in ROWS if row.paper is not None}
    assert list(paper) == ["colmap-3dgs", "cf-3dgs", "noposegs", "orbslam-noposegs", "sensor-dpt"]
    assert paper["sensor-dpt"] == PaperFigures(24.710, 0.698, 0.372, 0.615, 0.856, 0.666, 31.0, 1032.0, 1063.0)
    # The paper rounds each mean: parts and total may differ by a second.
    for figures in paper.values():
        if figures.poses is not None and figures.scene is not None:
            assert figures.poses + figures.scene == pytest.approx(figures.total, abs=1.0)
    assert paper["cf-3dgs"].scenes == 3


def test_a_note_tells_that_the_papers_text_and_table_disagree(finished: MakeRun) -> None:
    text = table_markdown(paper_table(attempts_of(finished, {"a": 0.5}, {})))
    assert "text and its table disagree on POS" in text
    assert "*4.732*" in text  # the paper's row under ours
    assert "*paper: Fake*" in text


def test_csv_has_every_number_unrounded_and_keeps_commas_inside_cells(finished: MakeRun) -> None:
    lines = read_csv(paper_table(attempts_of(finished, {"a": 0.123456789}, {"b": 'of "x", it\nfailed'})))
    assert [(line["source"], line["of"], line["n"]) for line in lines] == [
        ("ours", "a", "1"),
        ("ours", "b", "0"),
        ("ours", "mean", "1"),
        ("paper", "mean", "3"),
    ]
    assert float(lines[0]["ate"]) == 0.123456789
    assert lines[1]["outcome"] == 'failed: of "x", it\nfailed'
    assert lines[3]["poses_seconds"] == ""
    assert float(lines[3]["total_seconds"]) == 8410.0


def test_latex_escapes_its_own_characters_and_has_equally_many_cells(finished: MakeRun) -> None:
    latex = table_latex(paper_table(attempts_of(finished, {"a": 0.5}, {})))
    assert r"Fake \& Co\_100\% & 1/1 & " in latex
    rows = [line for line in latex.splitlines() if line.endswith(r"\\")]
    assert {line.replace(r"\&", "").count("&") for line in rows} == {1 + len(MEASURES) + 3}
    assert "–" not in latex
    assert "°" not in latex


def test_the_best_of_at_least_two_is_bold() -> None:
    def row(key: str, psnr: float, seconds: float) -> TableRow:
        entry = Entry({"psnr": psnr, "total": seconds})
        return TableRow(PaperRow(key, key, key), {"a": entry}, entry, 1)

    table = PaperTable((row("x", 20.0, 59.6), row("y", 25.0, 60.4)), ("a",), ())
    lines = {line.split(" | ")[0]: line for line in table_markdown(table).splitlines()}
    assert "**25.000**" in lines["| y"]
    assert "**20.000**" not in lines["| x"]
    # Both are shown as 00:01:00.
    assert "**00:01:00**" in lines["| x"]
    assert "**00:01:00**" in lines["| y"]


def test_a_method_that_got_lost_is_not_the_best_in_poses() -> None:
    def row(key: str, registered: int, pos: float) -> TableRow:
        entry = Entry({"pos": pos, "psnr": pos}, registered, 30)
        return TableRow(PaperRow(key, key, key), {"a": entry}, entry, 1)

    def best(registered: int) -> int:
        table = PaperTable((row("x", registered, 0.001), row("y", 30, 0.5)), ("a",), ())
        return table_markdown(table).count("**0.001**")

    assert best(30) > 0
    assert best(3) == 0


def test_lpips_without_any_test_view_is_told_as_missing(finished: MakeRun) -> None:
    attempts = attempts_of(finished, {"a": 0.5, "b": 1.5}, {})
    run = attempts[0].run
    assert run is not None
    path = run.artifacts / "result.json"
    stored = json.loads(path.read_text(encoding="utf-8"))
    stored["metrics"] = {name: v for name, v in stored["metrics"].items() if not name.startswith("test.lpips")}
    path.write_text(json.dumps(stored), encoding="utf-8")
    assert "LPIPS: weights missing (test.lpips_vgg)." in table_markdown(paper_table(attempts))


def test_the_best_is_not_marked_where_test_views_or_data_sets_differ(finished: MakeRun) -> None:
    other = PaperRow("other", "Other", "fake")

    def table(name: str, **changes: int) -> PaperTable:
        runs = finished(loop__rate=0.5), finished(loop__rate=2.0, **changes)
        return paper_table(
            [Attempt(FAKE, "a", "finished", run=runs[0]), Attempt(other, name, "finished", run=runs[1])]
        )

    def fake_means(made: PaperTable) -> str:
        return next(line for line in table_markdown(made).splitlines() if line.startswith("| Fake"))

    # The lower rate has the better PSNR and the lower ATE; both have the same SSIM.
    assert fake_means(table("a")).count("**0.500**") == 2
    views = table("a", test_every=3)
    assert fake_means(views).count("**0.500**") == 1  # the ATE alone
    assert any("different test views (Fake & Co_100% 3, Other 2)" in note for note in views.notes)
    assert "**" not in fake_means(table("b"))


def test_clocks_are_the_papers() -> None:
    assert [clock(seconds) for seconds in (0.4, 31, 8410, None)] == ["00:00:00", "00:00:31", "02:20:10", "–"]


def test_runs_are_made_failures_recorded_and_finished_ones_taken_again(photos: Path, options: TableOptions) -> None:
    rows, recipes = [FAKE, STRICT, ABSENT, FAILING], {"fake": RECIPE}
    first = make_attempts(rows, {"set": photos}, recipes, options)
    assert [attempt.text for attempt in first] == [
        "finished",
        "not applicable: the data have no gps and no gimbal",
        "not there: no recipe 'nothing-of-this-name'",
        "failed: The fake recipe fails here; found step 3.",
    ]
    again = make_attempts(rows, {"set": photos}, recipes, options)
    assert [attempt.run for attempt in again] == [attempt.run for attempt in first]
    assert len(list_runs(options.runs_dir)) == 2  # the failed one was tried again in its own folder


def test_the_record_of_a_run_is_read_once_for_a_table(
    photos: Path, options: TableOptions, finished: MakeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = {finished(loop__rate=rate) for rate in (0.7, 0.8)}  # of no row of this table
    read: Counter[RunFolder] = Counter()
    record = RunFolder.record

    def counted(run: RunFolder) -> RunRecord:
        read[run] += 1
        return record(run)

    monkeypatch.setattr(RunFolder, "record", counted)
    rows = [dataclasses.replace(FAKE, key=str(rate), changes={"loop.rate": rate}) for rate in (1.0, 1.1, 1.2)]
    attempts = make_attempts(rows, {"set": photos}, {"fake": RECIPE}, options)
    assert {read[run] for run in others} == {1}
    assert len({attempt.run for attempt in attempts}) == len(rows)


def test_a_run_that_one_row_made_is_taken_by_the_next_that_asks_for_the_same(
    photos: Path, options: TableOptions
) -> None:
    twin = dataclasses.replace(FAKE, key="twin")
    first, second = make_attempts([FAKE, twin], {"set": photos}, {"fake": RECIPE}, options)
    assert first.run == second.run


def test_another_setting_seed_or_force_makes_another_run(photos: Path, options: TableOptions) -> None:
    def run_of(changed: TableOptions) -> RunFolder | None:
        return make_attempts([FAKE], {"set": photos}, {"fake": RECIPE}, changed)[0].run

    others = [
        TableOptions(options.runs_dir, {"loop.steps": 6}),
        TableOptions(options.runs_dir, options.changes, seed=1),
        TableOptions(options.runs_dir, options.changes, force=True),
    ]
    first = run_of(options)
    assert first is not None
    assert first.record().flat_settings["loop.steps"] == 5
    assert len({run.id for other in others if (run := run_of(other)) is not None} - {first.id}) == 3


def test_cancelling_ends_the_table_and_the_run_goes_on_next_time(photos: Path, options: TableOptions) -> None:
    def cancel(event: ProgressEvent) -> None:
        if event.stage == "train" and event.done == 2:
            raise Cancelled("enough")

    with pytest.raises(Cancelled, match="enough"):
        make_attempts([FAKE], {"set": photos}, {"fake": RECIPE}, options, progress=cancel)
    (stopped,) = list_runs(options.runs_dir)
    assert stopped.state == "cancelled"
    (attempt,) = make_attempts([FAKE], {"set": photos}, {"fake": RECIPE}, options)
    assert attempt.outcome == "finished"
    assert attempt.run == stopped.run


@pytest.mark.parametrize(
    ("error", "outcome", "reason"),
    [
        (
            WeightsMissingError("No weights of DPT here\nsecond line"),
            "weights missing",
            "No weights of DPT here",
        ),
        (
            MissingDependencyError("Package x with weights is missing"),
            "failed",
            "Package x with weights is missing.",
        ),
        (RuntimeError("out of memory"), "failed", "RuntimeError: out of memory"),
    ],
)
def test_the_reason_is_the_first_line_of_the_error(
    photos: Path, options: TableOptions, error: Exception, outcome: str, reason: str
) -> None:
    def fail(data: RecipeInput, settings: FakeSettings, context: RecipeContext) -> RecipeResult:
        raise error

    failing = Recipe("fake", "", "", "", FakeSettings, fail)
    (attempt,) = make_attempts([FAKE], {"set": photos}, {"fake": failing}, options)
    assert (attempt.outcome, attempt.reason) == (outcome, reason)


def test_settings_that_a_recipe_does_not_have_are_left_alone(options: TableOptions) -> None:
    settings = row_settings(STRICT, RECIPE, options)
    assert dict(settings.items())["loop.steps"] == 5
    assert dict(settings.items())["loop.rate"] == 1.0


def test_what_tracks_through_a_video_is_not_applicable_to_photos(photos: Path, options: TableOptions) -> None:
    tracking = PaperRow("tracking", "Tracking", "fake", needs="video")
    (attempt,) = make_attempts([tracking], {"set": photos}, {"fake": RECIPE}, options)
    assert attempt.text == "not applicable: the data have no video"


def test_every_row_has_a_recipe_that_takes_its_changes(options: TableOptions) -> None:
    recipes = all_recipes()
    for row in ROWS:
        settings = dict(row_settings(row, recipes[row.recipe], options).items())
        assert settings["train.steps"] == 7
        assert all(settings[name] == value for name, value in row.changes.items())


def test_what_stands_in_for_a_network_has_a_title_of_its_own_beside_no_figures_of_the_paper() -> None:
    substitutes = [row for row in ROWS if row.recipe == "sensor-ground" or row.changes.keys() & SUBSTITUTING]
    assert {row.recipe for row in substitutes} == {"cf-3dgs", "noposegs", "sensor-ground"}
    for row in substitutes:
        assert row.paper is None
        assert "plane" in row.title
    assert len({row.title for row in ROWS}) == len(ROWS)


@pytest.mark.parametrize("rank", ["median", "worst"])
def test_the_grid_has_a_column_a_data_set_and_a_row_a_method(
    tmp_path: Path, photos: Path, options: TableOptions, rank: str
) -> None:
    data = {"one": photos, "two": write_photos(tmp_path / "two", seed=1)}
    attempts = make_attempts([FAKE, FAILING], data, {"fake": RECIPE}, options)
    chosen = render_grid(attempts, tmp_path / "grid.png", rank="worst" if rank == "worst" else "median")
    # The fake recipe draws every second photo, each one worse than the one before.
    assert chosen == dict.fromkeys(data, "photo_4.png" if rank == "worst" else "photo_2.png")
    with Image.open(tmp_path / "grid.png") as picture:
        width, height = picture.size
        pixels = np.asarray(picture.convert("RGB"))
    assert width == 170 + 2 * 326
    row = (height - 24) // 3
    assert tuple(pixels[24 + 2 * row + row // 2, 170 + 300]) == (228, 231, 236)  # the failed method's cell
    assert pixels[24 : 24 + row - 6, 170:490].std() > 10  # the photo


def test_trajectories_are_drawn_a_page_a_data_set(tmp_path: Path, finished: MakeRun) -> None:
    attempts = attempts_of(finished, {"a": 0.5}, {"b": "no"})
    (page,) = write_trajectories(attempts, tmp_path)
    assert page.name == "trajectories_a.html"
    text = page.read_text(encoding="utf-8")
    assert "Fake &amp; Co_100%" in text or "Fake \\u0026amp; Co_100%" in text
    assert "<script src=" not in text  # it holds its script


def test_three_files_are_written(tmp_path: Path, finished: MakeRun) -> None:
    files = write_table(paper_table(attempts_of(finished, {"a": 0.5}, {})), tmp_path / "out")
    assert [path.name for path in files] == ["table3.md", "table3.csv", "table3.tex"]
    assert all(path.stat().st_size > 100 for path in files)
