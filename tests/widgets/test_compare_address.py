"""The page joins list, comparison and address; nothing that an address says leads out of the list."""

from __future__ import annotations

from pathlib import Path

import panel as pn
import pytest
from fake_recipe import MakeRun
from panel.io.location import Location

from toolkit.runs.folder import RunFolder
from toolkit.widgets.address import Address
from toolkit.widgets.compare_page import ComparePage

pytestmark = pytest.mark.filterwarnings(r"ignore:The inplace keyword in DataFrame\.\w+ is deprecated")


def said(page: ComparePage) -> str:
    """Return all HTML that can be seen."""
    return "\n".join(pane.object for pane in page.__panel__().select(pn.pane.HTML) if pane.visible and pane.object)


def opened(runs_dir: Path, search: str = "") -> tuple[ComparePage, Location]:
    location = Location(search=search)
    return ComparePage(runs_dir, Address(location)), location


def test_without_runs_it_says_what_to_do(runs_dir: Path, finished: MakeRun) -> None:
    page, location = opened(runs_dir)
    assert "make demo" in said(page)
    assert location.search == ""
    run = finished(name="first")
    page.refresh()
    assert "make demo" not in said(page)
    assert page.table.chosen == [run.id]
    assert "1 run in " in said(page)
    second = finished(name="second")
    page.refresh()
    assert page.table.chosen == [run.id, second.id]
    finished(name="third")
    page.refresh()
    assert page.table.chosen == [run.id, second.id]


def test_what_a_person_chose_is_left_alone(pair: list[RunFolder], finished: MakeRun, runs_dir: Path) -> None:
    page, _ = opened(runs_dir)
    page.table.choose([pair[0].id])
    finished(name="new")
    page.refresh()
    assert page.table.chosen == [pair[0].id]
    page.table.choose([])
    page.refresh()
    assert page.table.chosen == []
    linked, _ = opened(runs_dir, f"?runs={pair[0].id}")
    linked.refresh()
    assert linked.table.chosen == [pair[0].id]
    linked.table.choose([])
    linked.refresh()
    assert linked.table.chosen == []


def test_two_runs_are_shown_by_default_and_the_address_says_so(pair: list[RunFolder], runs_dir: Path) -> None:
    page, location = opened(runs_dir)
    assert page.table.chosen == [run.id for run in pair]
    assert location.search == f"?runs={pair[0].id},{pair[1].id}&view={page.comparison.view}"


def test_the_address_chooses_runs_and_picture(pair: list[RunFolder], runs_dir: Path) -> None:
    page, location = opened(runs_dir, f"?theme=dark&runs={pair[1].id}&view=photo_4.png")
    assert page.table.chosen == [pair[1].id]
    assert page.comparison.view == "photo_4.png"
    assert location.search == f"?theme=dark&runs={pair[1].id}&view=photo_4.png"
    location.search = f"?runs={pair[0].id}&view=photo_2.png"
    assert page.table.chosen == [pair[0].id]
    assert page.comparison.view == "photo_2.png"


def test_choices_are_written_into_the_address(pair: list[RunFolder], runs_dir: Path) -> None:
    page, location = opened(runs_dir)
    page.table.choose([pair[1].id])
    page.comparison.pick("photo_2.png")
    assert location.search == f"?runs={pair[1].id}&view=photo_2.png"
    page.table.choose([])
    assert location.search == ""


def test_the_address_is_said_again_where_the_browser_began_without(pair: list[RunFolder], runs_dir: Path) -> None:
    page, location = opened(runs_dir)
    location.search = ""
    page.refresh()
    assert page.table.chosen == [run.id for run in pair]
    assert pair[0].id in location.search


@pytest.mark.parametrize("odd", ["20990101-000000-fake-0000", "../secret", "/etc", "<img src=x onerror=alert(1)>"])
def test_unknown_runs_in_the_address_are_told_as_text(pair: list[RunFolder], runs_dir: Path, odd: str) -> None:
    (runs_dir.parent / "secret").mkdir()
    page, _ = opened(runs_dir, f"?runs={odd},{pair[1].id}")
    assert page.table.chosen == [pair[1].id]
    assert "There is no run " in said(page)
    assert "<img src=x" not in said(page)
    only, _ = opened(runs_dir, f"?runs={odd}")
    assert only.table.chosen == []
    assert "There is no run " in said(only)
    only.table.choose([pair[0].id])
    assert "There is no run " not in said(only)


def test_too_many_runs_in_the_address_are_told(queued: MakeRun, runs_dir: Path) -> None:
    ids = [queued(name=f"run {number}").id for number in range(5)]
    page, _ = opened(runs_dir, f"?runs={','.join(ids)}")
    assert page.table.chosen == ids[:4]
    assert "At most 4 runs fit side by side" in said(page)


def test_a_folder_that_refuses_is_told_and_comes_back(
    pair: list[RunFolder], runs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    with monkeypatch.context() as patched:
        patched.setattr("toolkit.runs.index.os.scandir", refuse)
        page, _ = opened(runs_dir)
        assert "Not allowed while listing" in said(page)
        assert "make demo" not in said(page)
    page.refresh()
    assert "Not allowed" not in said(page)
    assert len(page.table.chosen) == 2


def test_a_page_that_waits_has_the_list_first_and_then_what_the_address_names(
    pair: list[RunFolder], runs_dir: Path
) -> None:
    location = Location(search=f"?runs={pair[1].id}&view=photo_4.png")
    page = ComparePage(runs_dir, Address(location), wait=True)
    assert page.table.chosen == [pair[1].id]
    assert page.comparison.comparison is None
    assert "The comparison follows." in said(page)
    page.refresh()
    assert location.search == f"?runs={pair[1].id}&view=photo_4.png"
    page.open()
    assert page.comparison.view == "photo_4.png"
    assert "The comparison follows." not in said(page)
    page.table.choose([pair[0].id])
    assert page.comparison.comparison is not None
