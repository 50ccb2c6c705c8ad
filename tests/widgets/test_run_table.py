"""The list shows every run, follows the disk, and lets only what it lists be chosen."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_recipe import RECIPE, MakeRun

from toolkit.errors import RunError
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import execute
from toolkit.widgets.run_table import MOST_CHOSEN, RunTable

# Panel still says `inplace`, which the newest pandas wishes away.
pytestmark = pytest.mark.filterwarnings(r"ignore:The inplace keyword in DataFrame\.\w+ is deprecated")


def table_of(runs_dir: Path) -> RunTable:
    table = RunTable(runs_dir)
    table.refresh()
    return table


def cells(table: RunTable, run: RunFolder) -> dict[str, object]:
    return dict(table.__panel__().value.loc[run.id])


def tick(table: RunTable, *places: int) -> None:
    """Tick rows as the browser does."""
    table.__panel__().selection = list(places)


def test_rows_tell_what_a_run_is_and_measured(pair: list[RunFolder], failed: RunFolder, runs_dir: Path) -> None:
    table = table_of(runs_dir)
    assert list(table.rows) == sorted(run.id for run in [*pair, failed])
    done, stopped = cells(table, pair[1]), cells(table, failed)
    result = pair[1].result()
    assert (done["name"], done["state"], done["recipe"], done["data"]) == ("fast", "finished", "fake", "photos")
    assert done["psnr"] == result.metrics["test.psnr"]
    assert done["remark"] == ""
    assert stopped["state"] == "failed"
    assert stopped["psnr"] != stopped["psnr"]  # not a number: there is none
    assert "The fake recipe fails here; found step 20." in str(stopped["remark"])


def test_a_damaged_run_is_a_row_with_its_error(pair: list[RunFolder], runs_dir: Path) -> None:
    pair[0].record_file.write_text("{")
    row = cells(table_of(runs_dir), pair[0])
    assert row["state"] == "damaged"
    assert "run.json" in str(row["remark"])


def test_long_errors_are_cut(pair: list[RunFolder], runs_dir: Path) -> None:
    pair[0].record_file.write_text(f'["{"x" * 5000}"]')
    assert len(str(cells(table_of(runs_dir), pair[0])["remark"])) <= 160


def test_refreshing_reads_only_what_changed(
    pair: list[RunFolder], runs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = table_of(runs_dir)

    def refuse(run: RunFolder) -> None:
        raise AssertionError(f"{run.id} was read again")

    with monkeypatch.context() as patched:
        patched.setattr("toolkit.widgets.run_table.summarise", refuse)
        assert not table.refresh()
    pair[0].status_file.write_text("{")
    assert table.refresh()
    assert cells(table, pair[0])["state"] == "damaged"
    assert cells(table, pair[1])["state"] == "finished"


def test_new_and_removed_runs_appear_and_the_choice_stays(
    pair: list[RunFolder], finished: MakeRun, runs_dir: Path
) -> None:
    table = table_of(runs_dir)
    table.choose([pair[1].id, pair[0].id])
    new = finished(name="new")
    assert table.refresh()
    assert new.id in table.rows
    assert table.chosen == [pair[1].id, pair[0].id]
    pair[0].path.rename(runs_dir.parent / "elsewhere")
    assert table.refresh()
    assert table.chosen == [pair[1].id]
    assert list(table.__panel__().value.index[table.__panel__().selection]) == [pair[1].id]


def test_a_queued_run_becomes_a_finished_one(queued: MakeRun, runs_dir: Path) -> None:
    run = queued(name="waiting")
    table = table_of(runs_dir)
    assert cells(table, run)["state"] == "queued"
    execute(run, recipe=RECIPE)
    assert table.refresh()
    assert cells(table, run)["state"] == "finished"
    assert cells(table, run)["psnr"] == run.result().metrics["test.psnr"]


def test_ticks_are_choices_in_the_order_of_ticking(pair: list[RunFolder], runs_dir: Path) -> None:
    table = table_of(runs_dir)
    listed = list(table.rows)
    tick(table, 1)
    tick(table, 0, 1)
    assert table.chosen == [listed[1], listed[0]]
    tick(table, 0)
    assert table.chosen == [listed[0]]


def test_a_fifth_run_is_refused_with_a_reason(queued: MakeRun, runs_dir: Path) -> None:
    for number in range(MOST_CHOSEN + 1):
        queued(name=f"run {number}")
    table = table_of(runs_dir)
    tick(table, *range(MOST_CHOSEN))
    before = table.chosen
    tick(table, *range(MOST_CHOSEN + 1))
    assert table.chosen == before
    assert table.refused == "At most 4 runs fit side by side: untick one first."
    assert len(table.__panel__().selection) == MOST_CHOSEN
    tick(table, 0)
    assert table.refused == ""


def test_only_listed_ids_can_be_chosen(pair: list[RunFolder], runs_dir: Path) -> None:
    table = table_of(runs_dir)
    (runs_dir.parent / "secret").mkdir()
    odd = ["../secret", str(runs_dir.parent / "secret"), "latest", "", pair[0].id[:-1], f"{pair[0].id}/../x"]
    assert table.choose([*odd, pair[0].id]) == odd
    assert table.chosen == [pair[0].id]


def test_the_two_newest_finished_runs_are_chosen_first(
    pair: list[RunFolder], failed: RunFolder, runs_dir: Path
) -> None:
    table = table_of(runs_dir)
    table.choose_newest()
    assert table.chosen == [run.id for run in sorted(pair, key=lambda run: run.record().created)]


def test_texts_are_drawn_as_text(runs_dir: Path) -> None:
    formatters = table_of(runs_dir).__panel__().formatters
    texts = [name for name, how in formatters.items() if isinstance(how, dict)]
    assert all(formatters[name] == {"type": "plaintext"} for name in texts)
    assert {"name", "state", "recipe", "data", "remark"} <= set(texts)


def test_a_folder_that_refuses_is_told(runs_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs_dir.mkdir()

    def refuse(self: Path) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(RunError, match="Not allowed while listing"):
        RunTable(runs_dir).refresh()


def test_a_folder_that_is_not_there_has_no_rows(runs_dir: Path) -> None:
    table = RunTable(runs_dir)
    assert not table.refresh()
    table.choose_newest()
    assert table.chosen == []
