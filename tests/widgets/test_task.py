"""Work in a thread: how far it is, its end, and its errors are told."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
from page_parts import endless, press, said, working

from toolkit.errors import Cancelled, DataError
from toolkit.progress import Progress
from toolkit.widgets.task import Task, cancel_all


def test_a_task_tells_how_far_it_is_and_can_be_cancelled() -> None:
    task, taken = Task(), list[str]()
    task.begin("Working", endless, taken.append)
    time.sleep(0.05)
    task.look()
    assert "Working 0 %" in said(task)
    assert "&lt;i&gt;" in said(task)
    assert "<progress" in said(task)
    press(task, "Cancel")
    working(task)
    assert "Working: cancelled." in said(task)
    assert "<progress" not in said(task)
    assert taken == []


def test_what_is_begun_anew_ends_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    task, taken, ended = Task(), list[str](), list[str]()

    def first(progress: Progress) -> str:
        try:
            return endless(progress)
        except Cancelled:
            ended.append("first")
            raise

    task.begin("First", first, taken.append)
    task.begin("Second", lambda progress: "second", taken.append)
    working(task)
    assert taken == ["second"]
    for _ in range(400):
        if ended:
            break
        time.sleep(0.01)
    assert ended == ["first"]
    assert "cancelled" not in said(task)


@pytest.mark.parametrize("error", [DataError("It is damaged", todo="Mend it"), OSError("no disk")])
def test_errors_stay_readable(error: Exception) -> None:
    task: Task = Task()
    called: list[Callable[[], None]] = []

    def fail(progress: Progress) -> Callable[[], None]:
        raise error

    task.begin("Working", fail, called.append)
    working(task)
    assert str(error) in said(task)
    assert called == []
    task.begin("Again", lambda progress: "fine", lambda made: None)
    working(task)
    assert str(error) not in said(task)


def test_a_server_that_stops_ends_what_works() -> None:
    task, taken = Task(), list[str]()
    task.begin("Working", endless, taken.append)
    cancel_all()
    working(task)
    assert "Working: cancelled." in said(task)
    assert taken == []
