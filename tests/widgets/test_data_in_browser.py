"""A browser makes a sample, looks at it, and sends zips, good and bad."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browsing import free_port, server_of
from PIL import Image
from playwright.sync_api import Page, expect

APP = Path(__file__).parent / "data_app.py"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    folder.mkdir()
    return folder


@pytest.fixture
def served(runs_dir: Path, data: Path) -> Iterator[str]:
    """Serve the tab in a process of its own and return its address."""
    port = free_port()
    with server_of(APP, runs_dir, data, port, port=port) as address:
        yield address


def photo(seed: int) -> bytes:
    memory = io.BytesIO()
    coarse = Image.fromarray(np.random.default_rng(seed).integers(0, 255, (6, 8, 3), dtype=np.uint8))
    coarse.resize((96, 72), Image.Resampling.BICUBIC).save(memory, "JPEG")
    return memory.getvalue()


def packed(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as opened:
        for name, content in files.items():
            opened.writestr(name, content)
    return path


def set_number(page: Page, setting: str, value: int) -> None:
    """Look a setting up in the form and change it."""
    page.get_by_placeholder("Find a setting").fill(setting)
    label = setting.replace("_", " ")
    field = page.get_by_label(re.compile(f"^{label}")).first
    field.fill(str(value))
    field.press("Enter")


def open_card(page: Page, title: str) -> None:
    page.get_by_role("button", name=title).click()


def test_a_sample_is_made_and_looked_at(served: str, page: Page, problems: list[str], data: Path) -> None:
    page.goto(served)
    expect(page.get_by_text(f"0 captures in {data}.")).to_be_visible()

    # A name that leads out is refused, and the form stays.
    open_card(page, "Make a sample")
    for setting, value in (("frames", 5), ("image_width", 96), ("image_height", 72), ("trees", 0), ("points", 0)):
        set_number(page, setting, value)
    name = page.get_by_label("Name of its folder").first
    name.fill("../tiny")
    name.press("Tab")
    page.get_by_role("button", name="Make it").click()
    expect(page.get_by_text("The folder cannot have this name")).to_be_visible()
    name.fill("tiny")
    name.press("Tab")
    page.get_by_role("button", name="Make it").click()

    # It is there, chosen, and shown with its photos, maps and facts.
    expect(page.locator("button[data-photo]")).to_have_count(5)
    assert page.get_by_label("Capture", exact=True).input_value() == str(data / "tiny")
    expect(page.locator(".js-plotly-plot:visible")).to_have_count(3)
    expect(page.locator("dl.facts")).to_contain_text("5 of 5 photos (100 %)")
    canvas = page.locator(".gl-container canvas").first
    box = canvas.bounding_box()
    assert box is not None
    assert box["width"] > 300
    expect(page.get_by_text("scale", exact=False)).to_have_count(0)
    expect(page.locator(".js-plotly-plot:visible").nth(1)).to_contain_text("N ↑")

    # Pressing a photo, by keyboard too, shows it larger with its tags.
    page.locator("button[data-photo='2']").focus()
    page.keyboard.press("Enter")
    card = page.locator("article.view")
    expect(card.locator("h3")).to_have_text("frame_0002.jpg")
    expect(card).to_contain_text("Above take-off")
    assert card.locator("img").evaluate("image => image.naturalWidth") == 96
    page.locator("button[data-photo='2']").click()
    expect(card).to_have_count(0)

    # A run is asked for elsewhere.
    page.get_by_role("button", name="Run a method on it").click()
    expect(page.get_by_text("asked for run of tiny")).to_be_visible()

    # A long one is cancelled and leaves nothing.
    set_number(page, "frames", 2000)
    name.fill("endless")
    name.press("Tab")
    page.get_by_role("button", name="Make it").click()
    expect(page.get_by_label("Making endless")).to_be_visible()
    page.get_by_role("button", name="Cancel").click()
    expect(page.get_by_text("Making endless: cancelled.")).to_be_visible()
    assert [path.name for path in data.iterdir()] == ["tiny"]

    # Another is at work while the server is told to stop: it ends at once, and the fixture sees that it does.
    page.get_by_role("button", name="Make it").click()
    expect(page.get_by_label("Making endless")).to_be_visible()
    assert problems == []


def test_zips_good_and_bad(served: str, page: Page, problems: list[str], data: Path, tmp_path: Path) -> None:
    page.goto(f"{served}?theme=dark")
    expect(page.get_by_text(f"0 captures in {data}.")).to_be_visible()
    open_card(page, "Upload a zip")
    field = page.locator("input[type=file]")
    field.set_input_files(packed(tmp_path / "evil.zip", {"../../evil.jpg": photo(0)}))
    expect(page.get_by_text("The zip was refused for '../../evil.jpg'")).to_be_visible()
    field.set_input_files(packed(tmp_path / "words.zip", {"words.txt": b"no pictures"}))
    expect(page.get_by_text("The zip holds no capture")).to_be_visible()
    assert list(data.iterdir()) == []

    # Of three parts, with a name that would do harm where it is not escaped.
    harm = "<img src=x onerror=window.harm=1>.jpg"
    noise = np.random.default_rng(0).bytes(9_000_000)
    good = {"images/a.jpg": photo(1), f"images/{harm}": photo(2), "images/c.jpg": photo(3), "noise.bin": noise}
    field.set_input_files(packed(tmp_path / "My flight.zip", good))
    expect(page.locator("button[data-photo]")).to_have_count(3)
    expect(page.get_by_text("no photo has a GPS position")).to_be_visible()
    expect(page.locator("button[data-photo]").first).to_contain_text("<img")
    assert page.get_by_label("Capture", exact=True).input_value() == str(data / "My-flight")
    assert (data / "My-flight/noise.bin").read_bytes() == noise
    assert [path.name for path in data.iterdir()] == ["My-flight"]
    page.locator("button[data-photo]").first.click()
    expect(page.locator("article.view h3")).to_have_text(harm)
    assert page.evaluate("window.harm") is None

    # A folder that is none of the data is refused, one that is there is shown.
    open_card(page, "Folder on the server")
    folder = page.get_by_label("Folder on the server", exact=True).last
    folder.fill("/etc")
    folder.press("Enter")
    page.get_by_role("button", name="Open").click()
    expect(page.get_by_text("/etc is not among the data")).to_be_visible()

    # It holds together on a telephone.
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    assert problems == []
