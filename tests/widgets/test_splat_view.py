"""What a browser can have of a run through the viewers: the open splat, pictures of it, and nothing else."""

from __future__ import annotations

import io
import threading
from typing import Any

import numpy as np
import pytest
from fake_recipe import MakeRun
from PIL import Image
from splat_runs import splat_run

from toolkit.runs.view_render import ViewPose, packed_splat, render_view
from toolkit.runs.view_scene import ViewScene, ViewSplat, read_view
from toolkit.runs.view_work import ViewWork
from toolkit.widgets import splat_view
from toolkit.widgets.splat_view import SplatView
from toolkit.widgets.stream_view import StreamView

__all__ = ["splat_run"]


@pytest.fixture
def splat(splat_run: MakeRun) -> ViewSplat:
    return read_view(splat_run(name="balls"))


@pytest.fixture
def view(splat: ViewSplat) -> ViewScene:
    return splat.scene


class HeardSplat(SplatView):
    """With all that the browser would have heard."""

    def __init__(self) -> None:
        super().__init__()
        self.heard: list[dict[str, Any]] = []

    def _send_msg(self, data: Any) -> None:
        self.heard.append(data)


def asked(viewer: HeardSplat, **message: Any) -> list[dict[str, Any]]:
    viewer.heard.clear()
    viewer._handle_msg({"kind": "part", "splat": viewer.scene.get("splat"), "number": 0} | message)
    return viewer.heard


def test_the_parts_make_up_the_splat(splat: ViewSplat, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(splat_view, "PART", 1000)
    viewer, packed = HeardSplat(), packed_splat(splat)
    viewer.show_view(splat.scene, packed)
    assert viewer.scene["parts"] == -(-len(packed) // 1000) > 3
    got = [asked(viewer, number=number)[0]["data"] for number in range(viewer.scene["parts"])]
    assert b"".join(got) == packed
    assert viewer.scene["count"] == 300
    assert [camera["use"] for camera in viewer.scene["cameras"]].count("test") == 2


def test_nothing_but_the_open_splat_is_sent(view: ViewScene) -> None:
    viewer = HeardSplat()
    assert asked(viewer, splat=1) == []
    viewer.show_view(view, b"12345")
    assert asked(viewer) == [{"kind": "part", "splat": viewer.scene["splat"], "number": 0, "data": b"12345"}]
    strange = ("../run.json", -1, 1, 10**9, None, [0], 0.0)
    assert [asked(viewer, number=number) for number in strange] == [[]] * len(strange)
    assert asked(viewer, kind="file", path="/etc/passwd") == []
    viewer._handle_msg("part")
    viewer._handle_msg(None)
    assert viewer.heard == []
    before = viewer.scene["splat"]
    viewer.show_view(view, b"678")
    assert asked(viewer, splat=before) == []
    viewer.clear("wait")
    assert asked(viewer, splat=before) == []
    assert (viewer.scene, viewer.status) == ({}, "wait")


class HeardStream(StreamView):
    """With all that the browser would have heard; it shows each picture at once."""

    def __init__(self) -> None:
        super().__init__(ViewWork())
        self.heard: list[dict[str, Any]] = []
        self.whole = threading.Event()

    def _send_msg(self, data: Any) -> None:
        self.heard.append(data)
        self._handle_msg({"kind": "shown", "number": data["number"]})
        if data["whole"]:
            self.whole.set()


def question(view: ViewScene) -> dict[str, Any]:
    camera = view.cameras[0]
    return {
        "kind": "view",
        "number": 1,
        "position": camera.position.tolist(),
        "rotation": camera.rotation.tolist(),
        "focal": [120, 120],
        "principal": [72, 48],
        "size": [144, 96],
        "background": [0, 0, 0],
    }


def test_pictures_are_those_of_the_rasterizer(splat: ViewSplat) -> None:
    viewer, view = HeardStream(), splat.scene
    viewer.show_view(view)
    viewer._handle_msg(question(view))
    assert viewer.whole.wait(60)
    viewer.close(10)
    coarse, whole = (Image.open(io.BytesIO(one["data"])) for one in viewer.heard)
    assert whole.size == (144, 96)
    assert coarse.width < 144
    wanted = render_view(splat, ViewPose.from_message(question(view)))
    assert wanted.max() > 150
    # JPEG of quality 88.
    assert np.abs(np.asarray(whole).astype(int) - wanted).mean() < 3
    assert viewer.problem == ""


def test_a_question_that_makes_no_sense_is_told(view: ViewScene) -> None:
    viewer = HeardStream()
    viewer._handle_msg(question(view))  # nothing is open
    viewer.show_view(view)
    viewer._handle_msg(question(view) | {"size": [10**6, 10**6]})
    assert viewer.problem.startswith("The view's size cannot be used; expected 2 numbers from 16 to 1600")
    for strange in (
        None,
        "view",
        {"kind": "view"},
        {"kind": "shown", "number": "x"},
        {"kind": "file", "number": 1},
    ):
        viewer._handle_msg(strange)
    viewer.close(10)
    assert viewer.heard == []
