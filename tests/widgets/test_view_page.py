"""The View tab: which runs it lists, what it shows of them, and what it says when something is wrong."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import panel as pn
import pytest
from fake_recipe import MakeRun
from splat_recipe import coloured_balls
from splat_runs import AtOnce, splat_run

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.runs.folder import RunFolder
from toolkit.runs.view_scene import QueryPose
from toolkit.runs.view_work import ViewWork
from toolkit.splat.ply import write_splats
from toolkit.widgets import view_page
from toolkit.widgets.splat_view import SplatView
from toolkit.widgets.stream_view import StreamView
from toolkit.widgets.view_page import CPU, WEBGL, ViewPage

__all__ = ["splat_run"]

MakePage = Callable[..., ViewPage]


@pytest.fixture
def page_of(runs_dir: Path, monkeypatch: pytest.MonkeyPatch) -> MakePage:
    """Return a function that makes a page, with a WebGL viewer unless told otherwise."""

    def make(*, built: bool = True, **options: object) -> ViewPage:
        monkeypatch.setattr(view_page, "is_built", lambda: built)
        return ViewPage(runs_dir, work=ViewWork(), executor=AtOnce(), **options)

    return make


def notice(page: ViewPage) -> str:
    return str(page._notice.object)


def test_runs_with_a_splat_are_listed_and_the_newest_is_shown(
    splat_run: MakeRun, finished: MakeRun, page_of: MakePage
) -> None:
    first, second = splat_run(name="a <b>"), splat_run()
    finished(name="without")
    page = page_of()
    page.refresh()
    newest = max(first.id, second.id)
    assert set(page._runs._choice.options.values()) == {first.id, second.id}
    assert f"a <b> ({first.id})" in page._runs._choice.options
    assert page.selected == newest
    assert page.shown is not None
    assert page.shown.run.id == newest
    assert isinstance(page._view, SplatView)
    assert page._view.scene["count"] == 300
    assert "300 Gaussians, 6 cameras." in str(page._about.object)
    assert notice(page) == ""


def test_another_run_is_shown_when_it_is_chosen(splat_run: MakeRun, page_of: MakePage) -> None:
    runs = [splat_run(), splat_run(seed=1)]
    page = page_of()
    page.refresh()
    other = next(run for run in runs if run.id != page.selected)
    splat = page._view.scene["splat"]
    page._runs._choice.value = other.id
    assert page.selected == other.id
    assert page.shown is not None
    assert page.shown.run.id == other.id
    assert page._view.scene["splat"] != splat


def test_nothing_is_read_again_that_has_not_changed(
    splat_run: MakeRun, page_of: MakePage, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = splat_run()
    page = page_of()
    page.refresh()
    scene = page._view.scene

    def refuse(self: RunFolder) -> None:
        raise AssertionError("was read again")

    monkeypatch.setattr(RunFolder, "record", refuse)
    page.refresh()
    assert page._view.scene is scene
    monkeypatch.undo()
    write_splats(coloured_balls(count=40), run.splat_file)
    page.refresh()
    assert page._view.scene["count"] == 40


def test_an_id_that_is_not_listed_is_told_and_opens_nothing(
    splat_run: MakeRun, page_of: MakePage, tmp_path: Path
) -> None:
    run = splat_run()
    shutil.copytree(run.path, tmp_path / "elsewhere")
    page = page_of()
    page.refresh()
    for strange in ("../elsewhere", str(tmp_path / "elsewhere"), "<img src=x onerror=window.harm=1>"):
        page.selected = strange
        assert page.shown is None
        assert page._view.scene == {}
        assert "There is no run" in notice(page)
        assert "<img" not in notice(page)
    page.selected = run.id
    assert page.shown is not None
    assert notice(page) == ""


def test_a_run_in_the_address_is_opened_before_the_first_look(splat_run: MakeRun, page_of: MakePage) -> None:
    runs = sorted([splat_run(), splat_run()], key=lambda run: run.id)
    page = page_of()
    page.selected = runs[0].id
    assert page.shown is not None
    page.refresh()
    assert page.shown.run.id == runs[0].id


def test_cameras_are_chosen_in_the_list_and_in_the_viewer(splat_run: MakeRun, page_of: MakePage) -> None:
    splat_run()
    page = page_of()
    page.refresh()
    page._view.camera = 2  # as a click does
    assert (page.camera, page._cameras._choice.value) == (2, 2)
    assert 'alt="Photo of photo_2.png"' in str(page._cameras._photo.object)
    page._cameras._choice.value = 3
    assert (page.camera, page._view.camera) == (3, 3)
    page.viewer = CPU
    assert (page.camera, page._view.camera) == (3, 3)
    for strange in (99, -7):
        page._view.camera = strange
        assert (page.camera, page._view.camera) == (-1, -1)
        assert str(page._cameras._photo.object) == ""
    page.camera = 1
    assert page._view.camera == 1


def test_a_photo_that_is_gone_is_told(splat_run: MakeRun, page_of: MakePage, tmp_path: Path) -> None:
    splat_run()
    shutil.rmtree(tmp_path / "photos")
    page = page_of()
    page.refresh()
    page.camera = 0
    assert "The photo is not on this machine any more" in str(page._cameras._photo.object)


def test_the_query_is_the_last_camera(splat_run: MakeRun, page_of: MakePage) -> None:
    splat_run()
    pose = RigidTransform.look_at((1.0, 0.0, 3.0), (2.0, 8.0, 0.0))
    page = page_of(query=lambda run: QueryPose("asked.jpg", ColmapCamera.pinhole(64, 48, 50.0), pose))
    page.refresh()
    assert page._view.scene["cameras"][-1]["use"] == "query"
    assert "7: asked.jpg (query)" in page._cameras._choice.options


def test_without_a_bundle_the_page_says_so_and_streams(splat_run: MakeRun, page_of: MakePage) -> None:
    splat_run()
    page = page_of(built=False)
    page.refresh()
    assert page.viewer == CPU
    assert page._viewers.options == [CPU]
    assert isinstance(page._view, StreamView)
    assert page._view.scene["radius"] > 0
    assert "The WebGL viewer is not built" in notice(page)
    assert "sh scripts/build_viewer.sh" in notice(page)
    page.viewer = WEBGL
    assert page.viewer == CPU


def test_a_browser_without_webgl_gets_pictures_and_is_told(splat_run: MakeRun, page_of: MakePage) -> None:
    splat_run()
    page = page_of()
    page.refresh()
    page._view.failure = "This browser does not draw with WebGL 2. <b>"
    assert page.viewer == CPU
    assert isinstance(page._view, StreamView)
    assert page._view.scene["radius"] > 0
    assert "does not draw with WebGL 2. &lt;b&gt; Pictures come from the CPU rasterizer instead" in notice(page)
    page._viewers.value = WEBGL
    assert (page.viewer, page._viewers.value) == (CPU, CPU)


def test_a_damaged_splat_is_told_and_the_page_goes_on(splat_run: MakeRun, page_of: MakePage) -> None:
    good, bad = splat_run(), splat_run()
    bad.splat_file.write_bytes(b"ply\nformat")
    page = page_of()
    page.selected = bad.id
    assert f"{bad.id} cannot be shown: " in notice(page)
    assert page._view.status == ""
    page.refresh()
    assert f"{bad.id} cannot be shown: " in notice(page)
    page.selected = good.id
    assert page.shown is not None
    assert notice(page) == ""


def test_a_run_that_is_deleted_while_it_is_shown_stays_until_another_is_chosen(
    splat_run: MakeRun, page_of: MakePage
) -> None:
    run = splat_run()
    page = page_of()
    page.refresh()
    shutil.rmtree(run.path)
    page.refresh()
    assert f"Run {run.id} has no splat any more, or is gone" in notice(page)
    assert page.shown is not None
    assert page._view.scene["count"] == 300


def test_an_empty_folder_says_what_makes_splats(page_of: MakePage) -> None:
    page = page_of()
    page.refresh()
    assert "No splats yet" in str(page._foot.object)
    assert not page._body.visible


def test_the_stream_tells_its_problems_on_the_page(splat_run: MakeRun, page_of: MakePage) -> None:
    splat_run()
    page = page_of(built=False)
    page.refresh()
    page._view._handle_msg({"kind": "view", "number": 1, "size": "x"})
    assert "The view&#x27;s position cannot be used" in notice(page)


def test_compare_opens_the_other_tab(splat_run: MakeRun, page_of: MakePage) -> None:
    opened: list[tuple[str, str]] = []
    run = splat_run()
    page = page_of(show=lambda tab, run_id: opened.append((tab, run_id)))
    page.refresh()
    page._other.clicks += 1
    assert opened == [("compare", run.id)]
    assert not page_of()._other.visible


def test_the_page_is_a_viewer_of_panel(page_of: MakePage) -> None:
    assert isinstance(pn.panel(page_of()), pn.Column)
