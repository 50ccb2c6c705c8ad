"""A browser walks through the page as a person would; the page loads nothing from elsewhere."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from browsing import free_port, server_of
from playwright.sync_api import Page, expect

from toolkit.runs.folder import RunFolder
from toolkit.runs.notes import RunNotes, read_notes
from toolkit.runs.trash import deleted_runs

APP = Path(__file__).parent / "compare_app.py"


@pytest.fixture
def served(runs_dir: Path) -> Iterator[str]:
    """Serve the runs in a process of its own and return their address."""
    port = free_port()
    with server_of(APP, runs_dir, port, 1000, port=port) as address:
        yield address


def row(page: Page, name: str) -> object:
    return page.locator(".tabulator-row").filter(has_text=name)


def test_a_walk_through_the_page(
    pair: list[RunFolder], failed: RunFolder, served: str, page: Page, problems: list[str], odd_name: str
) -> None:
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
    choice = page.get_by_label("Test pictures, worst first")
    names = choice.locator("option").all_inner_texts()
    assert len(names) == 3
    choice.select_option(index=1)
    wanted = names[1].split(" ")[0]
    expect(page.locator("article.view h3")).to_have_text(wanted)
    images = page.locator("article.view img")
    expect(images).to_have_count(6)  # photo, render and error map of two runs
    widths = images.evaluate_all("all => all.map(image => image.naturalWidth)")
    assert widths == [48] * 6
    page.locator("article.view input[type=range]").fill("20")
    split = "card => card.style.getPropertyValue('--split')"
    assert page.locator("article.view").evaluate(split) == "20%"
    page.locator("article.view .stack").first.hover(position={"x": 5, "y": 20})
    assert float(page.locator("article.view").evaluate(split).rstrip("%")) < 5
    expect(page.locator("article.view img.error").first).to_be_hidden()
    page.get_by_role("button", name="Error map").click()
    expect(page.locator("article.view img.error").first).to_be_visible()

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
    assert problems == []


def test_runs_appear_by_themselves_on_a_dark_page(
    served: str, page: Page, problems: list[str], request: pytest.FixtureRequest
) -> None:
    page.goto(f"{served}?theme=dark")
    expect(page.get_by_text("No runs yet")).to_be_visible()
    expect(page.get_by_text("make demo")).to_be_visible()
    request.getfixturevalue("pair")
    expect(page.locator("article.run")).to_have_count(2)
    expect(page.get_by_text("No runs yet")).to_be_hidden()
    page.wait_for_url(re.compile("theme=dark&runs="))
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(15, 19, 25)"
    assert problems == []


def test_runs_are_found_tagged_deleted_and_brought_back(
    pair: list[RunFolder], failed: RunFolder, served: str, page: Page, problems: list[str], runs_dir: Path
) -> None:
    page.goto(f"{served}?runs={pair[1].id}")
    rows = page.locator(".tabulator-row")
    expect(rows).to_have_count(3)
    expect(row(page, "fast")).to_have_class(re.compile("tabulator-selected"))

    # Words, a condition, and what cannot be read.
    box = page.get_by_label("Filter", exact=True)
    box.fill("stopped")
    expect(rows).to_have_count(1)
    box.fill("rate<0.5")
    expect(row(page, "stopped early")).to_have_count(0)
    expect(row(page, "fast")).to_be_visible()
    box.fill("nothing>1")
    expect(page.get_by_text("No run has a measure or setting 'nothing'")).to_be_visible()
    box.fill("")
    expect(rows).to_have_count(3)

    # A tag and a note, without a mouse.
    page.get_by_label("Tags").fill("keep, <b>odd")
    page.get_by_label("Note").fill("the quick one")
    page.get_by_role("button", name="Save", exact=True).focus()
    page.keyboard.press("Enter")
    expect(page.get_by_text("Saved what you say about fast.")).to_be_visible()
    expect(row(page, "fast").locator("[tabulator-field=tags]")).to_have_text("keep, <b>odd")
    assert read_notes(pair[1]) == RunNotes(("keep", "<b>odd"), "the quick one")
    page.get_by_label("Tag", exact=True).select_option(label="keep (1)")
    expect(rows).to_have_count(1)
    page.get_by_label("Tag", exact=True).select_option(label="any")
    expect(rows).to_have_count(3)

    # Columns and groups.
    page.get_by_label("More columns").select_option(label="loop.rate")
    expect(row(page, "fast").locator("[tabulator-field=extra0]")).to_have_text("0.2")
    expect(row(page, "fast").locator("input")).to_be_checked()
    page.get_by_label("Group by").select_option(label="recipe")
    expect(page.locator(".tabulator-group")).to_contain_text("fake")
    page.get_by_label("Group by").select_option(label="no groups")

    # Deleted, and brought back.
    page.get_by_role("button", name="Delete run").click()
    expect(rows).to_have_count(2)
    expect(page.locator("article.run")).to_have_count(0)
    assert deleted_runs(runs_dir) == [pair[1].id]
    page.get_by_role("button", name="Undo").click()
    expect(rows).to_have_count(3)
    expect(page.get_by_role("button", name="Undo")).to_be_hidden()
    assert deleted_runs(runs_dir) == []
    row(page, "fast").locator("input").check()
    expect(page.locator("article.run")).to_have_count(1)

    # Another page, or a person in the folder, takes it away: the page says so and goes on.
    pair[1].path.rename(runs_dir.parent / "elsewhere")
    expect(page.get_by_text("fast is not there any more: it was deleted or moved away.")).to_be_visible()
    expect(rows).to_have_count(2)
    box.fill("stopped")
    expect(rows).to_have_count(1)
    assert problems == []


def test_pictures_are_zoomed_and_the_comparison_is_taken_home(
    pair: list[RunFolder], served: str, page: Page, problems: list[str]
) -> None:
    page.goto(served)
    card = page.locator("article.view")
    worst = min(pair[0].result().test_views, key=lambda view: view.psnr).name
    expect(card.locator("h3")).to_have_text(worst)

    # The best one is clicked in the list, and the worst one again.
    choice = page.get_by_label("Test pictures, worst first")
    choice.select_option(index=2)
    expect(card.locator("h3")).not_to_have_text(worst)
    choice.select_option(index=0)
    expect(card.locator("h3")).to_have_text(worst)

    zoom = "card => Number(card.style.getPropertyValue('--zoom') || 1)"
    card.get_by_role("button", name="Zoom in").click()
    assert card.evaluate(zoom) == 2
    stack = card.locator(".stack").first
    stack.focus()
    page.keyboard.press("+")
    page.keyboard.press("ArrowRight")
    assert card.evaluate(zoom) == 4
    # A quarter is seen, the middle of it a fortieth beyond the middle: 100 (0.5 - 4 (0.5 + 0.1 / 4)) percent.
    assert card.evaluate("card => card.style.getPropertyValue('--shift-x')") == "-160%"
    boxes = [stack.locator(name).first.bounding_box() for name in ("img.photo", "img.render")]
    assert boxes[0] == boxes[1]
    card.get_by_role("button", name="Whole picture").click()
    assert card.evaluate(zoom) == 1

    # Points are drawn where they are asked for; these runs have none, which is said.
    page.get_by_label("Points").select_option(label="initial points")
    expect(page.get_by_text("has no points; expected a finished run")).to_be_visible()

    with page.expect_download() as csv_file:
        page.get_by_text("Comparison as CSV").click()
    lines = list(csv.reader(csv_file.value.path().read_text(encoding="utf-8").splitlines()))
    assert csv_file.value.suggested_filename == "comparison.csv"
    assert ["setting", "loop.rate", "0.8", "0.2"] in lines
    with page.expect_download() as html_file:
        page.get_by_text("Comparison as HTML page").click()
    assert html_file.value.path().read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert problems == []


# The element that has the keyboard, through all shadow roots, in words.
FOCUSED = """
() => {
  let here = document.activeElement;
  while (here && here.shadowRoot && here.shadowRoot.activeElement) here = here.shadowRoot.activeElement;
  if (!here || here === document.body) return "";
  const label = here.labels && here.labels.length ? here.labels[0].textContent : "";
  return [here.tagName, here.getAttribute("aria-label") || label || here.textContent.slice(0, 40)].join(" ").trim();
}
"""
# Texts whose contrast against their ground (WCAG 2, the colours of see-through grounds laid over each other) is
# below the bound, with that contrast.
FAINT = """
(bound) => {
  const pen = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  const read = (colour) => {
    pen.clearRect(0, 0, 1, 1);
    pen.fillStyle = colour;
    pen.fillRect(0, 0, 1, 1);
    const [r, g, b, a] = pen.getImageData(0, 0, 1, 1).data;
    return [r, g, b, a / 255];
  };
  const over = (top, below) => [0, 1, 2].map((i) => top[3] * top[i] + (1 - top[3]) * below[i]).concat([1]);
  const above = (node) => node.assignedSlot || node.parentElement || (node.getRootNode().host ?? null);
  const ground = (node) => {
    const layers = [];
    for (let at = node; at; at = above(at)) {
      const colour = read(getComputedStyle(at).backgroundColor);
      if (colour[3] > 0) layers.push(colour);
      if (colour[3] === 1) break;
    }
    return layers.reduceRight((below, top) => over(top, below), [255, 255, 255, 1]);
  };
  const light = ([r, g, b]) => {
    const [x, y, z] = [r, g, b].map((c) => (c /= 255) <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
    return 0.2126 * x + 0.7152 * y + 0.0722 * z;
  };
  const found = [];
  let seen = 0;
  const look = (root) => {
    for (const node of root.querySelectorAll("*")) {
      if (node.shadowRoot) look(node.shadowRoot);
      const own = [...node.childNodes].some((child) => child.nodeType === 3 && child.textContent.trim());
      if (!own || ["STYLE", "SCRIPT", "OPTION"].includes(node.tagName) || node.closest("svg, :disabled")) continue;
      if (!node.checkVisibility({ checkOpacity: true, checkVisibilityCSS: true })) continue;
      if (node.closest(".tag")) continue;  // on a photo
      seen += 1;
      const below = ground(node), text = over(read(getComputedStyle(node).color), below);
      const [high, low] = [light(text), light(below)].sort((a, b) => b - a);
      const contrast = (high + 0.05) / (low + 0.05);
      const told = `${contrast.toFixed(2)} ${node.tagName} ${node.textContent.trim().slice(0, 40)}`;
      if (contrast < bound) found.push(told);
    }
  };
  look(document);
  return [seen, [...new Set(found)]];
}
"""


def test_the_page_is_usable_on_a_phone_by_keyboard_and_on_either_ground(
    pair: list[RunFolder], failed: RunFolder, served: str, page: Page, problems: list[str]
) -> None:
    for theme in ("default", "dark"):
        page.goto(f"{served}?theme={theme}")
        expect(page.locator("article.view img").first).to_be_visible()
        seen, faint = page.evaluate(FAINT, 4.5)
        assert seen > 100  # texts were found at all
        assert faint == []

    reached = []
    page.locator("body").press("Home")
    for _ in range(120):
        page.keyboard.press("Tab")
        reached.append(page.evaluate(FOCUSED))
    for wanted in (
        "INPUT Filter",
        "SELECT State",
        "SELECT Group by",
        "SELECT More columns",
        "INPUT Select Row",
        "INPUT Tags",
        "TEXTAREA Note",
        "BUTTON Save",
        "BUTTON Delete run",
        "Comparison as CSV",
        "SELECT Test pictures, worst first",
        "BUTTON Error map",
        "BUTTON Zoom in",
        "INPUT Photo and render of ",
    ):
        assert any(wanted in text for text in reached), (wanted, reached)

    page.set_viewport_size({"width": 390, "height": 844})
    page.goto(served)
    expect(page.locator("article.view img").first).to_be_visible()
    wide = "() => [document.documentElement.scrollWidth, document.body.scrollWidth, innerWidth]"
    whole, body, window = page.evaluate(wide)
    assert max(whole, body) <= window == 390
    card = page.locator("article.view").bounding_box()
    assert card is not None
    assert card["x"] >= 0
    assert card["x"] + card["width"] <= 390
    assert problems == []
