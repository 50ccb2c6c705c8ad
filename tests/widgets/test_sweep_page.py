"""Sweeps are defined, started and followed from the page."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import panel as pn
import pytest
from fake_recipe import RECIPE, write_photos
from fake_sweeps import in_this_process, make_sweep

from toolkit.recipes.registry import find_recipe
from toolkit.runs import sweep_run
from toolkit.runs.sweep import SweepPlaces
from toolkit.runs.sweep_record import SweepFolder, list_sweeps
from toolkit.runs.sweep_run import work_on_sweep
from toolkit.runs.sweep_space import Dimension
from toolkit.splat.train_settings import TrainSettings
from toolkit.widgets import run_choice, sweep_page, sweep_view
from toolkit.widgets.sweep_dimension import DimensionForm
from toolkit.widgets.sweep_page import SweepPage

ONE = SweepPlaces(workers=1, threads=1)


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Offer the fake recipe beside a real one, and work in this process."""
    recipes = {"fake": RECIPE, "sensor-ground": find_recipe("sensor-ground")}
    monkeypatch.setattr(run_choice, "all_recipes", lambda: recipes)
    monkeypatch.setattr(run_choice, "find_recipe", recipes.__getitem__)
    monkeypatch.setattr(sweep_run, "_workers", in_this_process)
    for module in (sweep_page, sweep_view):
        monkeypatch.setattr(module, "start_sweep", lambda sweep: work_on_sweep(sweep, recipe=RECIPE))


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return write_photos(tmp_path / "data" / "flight").parent


@pytest.fixture
def open_page(runs_dir: Path, data: Path) -> Callable[..., SweepPage]:
    return lambda **options: SweepPage(runs_dir, [data], **options)


@pytest.fixture
def done(runs_dir: Path, data: Path, odd_name: str) -> SweepFolder:
    """Return a sweep of four runs that ended, with an odd name."""
    sweep = make_sweep(data / "flight", runs_dir, "grid", "loop.rate=0.1,1,2,4", name=odd_name, places=ONE)
    work_on_sweep(sweep, recipe=RECIPE)
    return sweep


def find(page: SweepPage, label: str) -> Any:
    """Return the visible widget with this label."""
    widgets = page.__panel__().select(pn.widgets.Widget)
    (found,) = [each for each in widgets if each.label == label and each.visible]
    return found


def said(page: SweepPage) -> str:
    panes = page.__panel__().select(pn.pane.HTML)
    return "\n".join(pane.object for pane in panes if pane.visible and pane.object)


def figures(page: SweepPage) -> int:
    return sum(pane.visible and pane.object is not None for pane in page.__panel__().select(pn.pane.Plotly))


def test_a_sweep_is_defined_started_and_shown(open_page: Callable[..., SweepPage], runs_dir: Path) -> None:
    page = open_page()
    assert not page.view.__panel__().visible
    assert find(page, "Start the sweep").disabled
    assert "Add one or more settings to try" in said(page)
    find(page, "Add a setting to try").value = "loop.rate"
    find(page, "Add a setting to try").value = "test_every"
    assert "loop.rate" in said(page)
    assert "9 runs, 2 at a time: 5 rounds" in said(page)
    froms = [each for each in page.__panel__().select(pn.widgets.FloatInput) if each.label == "From"]
    assert [(each.value, each.start, each.end) for each in froms] == [(0.17, 0, 10)]
    page.form._dimensions["loop.rate"]._widgets["count"].value = 2
    find(page, "Runs at a time").value = 1
    find(page, "Threads of each").value = 1
    find(page, "Name").value = "mine"
    find(page, "Start the sweep").clicks += 1

    (sweep,) = list_sweeps(runs_dir)
    assert page.selected == sweep.id
    plan = sweep.plan()
    assert plan.name == "mine"
    assert plan.space[0] == Dimension("loop.rate", (0.17, 1.5), log=True)
    assert plan.space[1].values == (1, 4, 6)
    assert "6 of 6 trials ended" in said(page)
    assert "Best: trial" in said(page)
    assert figures(page) == 3
    assert find(page, "Sweep").value == sweep.id


def test_tpe_and_random_ask_for_a_number_of_trials_and_ranges(open_page: Callable[..., SweepPage]) -> None:
    page = open_page()
    find(page, "Add a setting to try").value = "loop.rate"
    find(page, "How values are chosen").value = "tpe"
    assert "12 runs, 2 at a time" in said(page)
    assert find(page, "stop those early that are worse than most").value
    assert page.form.goal.prune == "splat.train/psnr_test"
    find(page, "From").value = 5.0
    assert "is empty; expected the lower end first; found 5.0 to 1.5" in said(page)
    assert find(page, "Start the sweep").disabled
    find(page, "How values are chosen").value = "random"
    find(page, "To").value = 9.0
    find(page, "Trials").value = 5
    assert not find(page, "Start the sweep").disabled
    (dimension,) = page.form.space(page.choice.form.settings())
    assert (dimension.low, dimension.high, dimension.log, dimension.values) == (5.0, 9.0, True, ())
    assert page.form.goal.prune == ""


def test_another_recipe_has_other_settings(open_page: Callable[..., SweepPage]) -> None:
    page = open_page()
    find(page, "Add a setting to try").value = "loop.rate"
    find(page, "Recipe").value = "sensor-ground"
    assert page.form.names == []
    offered = find(page, "Add a setting to try").options
    assert "train.lr_means" in offered
    assert "loop.rate" not in offered


def test_a_setting_is_left_out_again_and_names_that_are_none_change_nothing(
    open_page: Callable[..., SweepPage],
) -> None:
    page = open_page()
    for name in ("loop.rate", "loop.rate", "../etc", "pause"):
        page.form.add(name)
    assert page.form.names == ["loop.rate", "pause"]
    assert "loop.rate" not in find(page, "Add a setting to try").options
    find(page, "Leave out rate").clicks += 1
    assert page.form.names == ["pause"]
    assert "loop.rate" in find(page, "Add a setting to try").options


def test_every_setting_of_a_training_can_be_tried() -> None:
    base = TrainSettings()
    for row in TrainSettings.table():
        form = DimensionForm(row, base, lambda: None, lambda: None)
        dimension = form.dimension("grid", base)
        assert 1 <= len(dimension.values) <= 3
        assert form.dimension("random", base).name == row.name


def test_only_schedulers_that_the_server_names_can_be_chosen(open_page: Callable[..., SweepPage]) -> None:
    page = open_page(clusters=["tcp://10.0.0.1:8786"])
    where = find(page, "Where")
    assert where.options == ["this machine", "tcp://10.0.0.1:8786"]
    where.value = "tcp://10.0.0.1:8786"
    assert page.form.places_on("cpu").cluster == "tcp://10.0.0.1:8786"
    assert not [
        each
        for each in open_page().form.__panel__().select(pn.widgets.Select)
        if each.label == "Where" and each.visible
    ]


def test_a_sweep_that_ended_is_shown_with_its_best_run_which_opens(
    open_page: Callable[..., SweepPage], done: SweepFolder, odd_name: str
) -> None:
    opened: list[tuple[str, str]] = []
    page = open_page(show=lambda tab, run_id: opened.append((tab, run_id)))
    assert page.selected == done.id
    assert odd_name not in said(page)  # it is escaped
    assert "&lt;script&gt;" in said(page)
    assert figures(page) == 3
    find(page, "Open the best run").clicks += 1
    best = max(page.view.rows, key=lambda row: row.value or 0.0)
    assert opened == [("view", best.run)]
    assert len(page.view.rows) == 4


def test_nothing_is_drawn_anew_when_nothing_changed(
    open_page: Callable[..., SweepPage], done: SweepFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = open_page()
    monkeypatch.setattr(sweep_view, "sweep_figures", lambda *arguments: pytest.fail("drawn again"))
    monkeypatch.setattr(sweep_view, "_trial_table", lambda *arguments: pytest.fail("written again"))
    page.refresh()


def test_a_sweep_is_cancelled_and_goes_on(open_page: Callable[..., SweepPage], runs_dir: Path, data: Path) -> None:
    sweep = make_sweep(data / "flight", runs_dir, "grid", "loop.rate=1,2", places=ONE)
    page = open_page()
    assert "queued" in said(page)
    find(page, "Cancel the sweep").clicks += 1
    assert sweep.status().state == "cancelled"
    assert "Cancelled before it began." in said(page)
    find(page, "Go on").clicks += 1
    assert sweep.status().state == "finished"
    assert "2 of 2 trials ended" in said(page)


def test_an_id_that_is_no_sweep_is_told_and_reads_nothing(
    open_page: Callable[..., SweepPage], done: SweepFolder
) -> None:
    page = open_page()
    for text in ("../../etc", "20990101-000000-fake-0000", "<img src=x>"):
        page.selected = text
        assert "There is no sweep" in said(page)
        assert "<img" not in said(page)
    page.selected = done.id
    assert "There is no sweep" not in said(page)


def test_a_damaged_sweep_and_a_deleted_run_leave_the_page_alive(
    open_page: Callable[..., SweepPage], done: SweepFolder, runs_dir: Path
) -> None:
    import shutil

    page = open_page()
    shutil.rmtree(runs_dir / done.trials()[0].run)
    page.refresh()
    assert "Its run is gone." in said(page)
    done.status_file.write_text("{")
    page.refresh()
    assert "Cannot read" in said(page)
    done.plan_file.write_text("{")
    again = open_page()
    assert "is no plan of a sweep" in said(again) or "Cannot read" in said(again)
    assert not find(again, "Start the sweep").visible or find(again, "Start the sweep").disabled


def test_what_is_refused_at_the_start_is_told(open_page: Callable[..., SweepPage], runs_dir: Path) -> None:
    page = open_page()
    find(page, "Add a setting to try").value = "loop.rate"
    find(page, "Name").value = "../x"
    find(page, "Start the sweep").clicks += 1
    assert "Sweep name &#x27;../x&#x27; cannot be used" in said(page)
    assert list_sweeps(runs_dir) == []
