"""Exercises of the notebook on surfaces."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from toolkit.teach.exercise import Outcome, exercise, hint, right
from toolkit.teach.kinds import near, number

#: An error of the disparity in pixels.
_HALF = 0.5
#: F-scores that count as one half.
_LEAST, _MOST = 0.45, 0.55
#: Millimetres at which the notebook compares first.
_FIRST = 2.0


class _Errors(Protocol):
    """As :class:`toolkit.metrics.geometry.SurfaceErrors`; thresholds in metres."""

    def f_score(self, threshold: float) -> float: ...


def _best(errors: Mapping[str, _Errors], within: float) -> tuple[str, float]:
    scores = {name: one.f_score(within / 1e3) for name, one in errors.items()}
    name = max(scores, key=lambda name: scores[name])
    return name, scores[name]


@exercise("At which threshold does the best method have an F-score of one half?", number("mm"))
def threshold(answer: float, *, errors: Mapping[str, _Errors]) -> Outcome:
    if answer <= 0:
        return hint("A threshold is a distance above 0.")
    best, score = _best(errors, answer)
    if score > _MOST:
        return hint(f"At {answer:g} mm `{best}` has {score:.0%} already: make `WITHIN` smaller.")
    if score < _LEAST:
        return hint(f"At {answer:g} mm the best one, `{best}`, has {score:.0%} only: make `WITHIN` larger.")
    first, _ = _best(errors, _FIRST)
    other = "the same" if first == best else f"`{first}`: another one"
    return right(
        f"At {answer:g} mm `{best}` is best with {score:.0%}; at {_FIRST:g} mm it is {other}. A small threshold "
        "asks who is exact where it says something, a large one who says something everywhere. So an F-score "
        "without its threshold says nothing: choose it by what the surface is for."
    )


@exercise("How wrong is depth when the disparity is wrong by half a pixel?", number("mm"))
def baseline(answer: float, *, numbers: Mapping[str, float]) -> Outcome:
    focal, base, depth = (float(numbers[name]) for name in ("f [px]", "b [mm]", "z [mm]"))
    truth = depth**2 / (focal * base) * _HALF
    if near(answer, truth, relative=0.05):
        return right(
            f"Derive z = f b / d: the error is z² / (f b) times that of the disparity, here {truth:.2f} mm for "
            f"half a pixel. With three times the baseline it is {truth / 3:.2f} mm, as long as the pictures still "
            "look alike. It grows with the square of the depth: far things are seen badly."
        )
    if near(answer, 2 * truth, relative=0.05):
        return hint("That is for a whole pixel.")
    if near(answer, truth / depth, relative=0.05):
        return hint("One factor of the depth is missing: it goes with the square.")
    disparity = focal * base / depth
    return hint(
        "From z = f b / d: what becomes of z when d changes a little?",
        f"The disparity is f b / z = {disparity:.2f} px. Half a pixel is a share of it; depth is off by as much.",
    )
