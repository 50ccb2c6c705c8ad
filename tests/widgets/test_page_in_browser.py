"""A browser walks through the page as a person would; the page loads nothing from elsewhere."""

from __future__ import annotations

import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Page, Request, expect, sync_playwright

from toolkit.runs.folder import RunFolder

LOCAL = {"127.0.0.1", "localhost"}
# What Chromium says about drawing without a graphics card is no fault of the page.
HARMLESS = re.compile("GPU stall|WebGL|willReadFrequently")
PATIENCE = 20_000
expect.set_options(timeout=PATIENCE)


@pytest.fixture(scope="module")
def browser_program() -> str:
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if found is None:
        pytest.skip("no Chromium is installed: apt-get install chromium")
    return found


@pytest.fixture
def served(runs_dir: Path, browser_program: str) -> Iterator[str]:
    """Serve the runs in a process of its own and return their address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    program = "import sys; from pathlib import Path; from toolkit.widgets.serve import serve; "
    program += "serve(Path(sys.argv[1]), port=int(sys.argv[2]))"
    command = [sys.executable, "-c", program, str(runs_dir), str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            line = server.stdout.readline()
            assert f"http://localhost:{port}" in line
            yield f"http://localhost:{port}/"
        finally:
            server.terminate()
            # The server says good-bye: its pipe has to be open until it is gone.
            server.communicate(timeout=20)


class Visit:
    """A page in a browser, with what went wrong on it."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.problems: list[str] = []
        page.set_default_timeout(PATIENCE)
        page.on("console", lambda message: self._note(message.type, message.text))
        page.on("pageerror", lambda error: self.problems.append(f"page: {error}"))
        page.on("requestfailed", lambda request: self.problems.append(f"failed: {request.url[:200]}"))
        page.on("request", self._check)

    def _note(self, kind: str, text: str) -> None:
        if kind in {"error", "warning"} and not HARMLESS.search(text):
            self.problems.append(f"{kind}: {text[:300]}")

    def _check(self, request: Request) -> None:
        address = urlsplit(request.url)
        if address.scheme not in {"data", "blob"} and address.hostname not in LOCAL:
            self.problems.append(f"outside: {request.url[:200]}")


@pytest.fixture
def visit(browser_program: str) -> Iterator[Visit]:
    with sync_playwright() as playwright:
        arguments = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=browser_program, args=arguments)
        yield Visit(browser.new_page(viewport={"width": 1440, "height": 900}))
        browser.close()


def row(page: Page, name: str) -> object:
    return page.locator(".tabulator-row").filter(has_text=name)


def test_a_walk_through_the_page(
    pair: list[RunFolder], failed: RunFolder, served: str, visit: Visit, odd_name: str
) -> None:
    page = visit.page
    page.goto(served)

    # The list, newest first, with the two finished runs chosen.
    expect(page.locator(".tabulator-row")).to_have_count(3)
    expect(page.locator(".tabulator-row.tabulator-selected")).to_have_count(2)
    expect(page.get_by_text("The fake recipe fails here; found step 20.").first).to_be_visible()

    # One is exchanged for the failed run, and back.
    box = row(page, "stopped early").locator("input")
    box.check()
    expect(page.locator("article.run")).to_have_count(3)
    expect(page.locator(".badge.failed")).to_have_count(1)
    box.uncheck()
    expect(page.locator("article.run")).to_have_count(2)

    # Measures with the best marked; the harmful name is text.
    expect(page.locator("td.best").first).to_be_visible()
    expect(page.locator("article.run h3").first).to_contain_text(odd_name)
    expect(row(page, "window.harm").locator("[tabulator-field=name]")).to_have_text(odd_name)
    assert page.evaluate("window.harm") is None
    assert page.locator("img[src=x]").count() == 0

    # Figures, the one in space with a canvas that has a size.
    expect(page.locator(".js-plotly-plot")).to_have_count(5)
    canvas = page.locator(".gl-container canvas").first
    canvas.scroll_into_view_if_needed()
    box_of_canvas = canvas.bounding_box()
    assert box_of_canvas is not None
    assert box_of_canvas["width"] > 300

    # Another test picture; the dividing line follows the slider and the pointer.
    choice = page.locator("select")
    names = choice.locator("option").all_inner_texts()
    assert len(names) == 3
    choice.select_option(index=1)
    wanted = names[1].split(" ")[0]
    expect(page.locator("article.view h3")).to_have_text(wanted)
    images = page.locator("article.view img")
    expect(images).to_have_count(4)
    widths = images.evaluate_all("all => all.map(image => image.naturalWidth)")
    assert widths == [48] * 4
    page.locator("article.view input[type=range]").fill("20")
    split = "card => card.style.getPropertyValue('--split')"
    assert page.locator("article.view").evaluate(split) == "20%"
    page.locator("article.view .stack").first.hover(position={"x": 5, "y": 20})
    assert float(page.locator("article.view").evaluate(split).rstrip("%")) < 5
    page.get_by_role("button", name="Difference").click()
    expect(page.locator("[data-mode=difference]")).to_have_count(1)

    # The address keeps it all.
    page.wait_for_url(re.compile(f"runs={pair[0].id},{pair[1].id}&view={wanted}$"))
    page.reload()
    expect(page.locator("article.view h3")).to_have_text(wanted)
    expect(page.locator(".tabulator-row.tabulator-selected")).to_have_count(2)

    # A run that is not there is told.
    page.goto(f"{served}?runs=20990101-000000-fake-0000,<img src=x onerror=window.harm=1>")
    expect(page.get_by_text("There is no run '20990101-000000-fake-0000'")).to_be_visible()
    expect(page.get_by_text("There is no run '<img src=x onerror=window.harm=1>'")).to_be_visible()
    assert page.evaluate("window.harm") is None
    assert visit.problems == []


def test_runs_appear_by_themselves_on_a_dark_page(
    served: str, visit: Visit, request: pytest.FixtureRequest
) -> None:
    page = visit.page
    page.goto(f"{served}?theme=dark")
    expect(page.get_by_text("No runs yet")).to_be_visible()
    expect(page.get_by_text("make demo")).to_be_visible()
    request.getfixturevalue("pair")
    expect(page.locator("article.run")).to_have_count(2)
    expect(page.get_by_text("No runs yet")).to_be_hidden()
    page.wait_for_url(re.compile("theme=dark&runs="))
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(15, 19, 25)"
    assert visit.problems == []
