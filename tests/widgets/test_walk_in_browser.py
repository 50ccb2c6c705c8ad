"""Someone in a workshop: a sample, two knobs, Run, watch, compare, look around; the server goes and comes back."""

from __future__ import annotations

import re
import time
from pathlib import Path

import pytest
from browsing import PATIENCE, dashboard_server, free_port, take_picture
from playwright.sync_api import Locator, Page, expect

from toolkit.runs.folder import RunFolder
from toolkit.runs.index import run_folders
from toolkit.runs.stop import stop_run
from toolkit.samples.make import SampleSettings, make_sample
from toolkit.widgets.viewer_files import is_built

RECIPE = "Sensor poses, ground plane · sensor-ground"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    changes = {
        "town.trees": 0,
        "flight.frames": 9,
        "flight.arc": 90.0,
        "flight.image_width": 320,
        "flight.image_height": 240,
        "flight.samples": 1,
        "points": 0,
    }
    make_sample(tmp_path / "data" / "town", SampleSettings().replace(changes), seed=0)
    return tmp_path / "data"


def tab(page: Page, name: str) -> None:
    page.locator(".bk-tab", has_text=re.compile(f"^{name}$")).click()


def seen(page: Page, locator: Locator) -> Locator:
    """Return the one that is in sight: tabs that were opened keep their parts."""
    return locator.locator("visible=true").first


def fill(page: Page, label: str, value: str) -> None:
    field = seen(page, page.get_by_label(label, exact=True))
    field.fill(value)
    field.press("Enter")


def choose(page: Page) -> None:
    """Choose a method and change two of its settings."""
    seen(page, page.get_by_label("Recipe")).select_option(label=RECIPE)
    # The form of the recipe is there when its cards are: what is typed before would go to the one before it.
    expect(seen(page, page.get_by_text("The ground plane, and points on it"))).to_be_visible()
    change(page, "train.max_side", "max side (px)", "320")


def change(page: Page, setting: str, label: str, value: str) -> None:
    """Find a setting and type a value; a dot before its label says that it was changed."""
    seen(page, page.get_by_placeholder("Find a setting")).fill(setting)
    field = seen(page, page.get_by_label(re.compile(rf"^(● )?{re.escape(label)}$")))
    field.fill(value)
    field.press("Enter")


def start(page: Page, name: str, steps: str) -> None:
    change(page, "train.steps", "steps", steps)
    fill(page, "Name", name)
    seen(page, page.get_by_role("button", name="Start", exact=True)).click()
    expect(page.locator("article.run h3").first).to_contain_text(name)


def grows(page: Page) -> None:
    """Wait until the curve of the loss has had two different lengths."""
    loss = seen(page, page.locator(".place[aria-label^=Loss]"))
    lengths: set[str] = set()
    deadline = time.monotonic() + PATIENCE / 1000
    while len(lengths) < 2:
        assert time.monotonic() < deadline
        lengths.add(loss.get_attribute("data-points") or "0")
        page.wait_for_timeout(100)


def named(runs_dir: Path, name: str) -> RunFolder:
    return next(run for run in run_folders(runs_dir) if run.record().name == name)


def finish(run: RunFolder) -> str:
    deadline = time.monotonic() + 120
    while (state := run.status().state) in ("queued", "running"):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    return state


@pytest.mark.slow
def test_from_a_sample_to_two_runs_side_by_side(
    tmp_path: Path, runs_dir: Path, data: Path, page: Page, problems: list[str]
) -> None:
    port = free_port()
    with dashboard_server(runs_dir, [data], port=port) as address:
        # Someone without runs begins with the data.
        page.goto(address)
        page.get_by_label("Capture").select_option(label="town · scene.json, 9 photos")
        expect(page.locator("img[src^='data:image']").first).to_be_visible()
        take_picture(page, "data")
        page.get_by_role("button", name="Run a method on it").click()

        expect(seen(page, page.get_by_label("Data"))).to_have_value(re.compile("town"))
        choose(page)
        take_picture(page, "run")
        start(page, "first", "300")
        grows(page)
        tab(page, "Run")
        fill(page, "Seed", "1")
        start(page, "second", "300")
        tab(page, "Run")
        start(page, "too long", "100000")
        assert finish(named(runs_dir, "first")) == "finished"
        assert finish(named(runs_dir, "second")) == "finished"
        grows(page)
        expect(page.get_by_text(re.compile("Render at step")).first).to_be_visible()
        take_picture(page, "watch")
        seen(page, page.get_by_role("button", name="Cancel", exact=True)).click()
        assert finish(named(runs_dir, "too long")) == "cancelled"

        # Two runs side by side; the slider moves.
        tab(page, "Compare")
        expect(page.locator(".tabulator-row")).to_have_count(3)
        expect(page.locator(".tabulator-row.tabulator-selected")).to_have_count(2)
        slider = seen(page, page.locator("input[type=range]"))
        slider.scroll_into_view_if_needed()
        before = slider.screenshot()
        slider.focus()
        for _ in range(20):
            page.keyboard.press("ArrowRight")
        assert slider.screenshot() != before
        first = named(runs_dir, "first")
        assert first.id in page.url
        take_picture(page, "compare")

        # The splat, in the browser's own graphics where they were built, else drawn by the server.
        tab(page, "View")
        shown = "canvas" if is_built() else "img"
        expect(seen(page, page.locator(shown))).to_be_visible()
        expect(page.get_by_text(re.compile(r"^[\d,]+ Gaussians, 9 cameras"))).to_be_visible()

        expect(page.get_by_text(re.compile("^Loading"))).to_be_hidden()
        take_picture(page, "view")

        tab(page, "Sweep")
        expect(seen(page, page.get_by_text("New sweep"))).to_be_visible()
        take_picture(page, "sweep")

        # A run is at work while the server goes.
        tab(page, "Run")
        start(page, "outlives", "100000")
        grows(page)
        link = page.url
    outlives = named(runs_dir, "outlives")
    assert outlives.status().state == "running"
    lost = [text for text in problems if "WebSocket" not in text and "ERR_CONNECTION" not in text]
    problems.clear()
    with dashboard_server(runs_dir, [data], port=port):
        page.goto(link)
        expect(page.locator("article.run h3").first).to_contain_text("outlives")
        grows(page)
    stop_run(outlives)
    assert finish(outlives) == "cancelled"
    lost += [text for text in problems if "WebSocket" not in text and "ERR_CONNECTION" not in text]
    assert lost == []
