"""Progress: the events that listeners get, and cancelling through them."""

from __future__ import annotations

import io
from collections.abc import Iterator

import pytest

from toolkit.errors import Cancelled
from toolkit.progress import CancelToken, ProgressEvent, TqdmProgress, fan_out, silent, track


def test_track_tells_before_the_first_item_and_after_each() -> None:
    seen: list[ProgressEvent | str] = []
    for item in track(["a", "b"], "stage.step", seen.append):
        seen.append(item)
    assert seen == [
        ProgressEvent("stage.step", 0, 2),
        "a",
        ProgressEvent("stage.step", 1, 2),
        "b",
        ProgressEvent("stage.step", 2, 2),
    ]


def test_track_of_nothing_tells_that_nothing_is_to_be_done() -> None:
    events: list[ProgressEvent] = []
    assert list(track([], "stage", events.append)) == []
    assert events == [ProgressEvent("stage", 0, 0)]


def test_track_takes_items_one_by_one_and_the_total_from_the_caller() -> None:
    taken: list[int] = []

    def items() -> Iterator[int]:
        for i in range(3):
            taken.append(i)
            yield i

    events: list[ProgressEvent] = []
    tracked = track(items(), "stage", events.append, total=3)
    assert next(tracked) == 0
    assert taken == [0]
    assert events == [ProgressEvent("stage", 0, 3)]


def test_total_of_an_iterator_is_unknown() -> None:
    events: list[ProgressEvent] = []
    list(track(iter([1]), "stage", events.append))
    assert [event.total for event in events] == [None, None]


def test_fan_out_tells_every_listener_in_order() -> None:
    heard: list[tuple[str, int]] = []
    tell = fan_out([lambda event: heard.append(("a", event.done)), lambda event: heard.append(("b", event.done))])
    tell(ProgressEvent("stage", 4))
    tell(ProgressEvent("stage", 5))
    assert heard == [("a", 4), ("b", 4), ("a", 5), ("b", 5)]


def test_cancel_token_stops_the_work_at_its_next_event() -> None:
    token = CancelToken()
    done: list[int] = []

    def work() -> None:
        for item in track(range(10), "sfm.match", token):
            done.append(item)
            if item == 2:
                token.cancel()

    with pytest.raises(Cancelled, match=r"^Cancelled in stage sfm\.match at 3 of 10\.$"):
        work()
    assert done == [0, 1, 2]


def test_cancel_without_a_known_total() -> None:
    token = CancelToken()
    token(ProgressEvent("train", 7))
    token.cancel()
    with pytest.raises(Cancelled, match=r"^Cancelled in stage train at 8 of \?\.$"):
        token(ProgressEvent("train", 8))


def test_cancelling_by_one_listener_keeps_the_event_from_those_after_it() -> None:
    token, heard = CancelToken(), []
    token.cancel()
    with pytest.raises(Cancelled):
        fan_out([token, heard.append])(ProgressEvent("stage", 1))
    assert heard == []


def test_silent_takes_any_event() -> None:
    assert list(track(range(3), "stage", silent)) == [0, 1, 2]


def test_tqdm_writes_each_stage_as_a_bar_to_the_given_file_only(capsys: pytest.CaptureFixture[str]) -> None:
    file = io.StringIO()
    progress = TqdmProgress(file)
    progress(ProgressEvent("sfm.extract", 0, 2))
    progress(ProgressEvent("sfm.extract", 2, 2, "second picture"))
    progress(ProgressEvent("train", 0, 100))
    progress(ProgressEvent("train", 50, 100, values={"loss": 0.123456}))
    progress.close()
    text = file.getvalue()
    assert "sfm.extract: 100%" in text
    assert "2/2" in text
    assert "second picture" in text
    assert "train:  50%" in text
    assert "loss=0.1235" in text
    assert capsys.readouterr() == ("", "")


def test_tqdm_shows_a_stage_of_unknown_length_and_a_total_that_comes_late() -> None:
    file = io.StringIO()
    progress = TqdmProgress(file)
    progress(ProgressEvent("read", 3))
    progress(ProgressEvent("read", 4, 8))
    progress.close()
    assert "4/8" in file.getvalue()


def test_tqdm_follows_a_stage_that_starts_again() -> None:
    file = io.StringIO()
    progress = TqdmProgress(file)
    progress(ProgressEvent("search", 9, 10))
    progress(ProgressEvent("search", 2, 10))
    progress.close()
    assert file.getvalue().rstrip().split("search:")[-1].lstrip().startswith("20%")


def test_tqdm_closes_without_having_shown_anything() -> None:
    file = io.StringIO()
    TqdmProgress(file).close()
    assert file.getvalue() == ""


def test_tqdm_writes_to_the_standard_error_where_no_file_is_given(capsys: pytest.CaptureFixture[str]) -> None:
    progress = TqdmProgress()
    progress(ProgressEvent("stage", 1, 1))
    progress.close()
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "stage: 100%" in captured.err
