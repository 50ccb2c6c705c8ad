"""A browser looks at a splat: both viewers show what the rasterizer makes of it, turn, and find cameras."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from browsing import PATIENCE, collect_problems, free_port, launch, server_of
from fake_recipe import MakeRun
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Locator, Page, expect, sync_playwright
from splat_runs import splat_run

from toolkit.geometry.rigid import RigidTransform
from toolkit.runs.folder import RunFolder
from toolkit.runs.view_render import ViewPose, render_view
from toolkit.runs.view_scene import read_view
from toolkit.widgets.viewer_files import is_built

__all__ = ["splat_run"]

# The ground of a light page, #f6f7f9.
GROUND = (0xF6 / 255, 0xF7 / 255, 0xF9 / 255)
APP = Path(__file__).parent / "view_app.py"
Picture = NDArray[np.float64]
Open = Callable[..., Page]


@pytest.fixture
def run(splat_run: MakeRun) -> RunFolder:
    return splat_run(name="balls")


@pytest.fixture
def served(run: RunFolder) -> Iterator[str]:
    """Serve the tab below a prefix, as behind a proxy, in a process of its own and return its address."""
    port = free_port()
    with server_of(APP, run.path.parent, port, port=port, prefix="/user/a") as address:
        yield address


@pytest.fixture
def opened(served: str, problems: list[str]) -> Iterator[Open]:
    """Return a function that opens the tab; in the end nothing may have gone wrong on its pages."""
    with sync_playwright() as playwright:
        browsers = []

        def visit(*arguments: str, width: int = 900) -> Page:
            browsers.append(launch(playwright, *arguments))
            page = browsers[-1].new_page(viewport={"width": width, "height": 600}, reduced_motion="reduce")
            collect_problems(page, problems, below="/user/a")
            page.goto(served)
            return page

        yield visit
        for browser in browsers:
            browser.close()
    assert problems == []


def picture(place: Locator) -> Picture:
    """Return what is on the screen, (H, W, 3) from 0 to 255."""
    return np.asarray(Image.open(io.BytesIO(place.screenshot())).convert("RGB"), dtype=np.float64)


def settled(place: Locator) -> Picture:
    """Return what is on the screen when it has stood still for a moment and is more than one colour."""
    last, until = picture(place), time.monotonic() + PATIENCE / 1000
    while time.monotonic() < until:
        time.sleep(0.3)
        now = picture(place)
        if np.array_equal(now, last) and now.std() > 5:
            return now
        last = now
    pytest.fail("the picture does not come to rest, or is empty")


def bare(page: Page) -> Locator:
    """Hide what lies over the splat and return the place of the splat."""
    hide = (
        "root => { for (const one of root.querySelectorAll('.tools, .legend')) one.style.visibility = 'hidden'; }"
    )
    stage = page.locator(".stage:visible")
    expect(stage.locator(".message")).to_be_hidden(timeout=PATIENCE)
    stage.evaluate(hide)
    stage.locator(".overlay").evaluate("canvas => { canvas.style.opacity = 0; }")
    return stage.locator(".surface")


def wanted(run: RunFolder, number: int, size: tuple[int, int]) -> Picture:
    """Return what the rasterizer makes of a camera's view, seen whole in a picture of another shape."""
    splat = read_view(run)
    camera, (width, height) = splat.scene.cameras[number], size
    scale = min(width / camera.size[0], height / camera.size[1])
    focal = (scale * camera.focal[0], scale * camera.focal[1])
    principal = (
        width / 2 + scale * (camera.principal[0] - camera.size[0] / 2),
        height / 2 + scale * (camera.principal[1] - camera.size[1] / 2),
    )
    pose = ViewPose(camera.position, camera.rotation, focal, principal, size, GROUND)
    return render_view(splat, pose).astype(float)


def apart(shown: Picture, drawn: Picture) -> tuple[float, float]:
    """Return the mean difference and the largest in a block of 8 x 8 pixels, without the rounded corners."""
    height, width = (side - 16 - side % 8 for side in shown.shape[:2])
    difference = np.abs(shown - drawn)[8 : 8 + height, 8 : 8 + width]
    blocks = difference.reshape(height // 8, 8, width // 8, 8, 3).mean(axis=(1, 3, 4))
    return float(difference.mean()), float(blocks.max())


def photo(page: Page, number: int) -> Locator:
    return page.get_by_role("img", name=f"Photo of photo_{number}.png")


def place_of(run: RunFolder, number: int, nearer: float, size: tuple[int, int]) -> tuple[float, float]:
    """Return the pixel of a camera's centre, seen from the first camera when it went away by a factor."""
    view = read_view(run).scene
    first, other = view.cameras[0], view.cameras[number]
    world_from_cam = RigidTransform.from_quaternion(first.rotation, first.position)
    seen = world_from_cam.inverse().apply(other.position)
    seen[2] += first.distance * (nearer - 1)
    scale = min(size[0] / first.size[0], size[1] / first.size[1])
    return tuple(size[i] / 2 + scale * first.focal[i] * seen[i] / seen[2] for i in range(2))


def test_webgl_draws_what_the_rasterizer_draws_turns_and_finds_cameras(run: RunFolder, opened: Open) -> None:
    if not is_built():
        pytest.skip("the WebGL viewer is not built: make viewer")
    page = opened()
    surface = bare(page)
    first = settled(surface)
    height, width = first.shape[:2]
    # Colours come in steps (see toolkit.splat.spz) and are blended in 8 bits: 0.8 and 7.2 were seen.
    mean, worst = apart(first, wanted(run, 0, (width, height)))
    assert mean < 2
    assert worst < 15

    # A drag turns about the splat: another picture, and not that of a shift.
    box = surface.bounding_box()
    assert box is not None
    middle = (box["x"] + width / 2, box["y"] + height / 2)
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 150, middle[1] + 20, steps=4)
    page.mouse.up()
    assert np.abs(settled(surface) - first).mean() > 3
    page.keyboard.press("Home")
    assert np.abs(settled(surface) - first).mean() < 0.5

    # From farther away a click on a camera flies there and shows its photo.
    for _ in range(2):
        page.mouse.wheel(0, 300)
    assert np.abs(settled(surface) - first).mean() > 3
    x, y = place_of(run, 4, np.exp(2 * 0.0015 * 300), (width, height))
    page.mouse.click(box["x"] + x, box["y"] + y)
    expect(photo(page, 4)).to_be_visible()
    mean, worst = apart(settled(surface), wanted(run, 4, (width, height)))
    assert mean < 2
    assert worst < 15
    page.keyboard.press(",")
    expect(photo(page, 3)).to_be_visible()


def test_a_browser_without_webgl_is_told_and_gets_pictures_of_the_rasterizer(run: RunFolder, opened: Open) -> None:
    page = opened("--disable-3d-apis")
    told = (
        "This browser does not draw with WebGL 2. Pictures come from the CPU rasterizer"
        if is_built()
        else "not built"
    )
    expect(page.get_by_text(told)).to_be_visible()
    whole = page.locator(".surface[data-shown=whole]:visible")
    # The first picture may have to wait for the kernels to be compiled.
    expect(whole).to_be_attached(timeout=4 * PATIENCE)
    surface = bare(page)
    first = settled(surface)
    height, width = first.shape[:2]
    # JPEG of quality 88.
    mean, worst = apart(first, wanted(run, 0, (width, height)))
    assert mean < 2
    assert worst < 10

    surface.evaluate("canvas => { delete canvas.dataset.shown; }")
    page.get_by_role("application").press("ArrowRight")
    expect(whole).to_be_attached()
    assert np.abs(settled(surface) - first).mean() > 3
    page.get_by_label("Camera", exact=True).select_option(label="5: photo_4.png (train)")
    expect(photo(page, 4)).to_be_visible()
    mean, worst = apart(settled(surface), wanted(run, 4, (width, height)))
    assert mean < 2
    assert worst < 10
