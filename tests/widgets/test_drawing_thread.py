"""Pictures in the background: the last question counts, coarse first, whole when nothing moves."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any, cast

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.runs.view_render import ViewPose
from toolkit.runs.view_scene import ViewScene
from toolkit.widgets.drawing_thread import DrawingThread, Drawn, Wanted

# The thread never looks into it.
VIEW = cast(ViewScene, None)
PATIENCE = 10.0


def pose(x: float = 0.0) -> ViewPose:
    return ViewPose(np.array([x, 0, 0]), np.array([1.0, 0, 0, 0]), (100, 100), (50, 40), (100, 80))


class Studio:
    """A drawing thread with all that it drew and sent."""

    def __init__(self, **options: Any) -> None:
        self.drawn: list[ViewPose] = []
        self.sent: list[Drawn] = []
        self.failed: list[str] = []
        self.may_draw = threading.Event()
        self.may_draw.set()
        self.changed = threading.Condition()
        self.thread = DrawingThread(self._draw, self._send, self._fail, **options)

    def _draw(self, view: ViewScene, pose: ViewPose) -> bytes:
        with self.changed:
            self.drawn.append(pose)
            self.changed.notify_all()
        assert self.may_draw.wait(PATIENCE)
        if pose.position[0] < 0:
            raise DataError("Nothing is there")
        return repr(pose.size).encode()

    def _send(self, drawn: Drawn) -> None:
        with self.changed:
            self.sent.append(drawn)
            self.changed.notify_all()
        self.thread.shown(drawn.number)

    def _fail(self, text: str) -> None:
        with self.changed:
            self.failed.append(text)
            self.changed.notify_all()

    def wait(self, drawn: int = 0, sent: int = 0, failed: int = 0) -> None:
        with self.changed:
            assert self.changed.wait_for(
                lambda: len(self.drawn) >= drawn and len(self.sent) >= sent and len(self.failed) >= failed, PATIENCE
            )


@pytest.fixture
def studio() -> Iterator[Studio]:
    made = Studio(settle=0.05)
    yield made
    made.may_draw.set()
    made.thread.close(PATIENCE)


def test_a_coarse_picture_comes_first_and_a_whole_one_when_nothing_moves(studio: Studio) -> None:
    studio.thread.ask(Wanted(1, VIEW, pose()))
    studio.wait(sent=2)
    assert [(one.number, one.whole) for one in studio.sent] == [(1, False), (1, True)]
    assert studio.drawn[0].size == (50, 40)
    assert studio.sent[1].data == b"(100, 80)"


def test_questions_that_came_meanwhile_are_answered_by_one_picture(studio: Studio) -> None:
    studio.may_draw.clear()
    studio.thread.ask(Wanted(1, VIEW, pose(1)))
    studio.wait(drawn=1)
    for number in range(2, 30):
        studio.thread.ask(Wanted(number, VIEW, pose(number)))
    studio.may_draw.set()
    studio.wait(sent=3)
    assert [(one.number, one.whole) for one in studio.sent] == [(1, False), (29, False), (29, True)]


def test_pictures_that_come_quickly_are_made_finer(studio: Studio) -> None:
    for number in range(1, 8):
        studio.thread.ask(Wanted(number, VIEW, pose(number)))
        studio.wait(sent=number)
        studio.sent[:] = [one for one in studio.sent if not one.whole]
    sizes = [one.size for one in studio.drawn if one.size != (100, 80)]
    assert sizes[0] == (50, 40)
    assert sizes[-1] == (70, 56)  # the finest that is tried while a person moves


def test_the_next_picture_waits_until_the_browser_shows_the_last_one(monkeypatch: pytest.MonkeyPatch) -> None:
    studio = Studio(settle=0.01, patience=PATIENCE)
    monkeypatch.setattr(studio.thread, "shown", lambda number: None)
    studio.thread.ask(Wanted(1, VIEW, pose()))
    studio.wait(sent=1)
    time.sleep(0.1)
    assert len(studio.sent) == 1
    DrawingThread.shown(studio.thread, 1)
    studio.wait(sent=2)
    DrawingThread.shown(studio.thread, 1)
    studio.thread.close(PATIENCE)


def test_a_failure_is_told_and_the_next_picture_is_made(studio: Studio) -> None:
    studio.thread.ask(Wanted(1, VIEW, pose(-1)))
    studio.wait(failed=2)
    assert set(studio.failed) == {"Nothing is there."}
    studio.thread.ask(Wanted(2, VIEW, pose(1)))
    studio.wait(sent=1)


def test_the_thread_ends_when_nobody_asks_and_begins_again() -> None:
    studio = Studio(settle=0.01, idle=0.05)
    studio.thread.ask(Wanted(1, VIEW, pose()))
    first = studio.thread._thread
    assert first is not None
    first.join(PATIENCE)
    assert not first.is_alive()
    assert len(studio.sent) == 2
    studio.thread.ask(Wanted(2, VIEW, pose()))
    studio.wait(sent=4)
    studio.thread.close(PATIENCE)


def test_a_closed_thread_draws_no_more(studio: Studio) -> None:
    studio.thread.close(PATIENCE)
    studio.thread.ask(Wanted(1, VIEW, pose()))
    time.sleep(0.05)
    assert studio.drawn == []
