"""The View tab's question where a photo was taken: what is asked, what is shown, and what is said."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ground_run import NAMES, POSES, TESTS, UNPOSED, make_ground_run
from splat_ground import CAMERA
from splat_runs import AtOnce

from toolkit.errors import StageError
from toolkit.files import write_json
from toolkit.progress import Progress, ProgressEvent
from toolkit.runs.folder import RunFolder
from toolkit.runs.localize_work import LocalizeWork, PhotoAnswer, PhotoRequest
from toolkit.runs.photo_results import StoredPose
from toolkit.runs.pose_pictures import PosePictures
from toolkit.runs.view_render import ViewPose
from toolkit.runs.view_work import ViewWork
from toolkit.widgets import view_page
from toolkit.widgets.localize_form import HERE, OWN, SENSORS
from toolkit.widgets.localize_panel import LocalizePanel
from toolkit.widgets.splat_view import SplatView
from toolkit.widgets.view_page import ViewPage

ID = "20260601-100000-2dgs-sparse-abcd"


class FakeWork(LocalizeWork):
    """Says at once that a photo was taken where the search began, and keeps what it was asked."""

    def __init__(self) -> None:
        self.asked: list[PhotoRequest] = []
        self.problem: Exception | None = None
        self.lost = False

    def localize(self, request: PhotoRequest, progress: Progress = lambda event: None) -> PhotoAnswer:
        self.asked.append(request)
        progress(ProgressEvent("localize.photo", 1, None, "render 1"))
        if self.problem is not None:
            raise self.problem
        pose = request.start.pose or POSES[4]
        found = None if self.lost else pose
        stored = StoredPose(
            request.name,
            "ours",
            found,
            "it is dark" if self.lost else "",
            start=pose,
            matches=9,
            inliers=7,
            rounds=2,
        )
        return self.look(request.run, stored)

    def look(self, run: RunFolder, pose: StoredPose) -> PhotoAnswer:
        grey = np.full((18, 24, 3), 90, np.uint8)
        pixels = np.array([[3.0, 4.0], [9.0, 8.0]])
        pictures = PosePictures(
            grey,
            grey,
            np.ones((18, 24), bool),
            pixels,
            pixels + 1,
            np.array([True, False]),
            CAMERA,
            Path("x.png"),
            40.0,
            None,
            True,
        )
        return PhotoAnswer(pose, pictures, (0.25, 0.5), (5.0, 5.0))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return make_ground_run(tmp_path_factory.mktemp("ground"))


@pytest.fixture
def work() -> FakeWork:
    return FakeWork()


@pytest.fixture
def page(run: RunFolder, work: FakeWork, monkeypatch: pytest.MonkeyPatch) -> ViewPage:
    """Return a page that shows the run, with a WebGL viewer."""
    monkeypatch.setattr(view_page, "is_built", lambda: True)
    made = ViewPage(run.path.parent, work=ViewWork(), executor=AtOnce(), localizer=work)
    made.refresh()
    return made


@pytest.fixture
def panel(page: ViewPage) -> LocalizePanel:
    return page.localize


def settled(panel: LocalizePanel) -> None:
    """Wait until nothing works."""
    until = time.monotonic() + 20
    while panel.task.busy and time.monotonic() < until:
        time.sleep(0.02)
        panel.task.look()
    assert not panel.task.busy


def facts(panel: LocalizePanel) -> str:
    return str(panel._answer._facts.object)


def said(panel: LocalizePanel) -> str:
    return str(panel._message.object)


def test_all_frames_are_offered_those_that_made_no_map_first(panel: LocalizePanel, run: RunFolder) -> None:
    options = list(panel.form._photo.options)
    assert options[:2] == [f"{TESTS[0]} (test)", f"{TESTS[1]} (test)"]
    assert f"{UNPOSED} (no pose)" in options
    assert options[-1] == "a picture file of mine …"
    assert len(options) == len(NAMES) + 1
    assert panel._layout.visible


def test_the_viewers_place_is_the_start(page: ViewPage, panel: LocalizePanel, work: FakeWork) -> None:
    assert panel.form.start == HERE
    assert page.shown is not None
    heard: list[Any] = []
    viewer = page._view
    assert isinstance(viewer, SplatView)
    viewer._send_msg = heard.append
    panel.form._metres.value = 3.0
    panel._button.clicks += 1
    assert heard == [{"kind": "where", "number": 1}]
    camera = page.shown.cameras[2]
    told = {
        "kind": "where",
        "number": 1,
        "position": camera.position.tolist(),
        "rotation": camera.rotation.tolist(),
        "focal": [100, 100],
        "principal": [60, 45],
        "size": [120, 90],
        "background": [0, 0, 0],
    }
    # What makes no sense, and the answer to another question, mean nothing.
    for strange in ({**told, "number": 7}, {"kind": "where"}, {**told, "kind": "x"}):
        viewer._handle_msg(strange)
    assert work.asked == []
    viewer._handle_msg(told)
    viewer._handle_msg(told)  # once is enough
    settled(panel)
    (request,) = work.asked
    assert (request.name, request.method, request.features, request.picture) == (TESTS[0], "ours", "sift", None)
    assert (request.start.position_sigma, request.start.rotation_sigma_deg) == (3.0, 10.0)
    assert request.start.pose is not None
    np.testing.assert_allclose(request.start.pose.matrix, POSES[2].matrix, atol=1e-6)

    # The answer: facts, pictures, matches, and the cameras in the viewer and its list.
    assert "found" in facts(panel)
    assert "7 of 9" in facts(panel)
    assert "Off the scene&#x27;s pose by" in facts(panel)
    assert panel._answer._card.content.count("<img") == 2
    assert panel._answer._matches.visible
    assert [one["use"] for one in viewer.extras] == ["query", "start"]
    np.testing.assert_allclose(viewer.extras[0]["position"], camera.position, atol=1e-6)
    count = len(page.shown.cameras)
    assert f"{count + 1}: {TESTS[0]} (query)" in page._cameras._choice.options
    panel._look.clicks += 1
    assert (page.camera, viewer.camera) == (count, count)


def test_a_browser_that_says_nonsense_starts_nothing(page: ViewPage, panel: LocalizePanel, work: FakeWork) -> None:
    page._view._send_msg = lambda data: None
    panel._button.clicks += 1
    page._view._handle_msg({"kind": "where", "number": 1, "position": [1, 2, "x"]})
    assert work.asked == []


def test_other_starts_need_no_viewer(panel: LocalizePanel, work: FakeWork) -> None:
    panel.form._start.value = SENSORS
    assert not panel.form._metres.visible
    panel.begin()
    settled(panel)
    panel.form._start.value = OWN
    assert panel.form._moved.visible
    panel.form._moved.value, panel.form._turned.value = 7.0, 8.0
    panel.form._method.value = "one-shot"
    panel.form._photo.value = ("frame", UNPOSED)
    panel.begin()
    settled(panel)
    first, second = work.asked
    assert first.start.kind == "prior"
    assert (second.name, second.method, second.start.kind) == (UNPOSED, "one-shot", "own")
    assert second.features == "aliked-lightglue"  # the method's own
    assert (second.start.metres, second.start.degrees) == (7.0, 8.0)


def test_why_nothing_was_found_is_said(page: ViewPage, panel: LocalizePanel, work: FakeWork) -> None:
    work.lost = True
    panel.form._start.value = SENSORS
    panel.begin()
    settled(panel)
    assert "not found" in facts(panel)
    assert "it is dark" in facts(panel)
    assert not panel._look.visible
    assert [one["use"] for one in page._view.extras] == ["start"]


def test_what_fails_is_told_and_the_form_stays(panel: LocalizePanel, work: FakeWork) -> None:
    work.problem = StageError("The map is <b>empty</b>")
    panel.form._start.value = SENSORS
    panel.begin()
    settled(panel)
    assert "The map is &lt;b&gt;empty&lt;/b&gt;" in str(panel.task._message.object)
    assert panel.answer is None


def test_a_photo_that_was_sent_is_asked_for_and_deleted_in_the_end(
    panel: LocalizePanel, work: FakeWork, run: RunFolder
) -> None:
    panel.form._photo.value = ("file", "")
    panel.form._start.value = SENSORS
    assert panel.form.upload.visible
    panel.begin()
    assert "Choose a photo first." in said(panel)
    panel.form.upload._handle_msg({"kind": "begin", "upload": 1, "name": "C:\\my\\..\\a.jpg", "size": 3})
    panel.form.upload._handle_msg({"kind": "part", "upload": 1, "from": 0, "data": b"abc"})
    panel.begin()
    settled(panel)
    (request,) = work.asked
    assert request.name == "a.jpg"
    assert request.picture is not None
    assert request.picture.read_bytes() == b"abc"
    assert request.picture.parent == run.path.parent / ".uploads"
    panel.form.upload._handle_msg({"kind": "begin", "upload": 2, "name": "b.jpg", "size": 10**9})
    assert "expected a photo of up to 100 MB; found 1,000.0 MB" in said(panel)
    panel.leave()
    assert not request.picture.exists()


def test_earlier_results_are_listed_and_drawn(page: ViewPage, panel: LocalizePanel, run: RunFolder) -> None:
    folder = run.artifacts / "localize"
    start = POSES[0].matrix[:3].tolist()
    good = {"name": TESTS[1], "found": True, "cam_from_world": POSES[5].matrix[:3].tolist(), "start": start}
    lost = {"name": TESTS[0], "found": False, "cam_from_world": None, "reason": "black", "start": start}
    write_json(folder / "ours.sfm-test.json", {"method": "ours", "queries": [good, lost]})
    (folder / "broken.json").write_text("{")
    try:
        panel.follow(page.shown)
        assert list(panel._file.options) == ["none", "broken (damaged)", "ours.sfm-test (1 of 2 found)"]
        panel._file.value = "broken"
        assert "Cannot read" in said(panel)
        panel._file.value = "ours.sfm-test"
        assert list(panel._row.options) == ["choose one …", f"1: {TESTS[1]}", f"2: {TESTS[0]} (not found)"]
        panel._row.value = panel._row.options[f"1: {TESTS[1]}"]
        settled(panel)
        assert "found" in facts(panel)
        assert [one["use"] for one in page._view.extras] == ["query", "start"]
        assert panel.form._photo.value == ("frame", TESTS[1])
    finally:
        for file in folder.glob("*.json"):
            file.unlink()


def test_another_run_empties_the_answer(page: ViewPage, panel: LocalizePanel, work: FakeWork) -> None:
    panel.form._start.value = SENSORS
    panel.begin()
    settled(panel)
    assert panel.answer is not None
    page.selected = "20200101-000000-none-0000"
    assert panel.answer is None
    assert page._view.extras == []
    assert not panel._layout.visible


def test_an_answer_that_comes_too_late_is_not_shown(page: ViewPage, panel: LocalizePanel, work: FakeWork) -> None:
    panel.form._start.value = SENSORS
    request = panel.form.request()
    answer = work.localize(request)
    other = dataclasses.replace(page.shown, run=RunFolder(page.shown.run.path.with_name(ID)))
    panel.follow(other)
    panel._found(request, answer)
    assert panel.answer is None


def test_a_standing_that_cannot_be_is_told(page: ViewPage, panel: LocalizePanel, work: FakeWork) -> None:
    assert page.shown is not None
    camera = page.shown.cameras[0]
    standing = ViewPose(camera.position, camera.rotation, camera.focal, camera.principal, camera.size)
    # A browser may say anything of a field.
    panel.form._metres.param.update(start=None)
    panel.form._metres.value = -1.0
    panel._begin(standing)
    assert "standard deviation of the position cannot be used" in said(panel)
    assert work.asked == []
    # The photo is gone by the time the viewer answers.
    panel.form._photo.value = ("file", "")
    panel._begin(standing)
    assert work.asked == []
