"""The tab joins its parts: what one does, the others show; what goes wrong is said, and the tab goes on."""

from __future__ import annotations

import csv
import dataclasses
import io
import os
import shutil
from pathlib import Path

import panel as pn
import pytest
from fake_recipe import MakeRun
from panel.io.location import Location

from toolkit.runs.folder import RunFolder
from toolkit.runs.notes import read_notes
from toolkit.runs.process import ProcessMark
from toolkit.runs.status import RunStatus, utc_now, write_status
from toolkit.widgets.address import Address
from toolkit.widgets.compare_page import ComparePage

pytestmark = pytest.mark.filterwarnings(r"ignore:The inplace keyword in DataFrame\.\w+ is deprecated")


def said(page: ComparePage) -> str:
    """Return all HTML that can be seen."""
    panes = page.__panel__().select(pn.pane.HTML)
    return "\n".join(pane.object for pane in panes if pane.visible and pane.object)


def press(button: pn.widgets.Button) -> None:
    button.clicks += 1


def downloaded(button: pn.widgets.FileDownload) -> str:
    text: str = button.callback().read()
    return text


def test_a_filter_is_counted(pair: list[RunFolder], failed: RunFolder, runs_dir: Path) -> None:
    page = ComparePage(runs_dir)
    assert "3 runs in " in said(page)
    page.filters.text.value_input = "stopped"
    page.refresh()
    assert "The filter shows 1 of them." in said(page)
    page.filters.text.value_input = "nothing>1"
    assert "No run has a measure or setting" in said(page)


def test_tags_that_are_saved_are_in_the_list_at_once(pair: list[RunFolder], runs_dir: Path) -> None:
    page = ComparePage(runs_dir)
    page.editor.tags.value_input = "good"
    press(page.editor.save)
    assert read_notes(pair[1]).tags == ("good",)
    assert page.table.widget.value.loc[pair[1].id, "tags"] == "good"
    assert "good (1)" in page.filters.tag.options


def test_deleting_takes_a_run_out_of_list_and_comparison_and_undoing_brings_it_back(
    pair: list[RunFolder], runs_dir: Path
) -> None:
    page = ComparePage(runs_dir)
    press(page.editor.delete)
    assert list(page.table.rows) == [pair[0].id]
    assert page.table.chosen == [pair[0].id]
    assert page.comparison.comparison is not None
    assert len(page.comparison.comparison.runs) == 1
    press(page.editor.undo)
    assert sorted(page.table.rows) == sorted(run.id for run in pair)


def test_the_last_run_can_be_deleted_and_brought_back(finished: MakeRun, runs_dir: Path) -> None:
    run = finished(name="only")
    page = ComparePage(runs_dir)
    press(page.editor.delete)
    assert "No runs yet" in said(page)
    press(page.editor.undo)
    assert list(page.table.rows) == [run.id]
    assert "No runs yet" not in said(page)


def test_a_run_that_is_deleted_while_it_is_shown_is_told(pair: list[RunFolder], runs_dir: Path) -> None:
    page = ComparePage(runs_dir)
    other = ComparePage(runs_dir)
    press(other.editor.delete)
    page.refresh()
    assert "fast is not there any more: it was deleted or moved away." in said(page)
    assert page.table.chosen == [pair[0].id]
    assert page.comparison.comparison is not None
    page.refresh()
    assert "fast is not there any more" in said(page)
    page.table.choose([pair[0].id])
    assert "not there any more" not in said(page)


def test_a_folder_that_breaks_while_it_is_shown_is_told(pair: list[RunFolder], runs_dir: Path) -> None:
    page = ComparePage(runs_dir)
    pair[1].record_file.write_text("{")
    page.refresh()
    assert f"{pair[1].id} cannot be shown: " in said(page)
    assert page.table.widget.value.loc[pair[1].id, "state"] == "damaged"
    assert page.comparison.comparison is not None
    assert [item.run for item in page.comparison.comparison.runs] == [pair[0]]


def test_a_worker_that_was_killed_is_told(queued: MakeRun, runs_dir: Path) -> None:
    run = queued(name="at work")
    mark, now = ProcessMark.current(), utc_now()
    write_status(run.status_file, RunStatus("running", "train", 10, 30, "", now, now, "", mark))
    page = ComparePage(runs_dir)
    assert page.table.widget.value.loc[run.id, "state"] == "running"
    before = run.status_file.stat()
    gone = dataclasses.replace(mark, started="1" * len(mark.started))
    write_status(run.status_file, dataclasses.replace(run.status(), process=gone))
    os.utime(run.status_file, ns=(before.st_atime_ns, before.st_mtime_ns))
    page.refresh()
    assert page.table.widget.value.loc[run.id, "state"] == "interrupted"
    assert "is gone" in page.table.widget.value.loc[run.id, "remark"]
    assert 'class="badge interrupted"' in said(page)


def test_the_whole_folder_may_vanish(pair: list[RunFolder], runs_dir: Path) -> None:
    page = ComparePage(runs_dir)
    shutil.rmtree(runs_dir)
    page.refresh()
    assert "No runs yet" in said(page)
    assert "not there any more" in said(page)
    assert page.comparison.comparison is None


def test_another_tab_chooses_a_run(pair: list[RunFolder], finished: MakeRun, runs_dir: Path) -> None:
    third = finished(name="third")
    location = Location(search=f"?runs={pair[0].id}")
    page = ComparePage(runs_dir, Address(location))
    assert page.selected == pair[0].id
    page.selected = third.id
    assert page.table.chosen == [pair[0].id, third.id]
    assert page.editor.selected == third.id
    assert f"{pair[0].id},{third.id}" in location.search
    page.selected = "20990101-000000-fake-0000"
    assert "There is no run &#x27;20990101-000000-fake-0000&#x27;" in said(page)
    assert page.table.chosen == [pair[0].id, third.id]


def test_the_selected_run_is_always_a_chosen_one(pair: list[RunFolder], runs_dir: Path) -> None:
    page = ComparePage(runs_dir)
    assert page.selected == pair[1].id
    page.table.choose([pair[0].id])
    assert page.selected == pair[0].id
    page.table.choose([])
    assert page.selected == ""


def test_files_are_offered_for_what_is_shown(pair: list[RunFolder], failed: RunFolder, runs_dir: Path) -> None:
    page = ComparePage(runs_dir)
    page.table.choose([run.id for run in pair])
    table = list(csv.reader(io.StringIO(downloaded(page.downloads.csv))))
    assert table[0][:2] == ["kind", "name"]
    assert "fast" in table[0]
    assert r"\begin{tabular}{lrr}" in downloaded(page.downloads.latex)
    html = downloaded(page.downloads.html)
    assert html.startswith("<!DOCTYPE html>")
    assert "Content-Security-Policy" in html
    page.filters.text.value_input = "stopped"
    listed = list(csv.reader(io.StringIO(downloaded(page.downloads.list))))
    assert [line[0] for line in listed] == ["id", failed.id]
    page.table.choose([])
    assert page.downloads.csv.disabled
    assert page.downloads.html.disabled
    assert not page.downloads.list.disabled


def test_an_index_that_is_not_kept_is_told(pair: list[RunFolder], runs_dir: Path) -> None:
    (runs_dir / ".index").write_text("in the way")
    assert "The list of runs is kept in memory only" in said(ComparePage(runs_dir))


def test_reading_is_told_while_it_goes_on(
    pair: list[RunFolder], runs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr("toolkit.widgets.run_table._SLICE", 0.0)
        page = ComparePage(runs_dir)
        assert "Reading: 2 more to come." in said(page)
    page.refresh()
    assert "Reading" not in said(page)
    assert len(page.table.chosen) == 2
