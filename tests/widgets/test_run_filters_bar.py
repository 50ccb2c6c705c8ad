"""The widgets above the list filter, sort and group it, and say what they do not understand."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_recipe import MakeRun

from toolkit.runs.folder import RunFolder
from toolkit.runs.notes import RunNotes, write_notes
from toolkit.widgets.run_filters import RunFilters
from toolkit.widgets.run_table import RunTable

pytestmark = pytest.mark.filterwarnings(r"ignore:The inplace keyword in DataFrame\.\w+ is deprecated")


def opened(runs_dir: Path) -> tuple[RunFilters, RunTable]:
    table = RunTable(runs_dir)
    table.refresh()
    return RunFilters(table), table


def again(filters: RunFilters, table: RunTable) -> None:
    table.refresh()
    filters.refresh()


def test_what_is_typed_filters_as_it_is_typed(pair: list[RunFolder], failed: RunFolder, runs_dir: Path) -> None:
    filters, table = opened(runs_dir)
    filters.text.value_input = "stopped"
    assert table.shown == [failed.id]
    filters.text.value_input = "rate<0.5"
    assert table.shown == [pair[1].id]
    filters.text.value_input = ""
    assert len(table.shown) == 3


def test_a_condition_that_cannot_be_read_is_told_and_the_list_stays(pair: list[RunFolder], runs_dir: Path) -> None:
    filters, table = opened(runs_dir)
    filters.text.value_input = "fast"
    filters.text.value_input = "fast nothing>1"
    assert "No run has a measure or setting 'nothing'" in filters.problem
    assert table.shown == [pair[1].id]
    filters.text.value_input = "psnr>0"
    assert filters.problem == ""
    assert len(table.shown) == 2


def test_states_recipes_and_tags_are_offered_with_their_numbers(
    pair: list[RunFolder], failed: RunFolder, runs_dir: Path
) -> None:
    write_notes(pair[0], RunNotes(("good",)))
    filters, table = opened(runs_dir)
    assert filters.state.options == {"any": "", "failed (1)": "failed", "finished (2)": "finished"}
    assert filters.recipe.options == {"any": "", "fake (3)": "fake"}
    assert filters.tag.options == {"any": "", "good (1)": "good"}
    filters.tag.value = "good"
    assert table.shown == [pair[0].id]
    write_notes(pair[0], RunNotes())
    again(filters, table)
    # The choice stays though there is none of it any more: the list does not change its meaning by itself.
    assert filters.tag.value == "good"
    assert filters.tag.options == {"any": "", "good (0)": "good"}
    assert table.shown == []


def test_order_groups_and_columns_reach_the_table(pair: list[RunFolder], runs_dir: Path) -> None:
    filters, table = opened(runs_dir)
    assert "loop.rate" in filters.columns.options
    assert "test.psnr" in filters.columns.options
    filters.columns.value = ["loop.rate"]
    assert table.columns == ("loop.rate",)
    filters.order.value = "loop.rate"
    filters.descending.value = False
    assert table.widget.sorters == [{"field": "extra0", "dir": "asc"}]
    filters.group.value = "recipe"
    assert table.widget.groupby == ["recipe"]
    filters.columns.value = []
    assert filters.order.value == "created"
    assert table.widget.sorters[-1] == {"field": "created", "dir": "asc"}


def test_new_runs_bring_new_choices(queued: MakeRun, finished: MakeRun, runs_dir: Path) -> None:
    queued(name="waiting")
    filters, table = opened(runs_dir)
    assert "test.psnr" not in filters.columns.options
    finished(name="done")
    again(filters, table)
    assert "test.psnr" in filters.columns.options
    assert set(filters.state.options.values()) == {"", "queued", "finished"}


def test_every_widget_has_a_label(pair: list[RunFolder], runs_dir: Path) -> None:
    filters, _ = opened(runs_dir)
    assert [widget.label for widget in filters.__panel__()] == [
        "Filter",
        "State",
        "Recipe",
        "Tag",
        "Group by",
        "Sort by",
        "Descending",
        "More columns (Ctrl: several)",
    ]
