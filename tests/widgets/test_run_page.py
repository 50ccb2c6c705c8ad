"""Runs are chosen, started, stopped, resumed, duplicated and extended from the page."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import panel as pn
import pytest
from fake_recipe import RECIPE, FakeSettings, MakeRun, write_photos

from toolkit.recipes.registry import find_recipe
from toolkit.runs import stop
from toolkit.runs.folder import RunFolder
from toolkit.runs.queue import enqueue, waiting_runs
from toolkit.widgets import choice_texts, run_choice, run_page
from toolkit.widgets.run_page import RunPage


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Offer the fake recipe beside a real one, and start no workers."""
    recipes = {"fake": RECIPE, "sensor-ground": find_recipe("sensor-ground")}
    monkeypatch.setattr(run_choice, "all_recipes", lambda: recipes)
    monkeypatch.setattr(run_choice, "find_recipe", recipes.__getitem__)
    monkeypatch.setattr(stop, "ensure_worker", lambda runs_dir: True)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    write_photos(tmp_path / "data" / "flight")
    write_photos(tmp_path / "data" / "garden", 3)
    return tmp_path / "data"


@pytest.fixture
def open_page(runs_dir: Path, data: Path) -> Callable[..., RunPage]:
    return lambda **options: RunPage(runs_dir, [data], **options)


def find(page: RunPage, label: str) -> Any:
    """Return the visible widget with this label, the first where a list has several."""
    widgets = page.__panel__().select(pn.widgets.Widget)
    return next(each for each in widgets if each.label == label and each.visible)


def said(page: RunPage) -> str:
    panes = page.__panel__().select(pn.pane.HTML)
    return "\n".join(pane.object for pane in panes if pane.visible and pane.object)


def press(page: RunPage, label: str) -> None:
    button = find(page, label)
    assert not button.disabled
    button.clicks += 1


def wait(page: RunPage) -> None:
    """Look again until the run is made; hashing a few pictures takes well under a second."""
    deadline = time.monotonic() + 30
    while page.busy:
        assert time.monotonic() < deadline
        time.sleep(0.01)
        page.refresh()


def started(page: RunPage, runs_dir: Path) -> RunFolder:
    press(page, "Start")
    wait(page)
    return waiting_runs(runs_dir)[-1]


def test_every_recipe_is_there_with_what_it_does_and_its_paper(open_page: Callable[..., RunPage]) -> None:
    page = open_page()
    recipe = find(page, "Recipe")
    assert list(recipe.options) == ["A fake recipe · fake", "Sensor poses, ground plane · sensor-ground"]
    assert "Counts steps." in said(page)
    assert "In none of the papers" in said(page)
    recipe.value = "sensor-ground"
    assert "points lie on a horizontal ground plane" in said(page)
    assert find(page, "steps")  # the form is that of the recipe


def test_a_recipe_that_lacks_something_says_so_and_cannot_be_started(
    open_page: Callable[..., RunPage], monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (run_choice, choice_texts):
        monkeypatch.setattr(module, "missing_here", lambda settings: "weights missing: no 'x'")
    page = open_page()
    assert next(iter(find(page, "Recipe").options)) == "A fake recipe · fake (weights missing)"
    assert "It cannot run here: weights missing: no &#x27;x&#x27;" in said(page)
    assert find(page, "Start").disabled


def test_a_started_run_is_what_was_asked_for(open_page: Callable[..., RunPage], runs_dir: Path, data: Path) -> None:
    shown: list[tuple[str, str]] = []
    page = open_page(show=lambda tab, run_id: shown.append((tab, run_id)))
    find(page, "Data").value = next(label for label in find(page, "Data").options if label.startswith("garden"))
    find(page, "steps").value = 12
    find(page, "rate (1/step)").value = 0.25
    find(page, "Name").value = "  first try "
    find(page, "Seed").value = 7
    run = started(page, runs_dir)
    record = run.record()
    assert (record.recipe, record.seed, record.device, record.name) == ("fake", 7, "cpu", "first try")
    assert record.data == str(data / "garden")
    assert record.flat_settings["loop.steps"] == 12
    assert record.flat_settings["loop.rate"] == 0.25
    assert waiting_runs(runs_dir) == [run]
    assert shown == [("watch", run.id)]
    assert f"Run {run.id} waits for its turn" in said(page)
    assert page.queue.ids == [run.id]
    assert "first try" in said(page)


def test_only_what_lies_below_the_data_folders_can_be_chosen(
    open_page: Callable[..., RunPage], data: Path, tmp_path: Path, runs_dir: Path
) -> None:
    write_photos(tmp_path / "secret")
    (data / "link").symlink_to(tmp_path / "secret")
    page = open_page()
    assert [label.split(" ")[0] for label in find(page, "Data").options] == ["flight", "garden"]
    listed = find(page, "Data").value
    find(page, "Data").value = str(tmp_path / "secret")  # as a browser that does not keep to the list
    assert find(page, "Start").disabled
    page.start()
    assert not page.busy
    find(page, "Data").value = listed
    # A folder that becomes a link after it was listed.
    (data / "flight").rename(tmp_path / "away")
    (data / "flight").symlink_to(tmp_path / "away")
    press(page, "Start")
    wait(page)
    assert "is not among the data" in said(page)
    assert waiting_runs(runs_dir) == []


def test_a_capture_whose_pictures_lie_elsewhere_is_not_run(
    open_page: Callable[..., RunPage], data: Path, tmp_path: Path, runs_dir: Path
) -> None:
    # What the capture refers to is looked at, not only where it lies.
    secret = tmp_path / "secret.png"
    photo = data / "flight" / "photo_1.png"
    photo.rename(secret)
    photo.symlink_to(secret)
    page = open_page()
    page.start()
    wait(page)
    assert "refers to photo_1.png outside the data folders" in said(page)
    assert not list(runs_dir.glob("2*"))


def test_another_tab_chooses_the_data(open_page: Callable[..., RunPage], data: Path, tmp_path: Path) -> None:
    page = open_page()
    page.choose_data(data / "garden")
    assert page.choice.asked().data == data / "garden"
    new = write_photos(data / "new")
    page.choose_data(new)
    assert page.choice.asked().data == new
    page.choose_data(write_photos(tmp_path / "secret"))
    assert "is not among the data that can be chosen here" in said(page)
    assert page.choice.asked().data == new


def test_without_data_it_says_where_it_looked(runs_dir: Path, tmp_path: Path) -> None:
    page = RunPage(runs_dir, [tmp_path / "nowhere"])
    assert find(page, "Start").disabled
    assert f"no capture was found in {tmp_path / 'nowhere'}" in said(page)
    write_photos(tmp_path / "nowhere" / "late")
    press(page, "Look for data again")
    assert not find(page, "Start").disabled


def test_what_cannot_be_is_told_and_the_page_goes_on(
    open_page: Callable[..., RunPage], data: Path, runs_dir: Path
) -> None:
    page = open_page()
    find(page, "Name").value = "../out"
    press(page, "Start")
    wait(page)
    assert "Run name &#x27;../out&#x27; cannot be used" in said(page)
    find(page, "Name").value = ""
    (data / "flight" / "photo_0.png").write_bytes(b"no picture")
    press(page, "Start")
    wait(page)
    assert "is no picture" in said(page)
    write_photos(data / "mended")
    press(page, "Look for data again")
    find(page, "Data").value = next(label for label in find(page, "Data").options if label.startswith("mended"))
    assert started(page, runs_dir).record().data == str(data / "mended")


@pytest.mark.parametrize("seed", [-1, None, 2**31])
def test_a_seed_that_cannot_be_is_told(open_page: Callable[..., RunPage], seed: int | None) -> None:
    page = open_page()
    find(page, "Seed").value = seed
    assert f"Seed is out of range; expected a whole number 0 to 2147483647; found {seed}." in said(page)
    assert find(page, "Start").disabled


def test_a_setting_beyond_its_bounds_is_told(open_page: Callable[..., RunPage]) -> None:
    page = open_page()
    find(page, "steps").value = 10**9
    assert "Setting &#x27;steps&#x27; is out of range" in said(page)
    assert find(page, "Start").disabled


def test_progress_is_shown_while_pictures_are_hashed(
    open_page: Callable[..., RunPage], runs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, seen = run_page.create_run, []

    def slow(*args: Any, progress: Any, **kwargs: Any) -> RunFolder:
        def tell(event: Any) -> None:
            seen.append(event.stage)
            time.sleep(0.02)
            progress(event)

        return real(*args, progress=tell, **kwargs)

    monkeypatch.setattr(run_page, "create_run", slow)
    page = open_page()
    press(page, "Start")
    assert find(page, "Start").disabled
    texts = set()
    while page.busy:
        page.refresh()
        texts |= {word for word in ("Checking pictures", "Hashing pictures") if word in said(page)}
        time.sleep(0.005)
    assert texts == {"Checking pictures", "Hashing pictures"}
    assert len(waiting_runs(runs_dir)) == 1


def test_the_estimate_says_on_what_it_rests(open_page: Callable[..., RunPage], finished: MakeRun) -> None:
    page = open_page()
    assert "There is no finished run of fake on cpu here to judge from." in said(page)
    finished(name="model run")
    page.refresh()
    assert "From run model run" in said(page)


def test_presets_fill_the_form_and_changes_make_them_a_persons_own(open_page: Callable[..., RunPage]) -> None:
    page = open_page()
    find(page, "Recipe").value = "sensor-ground"
    preset = find(page, "Preset")
    preset.value = "draft"
    assert find(page, "steps").value == 1000
    assert preset.value == "draft"
    assert "A first look" in said(page)
    find(page, "steps").value = 777
    assert preset.value == "own settings"
    assert page.choice.asked().settings.to_dict()["train"]["max_side"] == 400


def test_what_waits_can_be_cancelled(
    open_page: Callable[..., RunPage], queued: MakeRun, runs_dir: Path, odd_name: str
) -> None:
    first, second = queued(name=odd_name), queued(seed=2)
    for run in (first, second):
        enqueue(run)
    page = open_page()
    assert page.queue.ids == [first.id, second.id]
    assert "<script>" not in said(page)
    press(page, "Cancel")
    assert page.queue.ids == [second.id]
    assert first.status().state == "cancelled"
    assert f"Run {first.id} is cancelled." in said(page)
    withdrawn = second.status_file.read_text()
    second.status_file.write_text("{")
    press(page, "Cancel")
    assert "Cannot read" in said(page)
    second.status_file.write_text(withdrawn)
    page.refresh()


def test_a_run_that_failed_is_resumed(open_page: Callable[..., RunPage], failed: RunFolder, runs_dir: Path) -> None:
    page = open_page()
    assert find(page, "Resume").disabled
    page.selected = failed.id
    press(page, "Resume")
    assert waiting_runs(runs_dir) == [failed]
    assert "goes on after it failed" in said(page).replace("  ", " ") or page.queue.ids == []
    page.refresh()
    assert page.queue.ids == [failed.id]
    assert "goes on after it failed" in said(page)


def test_a_run_is_made_again_with_changes(
    open_page: Callable[..., RunPage], finished: MakeRun, data: Path, runs_dir: Path
) -> None:
    run = finished(name="model run", seed=5, data=data / "garden", loop__rate=0.125)
    page = open_page()
    page.selected = run.id
    press(page, "Duplicate with changes")
    asked = page.choice.asked()
    assert asked.settings.to_dict() == FakeSettings().replace({"loop.rate": 0.125}).to_dict()
    assert (asked.seed, asked.data, asked.name) == (5, data / "garden", "")
    find(page, "steps").value = 4
    made = started(page, runs_dir).record()
    assert made.flat_settings == {**run.record().flat_settings, "loop.steps": 4}


def test_what_an_earlier_run_had_and_is_not_here_is_told(
    open_page: Callable[..., RunPage], finished: MakeRun, tmp_path: Path
) -> None:
    run = finished(data=write_photos(tmp_path / "elsewhere"))
    page = open_page()
    page.selected = run.id
    press(page, "Duplicate with changes")
    assert f"Its data {tmp_path / 'elsewhere'} are not among those that can be chosen here." in said(page)


@pytest.mark.parametrize("odd", ["../secret", "20990101-000000-fake-0000", "<img src=x>"])
def test_a_run_that_is_not_there_is_told_as_text(open_page: Callable[..., RunPage], odd: str) -> None:
    page = open_page()
    page.selected = odd
    assert "There is no run" in said(page)
    assert "<img" not in said(page)
    assert find(page, "Duplicate with changes").disabled


def test_a_finished_training_is_extended_in_a_thread(
    open_page: Callable[..., RunPage], finished: MakeRun, queued: MakeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = finished(loop__steps=3)
    asked: list[tuple[str, int]] = []
    longer = queued(name="longer")

    def extend(given: RunFolder, steps: int, *, progress: Any) -> RunFolder:
        asked.append((given.id, steps))
        return longer

    monkeypatch.setattr(run_page, "extend_run", extend)
    page = open_page()
    page.selected = run.id
    assert not any(w.label == "Extend" and w.visible for w in page.__panel__().select(pn.widgets.Button))
    monkeypatch.setattr("toolkit.widgets.earlier_runs.finished_steps", lambda run: 30)
    page.refresh()
    assert find(page, "Steps in all").value == 60
    find(page, "Steps in all").value = 45
    press(page, "Extend")
    wait(page)
    assert asked == [(run.id, 45)]
    assert page.queue.ids == [longer.id]


def test_a_run_that_is_deleted_while_it_is_chosen_is_told(
    open_page: Callable[..., RunPage], finished: MakeRun, tmp_path: Path
) -> None:
    run = finished()
    page = open_page()
    page.selected = run.id
    run.path.rename(tmp_path / "away")
    page.refresh()
    assert "status.json is missing" in said(page)
    press(page, "Duplicate with changes")
    assert "run.json is missing" in said(page)
