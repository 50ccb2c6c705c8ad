"""Exercises on satellites: views chosen by hand, and which of two errors says what."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from toolkit.teach import check, checking

# Six views 25 degrees aside, evenly around, and two nearly overhead.
AROUND = np.radians(np.arange(0, 360, 60))
ASIDE = np.radians([25.0] * 6 + [2.0, 4.0])
TURN = np.concatenate([AROUND, [0.1, 0.2]])
VIEWS = np.stack([np.sin(ASIDE) * np.sin(TURN), np.sin(ASIDE) * np.cos(TURN), np.cos(ASIDE)], axis=1)


def determinant(chosen: list[int]) -> float:
    return float(np.linalg.det(VIEWS[chosen].T @ VIEWS[chosen]))


LARGEST = max(determinant([0, 1, 3, 4]), determinant([0, 2, 4, 5]))


@pytest.fixture(autouse=True)
def _no_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checking, "_wrong", {})


def test_views_to_all_sides_are_well_chosen() -> None:
    verdict = check("satellite.by_hand", [0, 2, 4, 5], directions=VIEWS, count=4, largest=LARGEST)
    assert verdict.state == "right"
    assert "of the largest determinant" in verdict.text


@pytest.mark.parametrize("answer", [(5, 4, 2, 0), {0, 2, 4, 5}, np.array([0, 2, 4, 5])])
def test_order_and_kind_of_list_do_not_matter(answer: object) -> None:
    assert check("satellite.by_hand", answer, directions=VIEWS, count=4, largest=LARGEST).state == "right"


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ([0, 6, 7, 1], "Views 6 and 7 are only 2° apart"),
        ([0, 1, 2, 3], "do they go to all sides"),
        ([0, 2, 3], "4 different views are asked for; these are 3"),
        ([0, 2, 3, 3], "these are 3"),
        ([0, 2, 3, 8], "counted from 0 to 7"),
        ("0, 2, 4, 5", "A list is asked for"),
        ([0.5, 2, 3, 5], "whole numbers"),
    ],
)
def test_other_choices_get_a_hint(answer: object, said: str) -> None:
    verdict = check("satellite.by_hand", answer, directions=VIEWS, count=4, largest=LARGEST)
    assert verdict.state == "wrong"
    assert said in verdict.text


def errors(mean: float, median: float) -> SimpleNamespace:
    return SimpleNamespace(mean_absolute=mean, median_absolute=median)


def test_the_median_is_judged_at_the_largest_number_of_views() -> None:
    few = errors(9.0, 0.01)
    wrong = {
        "most spread": {2: errors(9.0, 9.0), 8: errors(1.6, 0.08)},
        "least spread": {2: few, 8: errors(1.2, 0.09)},
        "random": {2: errors(9.0, 9.0), 8: errors(1.3, 0.10)},
    }
    verdict = check("satellite.median", "Most spread", errors=wrong)
    assert verdict.state == "right"
    assert 'by the mean "least spread" is best, with 1.20 m' in verdict.text
    verdict = check("satellite.median", "least spread", errors=wrong)
    assert verdict.state == "wrong"
    assert "`one.median_absolute`" in verdict.text


def test_ways_that_chose_the_same_views_are_all_right() -> None:
    same = {8: errors(1.0, 0.1)}
    verdict = check("satellite.median", "random", errors={"most spread": same, "random": same})
    assert verdict.state == "right"
    assert "by the mean the same way is best" in verdict.text
