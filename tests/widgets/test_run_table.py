"""The list shows every run, follows the disk, and lets only what it lists be chosen."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import pytest
from fake_recipe import RECIPE, MakeRun

from toolkit.errors import RunError
from toolkit.runs.filters import RunFilter
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import execute
from toolkit.runs.notes import RunNotes, write_notes
from toolkit.widgets.run_table import MOST_CHOSEN, PAGE_ROWS, RunTable

# Panel still says `inplace`, which the newest pandas wishes away.
pytestmark = pytest.mark.filterwarnings(r"ignore:The inplace keyword in DataFrame\.\w+ is deprecated")


def table_of(runs_dir: Path) -> RunTable:
    table = RunTable(runs_dir)
    table.refresh()
    return table


def cells(table: RunTable, run: RunFolder) -> dict[str, object]:
    return dict(table.widget.value.loc[run.id])


def tick(table: RunTable, *places: int) -> None:
    """Tick rows as the browser does."""
    table.widget.selection = list(places)


def test_rows_tell_what_a_run_is_and_measured(pair: list[RunFolder], failed: RunFolder, runs_dir: Path) -> None:
    table = table_of(runs_dir)
    assert list(table.rows) == sorted(run.id for run in [*pair, failed])
    done, stopped = cells(table, pair[1]), cells(table, failed)
    result = pair[1].result()
    assert (done["name"], done["state"], done["recipe"], done["data"]) == ("fast", "finished", "fake", "photos")
    assert done["psnr"] == result.metrics["test.psnr"]
    assert done["remark"] == ""
    assert done["time"] == result.seconds
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
        patched.setattr("toolkit.runs.catalogue.summarise", refuse)
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
    name = pair[0].record().name
    pair[0].path.rename(runs_dir.parent / "elsewhere")
    assert table.refresh()
    assert table.chosen == [pair[1].id]
    assert table.gone == [name]
    assert list(table.widget.value.index[table.widget.selection]) == [pair[1].id]


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
    assert len(table.widget.selection) == MOST_CHOSEN
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
    formatters = table_of(runs_dir).widget.formatters
    texts = [name for name, how in formatters.items() if isinstance(how, dict)]
    assert all(formatters[name] == {"type": "plaintext"} for name in texts)
    assert {"name", "state", "recipe", "data", "remark"} <= set(texts)


def test_a_folder_that_refuses_is_told(runs_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs_dir.mkdir()

    def refuse(path: Path) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("toolkit.runs.index.os.scandir", refuse)
    with pytest.raises(RunError, match="Not allowed while listing"):
        RunTable(runs_dir).refresh()


def test_a_folder_that_is_not_there_has_no_rows(runs_dir: Path) -> None:
    table = RunTable(runs_dir)
    assert not table.refresh()
    table.choose_newest()
    assert table.chosen == []


def named(table: RunTable) -> list[str]:
    """Return the names of the rows that are shown."""
    return list(table.widget.value["name"])


def test_a_filter_hides_rows_and_leaves_the_choice(
    pair: list[RunFolder], failed: RunFolder, runs_dir: Path
) -> None:
    table = table_of(runs_dir)
    table.choose([pair[0].id])
    table.narrow(RunFilter(state="failed"))
    assert named(table) == ["stopped early"]
    assert table.shown == [failed.id]
    assert table.widget.selection == []
    tick(table, 0)
    assert table.chosen == [pair[0].id, failed.id]
    table.narrow(RunFilter())
    assert sorted(table.widget.selection) == sorted(table.shown.index(run_id) for run_id in table.chosen)
    table.narrow(RunFilter(words=("nothing",)))
    assert named(table) == []
    assert table.chosen == [pair[0].id, failed.id]


def test_new_runs_come_into_a_filtered_list_where_they_fit(
    pair: list[RunFolder], finished: MakeRun, runs_dir: Path
) -> None:
    table = table_of(runs_dir)
    table.narrow(RunFilter(words=("fast",)))
    finished(name="slow")
    finished(name="faster")
    assert table.refresh()
    assert sorted(named(table)) == ["fast", "faster"]


def test_columns_of_measures_and_settings_are_added(
    pair: list[RunFolder], failed: RunFolder, runs_dir: Path
) -> None:
    table = table_of(runs_dir)
    table.choose([pair[1].id])
    table.arrange(["loop.rate", "test.lpips_vgg", "loop.total"], "", "loop.rate", descending=False)
    frame = table.widget.value
    assert list(frame.loc[[run.id for run in pair], "extra0"]) == [0.8, 0.2]
    assert frame["extra2"].isna().sum() == 1  # the failed run has no measures
    assert table.widget.titles["extra0"] == "loop.rate"
    assert table.widget.sorters == [{"field": "extra0", "dir": "asc"}]
    assert [table.shown[i] for i in table.widget.selection] == [pair[1].id]
    tick(table, *range(2))
    assert len(table.chosen) == 2
    table.arrange(["loop.rate"], "", "created", descending=True)
    assert "extra1" not in table.widget.value


def test_groups_have_all_their_rows(pair: list[RunFolder], failed: RunFolder, runs_dir: Path) -> None:
    write_notes(pair[0], RunNotes(("b", "a")))
    table = table_of(runs_dir)
    assert table.widget.pagination == "remote"
    table.arrange([], "tags", "psnr", descending=True)
    assert table.widget.groupby == ["tags"]
    assert table.widget.pagination is None
    assert table.widget.sorters == [{"field": "tags", "dir": "asc"}, {"field": "psnr", "dir": "desc"}]
    assert cells(table, pair[0])["tags"] == "b, a"
    table.arrange([], "", "psnr", descending=False)
    assert table.widget.sorters == [{"field": "psnr", "dir": "asc"}]


def test_a_note_is_the_remark_of_a_run_without_errors(pair: list[RunFolder], runs_dir: Path) -> None:
    write_notes(pair[1], RunNotes((), "the one\nto keep"))
    assert cells(table_of(runs_dir), pair[1])["remark"] == "the one to keep"


def test_many_rows_come_a_page_at_a_time(queued: MakeRun, runs_dir: Path) -> None:
    first = queued(name="run 0")
    for number in range(1, 2 * PAGE_ROWS + 1):
        shutil.copytree(first.path, runs_dir / f"20250101-{number:06d}-fake-0000")
    table = table_of(runs_dir)
    assert len(table.widget.value) == 2 * PAGE_ROWS + 1
    table.widget.page = 3
    table.narrow(RunFilter(words=("20250101-00001",)))
    assert table.widget.page == 1
    assert len(table.shown) == 10


def test_a_long_list_keeps_its_height_while_it_is_filtered(queued: MakeRun, runs_dir: Path) -> None:
    first = queued(name="run 0")
    table = table_of(runs_dir)
    assert table.widget.height is None  # as tall as its row
    for number in range(1, PAGE_ROWS):
        shutil.copytree(first.path, runs_dir / f"20250101-{number:06d}-fake-0000")
    table.refresh()
    tall = table.widget.height
    assert tall == table.widget.max_height
    table.narrow(RunFilter(words=("20250101-000010",)))
    assert (len(table.shown), table.widget.height) == (1, tall)


def test_runs_that_were_not_read_yet_can_be_chosen(
    pair: list[RunFolder], runs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("toolkit.widgets.run_table._SLICE", 0.0)
    table = table_of(runs_dir)
    assert table.rows == {}
    assert table.catalogue.unread == 2
    assert table.choose([pair[0].id, "other"]) == ["other"]
    assert table.chosen == [pair[0].id]
    assert named(table) == [pair[0].record().name]


def test_a_look_of_another_page_is_taken_over(pair: list[RunFolder], finished: MakeRun, runs_dir: Path) -> None:
    other, one = table_of(runs_dir), table_of(runs_dir)
    new = finished(name="new")
    assert one.refresh()
    looks = one.catalogue.looks
    assert other.refresh()
    assert new.id in other.rows
    assert one.catalogue.looks == looks
    assert not other.refresh()
    assert one.catalogue.looks == looks + 1


def test_what_a_browser_may_have_missed_is_sent_again(
    pair: list[RunFolder], runs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("toolkit.widgets.run_table._BUILDING", 0.1)
    table = table_of(runs_dir)
    sent: list[int] = []
    table.arrange([], "recipe", "created", descending=True)
    table.widget.param.watch(lambda event: sent.append(len(event.new)), "value", onlychanged=False)
    table.narrow(RunFilter(words=("fast",)))
    assert sent == [1]
    table.refresh()
    assert sent == [1]
    time.sleep(0.15)
    table.refresh()
    table.refresh()
    assert sent == [1, 1]  # once more, and then no more
    table.narrow(RunFilter())
    table.refresh()
    assert sent == [1, 1, 2]
