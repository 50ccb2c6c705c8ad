"""A browser starts a run, watches its curve grow, cancels another, and finds all of it after the server's end."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from browsing import free_port, server_of
from playwright.sync_api import Locator, Page, expect

from toolkit.runs.folder import RunFolder
from toolkit.runs.index import run_folders
from toolkit.samples.make import SampleSettings, make_sample

APP = Path(__file__).parent / "run_watch_app.py"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    changes = {
        "town.trees": 0,
        "flight.frames": 9,
        "flight.arc": 90.0,
        "flight.image_width": 96,
        "flight.image_height": 72,
        "flight.samples": 1,
        "points": 0,
    }
    make_sample(tmp_path / "data" / "town", SampleSettings().replace(changes), seed=0)
    return tmp_path / "data"


Serve = Callable[[], AbstractContextManager[str]]


@pytest.fixture
def serve(runs_dir: Path, data: Path) -> Serve:
    """Return a context that serves the tabs in a process of its own and gives their address."""

    def served() -> AbstractContextManager[str]:
        port = free_port()
        return server_of(APP, runs_dir, data, port, port=port)

    return served


def points(chart: Locator) -> int:
    return int(chart.get_attribute("data-points") or 0)


def fill(page: Page, label: str, value: str) -> None:
    field = page.get_by_label(label, exact=True)
    field.fill(value)
    field.press("Enter")


def choose_short_training(page: Page, steps: str, name: str) -> None:
    page.get_by_label("Recipe").select_option(label="Sensor poses, ground plane · sensor-ground")
    # The form of the recipe is there when its cards are: what is typed before would go to the one before it.
    expect(page.get_by_text("The ground plane, and points on it")).to_be_visible()
    page.get_by_placeholder("Find a setting").fill("train.steps")
    fill(page, "steps", steps)
    page.get_by_placeholder("Find a setting").fill("train.max_side")
    fill(page, "max side (px)", "64")
    page.get_by_label("Name").fill(name)


def finish(run: RunFolder) -> str:
    deadline = time.monotonic() + 90
    while (state := run.status().state) in ("queued", "running"):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    return state


@pytest.mark.slow
def test_a_run_is_started_watched_and_another_one_cancelled(
    serve: Serve, runs_dir: Path, page: Page, problems: list[str]
) -> None:
    with serve() as address:
        page.goto(address)
        expect(page.get_by_label("Data")).to_have_value(re.compile("town"))
        choose_short_training(page, "1000", "short one")
        expect(page.get_by_text("There is no finished run of sensor-ground")).to_be_visible()
        page.get_by_role("button", name="Start", exact=True).click()

        # The tab that follows the run opens by itself; its curve grows without being drawn anew.
        expect(page.locator("article.run h3")).to_contain_text("short one")
        expect(page.locator(".badge.running")).to_be_visible()
        loss = page.locator(".place[aria-label^=Loss]")
        expect(loss.locator(".main-svg").first).to_be_visible()
        expect(page.get_by_text("left of this stage")).to_be_visible()
        seen = {points(loss)}
        deadline = time.monotonic() + 120
        while len(seen) < 3:
            assert time.monotonic() < deadline
            page.wait_for_timeout(100)
            seen.add(points(loss))
        expect(page.get_by_text(re.compile("Render at step"))).to_be_visible()
        images = page.locator("article.view img")
        expect(images).to_have_count(2)
        assert images.evaluate_all("all => all.map(image => image.naturalWidth)") == [64, 64]
        expect(page.locator(".gl-container canvas").first).to_be_visible()

        # Another one waits behind it, and is cancelled.
        page.get_by_text("Run", exact=True).first.click()
        fill(page, "Name", "cancelled one")
        page.get_by_placeholder("Find a setting").fill("train.steps")
        fill(page, "steps", "100000")
        page.get_by_role("button", name="Start", exact=True).click()
        expect(page.locator("article.run h3")).to_contain_text("cancelled one")
        page.get_by_role("button", name="Cancel", exact=True).locator("visible=true").click()
        expect(page.locator(".badge.cancelled")).to_be_visible()

    # The server is gone; the worker is not.
    short, cancelled = sorted(run_folders(runs_dir), key=lambda run: run.record().created)
    assert finish(short) == "finished"
    assert finish(cancelled) == "cancelled"

    with serve() as address:
        page.goto(f"{address}?run={short.id}&theme=dark")
        expect(page.locator(".badge.finished")).to_be_visible()
        expect(page.get_by_text("Render at step 1,000 of 1,000")).to_be_visible()
        expect(loss).to_have_attribute("data-points", "1000")
        page.get_by_role("button", name="Logarithmic loss").click()
        axis = "place => place.layout.yaxis.type"
        deadline = time.monotonic() + 10
        while loss.evaluate(axis) != "log":
            assert time.monotonic() < deadline
            page.wait_for_timeout(100)
    # The browser says that the first server went away.
    lost = [problem for problem in problems if "WebSocket" not in problem and "ERR_CONNECTION" not in problem]
    assert lost == []
    assert page.locator(".place[aria-label^=PSNR]").count() == 1
