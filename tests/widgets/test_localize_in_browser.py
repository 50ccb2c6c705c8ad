"""A browser asks where a photo was taken, from where it stands, and sees the answer."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from browsing import PATIENCE, collect_problems, free_port, launch, server_of, take_picture
from ground_run import POSES, TESTS, UNPOSED, make_ground_run
from playwright.sync_api import Page, expect, sync_playwright

from toolkit.metrics.localization import pose_errors
from toolkit.runs.folder import RunFolder
from toolkit.runs.photo_results import photo_file, read_photo_result

APP = Path(__file__).parent / "view_app.py"


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    return make_ground_run(tmp_path)


@pytest.fixture
def page(run: RunFolder, problems: list[str]) -> Iterator[Page]:
    """Yield the tab on a page, served below a prefix; in the end nothing may have gone wrong on it."""
    port = free_port()
    with (
        server_of(APP, run.path.parent, port, port=port, prefix="/user/a") as address,
        sync_playwright() as playwright,
    ):
        browser = launch(playwright)
        page = browser.new_page(viewport={"width": 1200, "height": 900}, reduced_motion="reduce")
        collect_problems(page, problems, below="/user/a")
        page.goto(address)
        yield page
        browser.close()
    assert problems == []


def test_a_photo_is_localised_from_where_the_viewer_stands(page: Page, run: RunFolder) -> None:
    # The question is asked once there is a splat to ask it of; the first one may have to wait for another process.
    question = page.get_by_role("button", name="Where was a photo taken?")
    expect(question).to_be_visible(timeout=4 * PATIENCE)
    expect(page.locator(".stage:visible .message")).to_be_hidden(timeout=2 * PATIENCE)
    question.click()
    page.get_by_label("Photo", exact=True).select_option(label=f"{TESTS[0]} (test)")
    # The one shot is quick, and found a camera of the map's is near enough.
    page.get_by_label("Method", exact=True).select_option(label="one shot, as the paper")
    features = page.get_by_label("Features", exact=True)
    expect(features).to_have_value("aliked-lightglue")  # the method's own, which needs weights
    features.select_option("sift")
    take_picture(page, "localize_form")
    page.get_by_role("button", name="Localise", exact=True).click()
    expect(page.get_by_text("Off the scene's pose by")).to_be_visible(timeout=4 * PATIENCE)
    expect(page.locator(".badge", has_text="found")).to_be_visible()
    stored = read_photo_result(photo_file(run, TESTS[0], frame=True))
    assert stored.cam_from_world is not None
    assert pose_errors(stored.cam_from_world, POSES[4])[0] < 0.5
    # The viewer stands in the first camera of the run.
    assert stored.start is not None
    assert pose_errors(stored.start, POSES[0])[0] < 1e-4

    # Photo and render with a dividing line, and the matches.
    images = page.locator("article.view img")
    expect(images).to_have_count(2)
    assert images.evaluate_all("all => all.map(image => image.naturalWidth)") == [240, 240]
    page.locator("article.view input[type=range]").fill("20")
    split = "card => card.style.getPropertyValue('--split')"
    assert page.locator("article.view").evaluate(split) == "20%"
    expect(page.locator(".js-plotly-plot:visible")).to_have_count(1)
    expect(page.locator(".js-plotly-plot:visible")).to_contain_text("inliers of PnP")

    # It is in the viewer and in its list, and can be looked through.
    expect(page.locator(".stage:visible .legend")).to_contain_text("1 query")
    expect(page.locator(".stage:visible .legend")).to_contain_text("1 start")
    page.get_by_role("button", name="Look through it").click()
    camera = page.get_by_label("Camera", exact=True)
    expect(camera.locator("option:checked")).to_have_text(f"7: {TESTS[0]} (query)")
    take_picture(page, "localize_answer_top")
    page.locator("article.view").scroll_into_view_if_needed()
    take_picture(page, "localize_answer")
    page.locator(".js-plotly-plot:visible").scroll_into_view_if_needed()
    take_picture(page, "localize_matches")

    # It is among the earlier results, also after a photo of one's own.
    page.get_by_label("Photo", exact=True).select_option(label="a picture file of mine …")
    page.locator("input[type=file]:visible").set_input_files(run.path.parents[1] / "photos" / UNPOSED)
    expect(page.locator("progress[aria-label=Upload]")).to_be_hidden()
    page.get_by_role("button", name="Localise", exact=True).click()
    expect(page.locator("article.view h3")).to_be_visible()
    expect(page.get_by_role("cell", name=UNPOSED, exact=True)).to_be_visible(timeout=2 * PATIENCE)
    expect(page.get_by_label("Earlier results", exact=True).locator("option")).to_have_text(
        ["none", "localised here (2)"]
    )
    page.get_by_label("Earlier results", exact=True).select_option(index=1)
    page.get_by_label("Photo among them", exact=True).select_option(label=f"2: {TESTS[0]}")
    expect(page.get_by_text("Off the scene's pose by")).to_be_visible()
    take_picture(page, "localize_earlier")
