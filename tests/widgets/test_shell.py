"""The dashboard's tabs: made when they are opened, chosen by the address, and leading to each other."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_recipe import write_photos
from panel.io.location import Location

from toolkit.runs.folder import RunFolder
from toolkit.widgets.run_page import RunPage
from toolkit.widgets.shell import TABS, Shell

pytestmark = pytest.mark.filterwarnings(r"ignore:The inplace keyword in DataFrame\.\w+ is deprecated")


@pytest.fixture
def data(tmp_path: Path) -> Path:
    write_photos(tmp_path / "data" / "town")
    return tmp_path / "data"


def opened(runs_dir: Path, data: Path, search: str = "") -> tuple[Shell, Location]:
    location = Location(search=search)
    shell = Shell(runs_dir, [data], location)
    shell.loaded()
    return shell, location


def test_who_has_no_runs_begins_with_data_and_others_with_comparing(
    runs_dir: Path, data: Path, pair: list[RunFolder]
) -> None:
    empty, _ = opened(runs_dir.parent / "none", data)
    assert empty.tab == "data"
    full, location = opened(runs_dir, data)
    assert full.tab == "compare"
    full.refresh()
    assert all(run.id in location.search for run in pair)


def test_a_tab_is_made_when_it_is_first_opened_and_kept(runs_dir: Path, data: Path, pair: list[RunFolder]) -> None:
    shell, location = opened(runs_dir, data)
    assert list(shell.pages) == ["compare"]
    shell.tab = "run"
    made = shell.pages["run"]
    assert shell._tabs.active == list(TABS).index("run")
    assert "tab=run" in location.search
    shell.tab = "compare"
    shell.tab = "run"
    assert shell.pages["run"] is made


def test_the_address_names_the_tab_and_what_is_chosen_in_it(
    runs_dir: Path, data: Path, pair: list[RunFolder]
) -> None:
    shell, location = opened(runs_dir, data, f"?tab=watch&chosen={pair[0].id}")
    assert shell.tab == "watch"
    assert shell.pages["watch"].selected == pair[0].id
    # The browser's button back.
    location.search = f"?tab=watch&chosen={pair[1].id}"
    assert shell.pages["watch"].selected == pair[1].id
    location.search = "?tab=run"
    assert shell.tab == "run"


@pytest.mark.parametrize("tab", ["nothing", "../..", "<script>"])
def test_an_unknown_tab_is_passed_over(runs_dir: Path, data: Path, pair: list[RunFolder], tab: str) -> None:
    shell, _ = opened(runs_dir, data, f"?tab={tab}")
    assert shell.tab == "compare"


def test_an_old_link_to_runs_still_compares_them(runs_dir: Path, data: Path, pair: list[RunFolder]) -> None:
    shell, _ = opened(runs_dir, data, f"?runs={pair[1].id}&view=photo_4.png")
    assert shell.tab == "compare"
    compare = shell.pages["compare"]
    assert compare.table.chosen == [pair[1].id]
    assert compare.comparison.view == "photo_4.png"


@pytest.mark.parametrize("path", ["/etc", "/", "../../secret"])
def test_an_address_does_not_lead_out_of_the_data(runs_dir: Path, data: Path, path: str) -> None:
    shell, _ = opened(runs_dir, data, f"?tab=data&chosen={path}")
    assert shell.tab == "data"
    assert shell.pages["data"].selected == ""


def test_parts_of_the_page_open_each_other(runs_dir: Path, data: Path, pair: list[RunFolder]) -> None:
    shell, location = opened(runs_dir, data)
    shell.open_tab("view", pair[0].id)
    assert shell.tab == "view"
    assert shell.pages["view"].selected == pair[0].id
    assert f"chosen={pair[0].id}" in location.search
    shell.open_tab("watch", pair[1].id)
    assert (shell.tab, shell.pages["watch"].selected) == ("watch", pair[1].id)
    # A capture is put into the form of a new run, and is no run itself.
    shell.open_tab("run", str(data / "town"))
    page = shell.pages["run"]
    assert isinstance(page, RunPage)
    assert page.choice.capture is not None
    assert page.choice.capture.path == data / "town"
    assert page.selected == ""
