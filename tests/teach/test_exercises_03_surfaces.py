"""Exercises on surfaces: who wins at which threshold, and what half a pixel is worth."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from toolkit.teach import check, checking


@dataclass(frozen=True)
class Errors:
    """Precise in a share of the surface: rises to ``most`` within ``reach`` metres."""

    most: float
    reach: float

    def f_score(self, threshold: float) -> float:
        return self.most * min(1.0, threshold / self.reach)


# Exact in half of it, and rough in nearly all of it: they cross at 3 mm.
CROSSING = {"mvs-poisson": Errors(0.5, 0.001), "splat-mesh": Errors(1.0, 0.006)}
NUMBERS = {"f [px]": 200.0, "b [mm]": 5.0, "z [mm]": 100.0}


@pytest.fixture(autouse=True)
def _no_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checking, "_wrong", {})


def test_one_half_is_told_with_the_method_and_with_who_wins_first() -> None:
    verdict = check("surfaces.threshold", 3.2, errors=CROSSING)
    assert verdict.state == "right"
    assert "At 3.2 mm `splat-mesh` is best with 53%; at 2 mm it is `mvs-poisson`: another one" in verdict.text
    assert "at 2 mm it is the same" in check("surfaces.threshold", 1, errors=CROSSING).text


@pytest.mark.parametrize(
    ("answer", "said"),
    [(0.5, "`mvs-poisson`, has 25% only: make `WITHIN` larger"), (5, "83% already"), (-1, "above 0")],
)
def test_the_hint_says_which_way_to_go(answer: float, said: str) -> None:
    verdict = check("surfaces.threshold", answer, errors=CROSSING)
    assert verdict.state == "wrong"
    assert said in verdict.text


def test_half_a_pixel_of_disparity_is_a_share_of_the_depth() -> None:
    # 100 mm squared over 200 px times 5 mm, times half a pixel.
    verdict = check("surfaces.baseline", 5.0, numbers=NUMBERS)
    assert verdict.state == "right"
    assert "it is 1.67 mm" in verdict.text


@pytest.mark.parametrize(
    ("answer", "said"),
    [(10.0, "for a whole pixel"), (0.05, "goes with the square"), (33.0, "when d changes a little")],
)
def test_usual_mistakes_have_their_hints(answer: float, said: str) -> None:
    verdict = check("surfaces.baseline", answer, numbers=NUMBERS)
    assert verdict.state == "wrong"
    assert said in verdict.text


def test_the_last_hint_has_the_disparity() -> None:
    check("surfaces.baseline", 33.0, numbers=NUMBERS)
    assert "10.00 px" in check("surfaces.baseline", 44.0, numbers=NUMBERS).text
