"""Exercises on localisation: the right answer follows from the reader's own searches."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from toolkit.teach import check, checking

OFF = {"judge.min_inliers": 6, "judge.min_likeness": -1.0}


@dataclass(frozen=True)
class Errors:
    """Some of four queries were found."""

    found: int
    names: tuple[str, ...] = ("a", "b", "c", "d")


FAR = {20.0: Errors(4), 40.0: Errors(2), 80.0: Errors(1), 160.0: Errors(0)}


def answers(**believed: bool) -> dict[str, SimpleNamespace]:
    return {kind: SimpleNamespace(found=(False, yes)) for kind, yes in believed.items()}


@pytest.fixture(autouse=True)
def _no_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checking, "_wrong", {})


def test_lost_is_where_fewer_than_half_are_found_for_the_first_time() -> None:
    verdict = check("localization.lost", 80, errors=FAR)
    assert verdict.state == "right"
    assert "1 of 4" in verdict.text


@pytest.mark.parametrize(
    ("answer", "said"),
    [(40, "2 of 4 are found: that is still half"), (160, "smallest such offset"), (60, "none of your offsets")],
)
def test_each_other_offset_has_its_hint(answer: float, said: str) -> None:
    verdict = check("localization.lost", answer, errors=FAR)
    assert verdict.state == "wrong"
    assert said in verdict.text


def test_while_everything_is_found_the_exercise_asks_to_look_farther() -> None:
    verdict = check("localization.lost", 30, errors={0.0: Errors(4), 30.0: Errors(3)})
    assert verdict.state == "open"
    assert "Look farther: `OFFSETS = (" in verdict.text


def test_what_is_believed_is_read_from_the_readers_own_answers() -> None:
    seen = answers(black=False, blurred=True, town=True, fields=False)
    assert check("localization.believed", ["town", "blurred"], answers=seen, changed=OFF).state == "right"
    assert "at least one more kind" in check("localization.believed", ["town"], answers=seen, changed=OFF).text
    too_many = check("localization.believed", ["town", "blurred", "black"], answers=seen, changed=OFF)
    assert too_many.state == "wrong"
    assert 'lines of "black"' in too_many.text


def test_nothing_believed_may_be_right_too() -> None:
    none = answers(black=False, blurred=False, town=False, fields=False)
    verdict = check("localization.believed", [], answers=none, changed=OFF)
    assert verdict.state == "right"
    assert verdict.text.startswith("None, even so")


def test_with_the_judge_on_nothing_can_be_said() -> None:
    seen = answers(black=False, blurred=False, town=False, fields=False)
    verdict = check("localization.believed", [], answers=seen, changed={})
    assert verdict.state == "open"
    assert "judge is still on" in verdict.text


def test_a_shift_of_the_whole_map_is_seen_by_no_residual() -> None:
    assert check("localization.shifted", {"metres": 0.3, "pixels": 0}, shift=0.3).state == "right"


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ({"metres": 0.3, "pixels": 2}, "move camera and points together"),
        ({"metres": 0.0, "pixels": 0}, "The residuals are right"),
        ({"metres": 1.0, "pixels": 5}, "if all have moved"),
    ],
)
def test_each_half_of_the_answer_is_judged(answer: dict[str, float], said: str) -> None:
    verdict = check("localization.shifted", answer, shift=0.3)
    assert verdict.state == "wrong"
    assert said in verdict.text
