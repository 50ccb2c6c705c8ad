"""Exercises of the tour."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.teach.exercise import Outcome, exercise, hint, right, untold
from toolkit.teach.kinds import choice, near, number, several

_FEWEST = 50  # matches


class Matches(Protocol):
    """A report of matching; see :class:`toolkit.matching.match.MatchReport`."""

    @property
    def pairs(self) -> NDArray[np.int64]:
        """(P, 2) indices of photos."""

    @property
    def inliers(self) -> NDArray[np.int64]:
        """(P,) verified matches."""


@exercise("Which is the first photo that shares fewer than 50 verified matches with photo 0?", number("its place"))
def reach(answer: float, *, report: Matches) -> Outcome:
    shared = {int(b): int(n) for (a, b), n in zip(report.pairs, report.inliers, strict=True) if a == 0}
    first = next((place for place in sorted(shared) if shared[place] < _FEWEST), None)
    if first is None:
        return untold(
            "In these data every photo shares 50 matches and more with photo 0: they are near each other."
        )
    if near(answer, first):
        return right(
            f"Photo {first} shares {shared[first]} matches with photo 0, photo {first - 1} still "
            f"{shared.get(first - 1, 0)}. SIFT bears a turned picture and a change of size, but not a view from "
            "another side: from there the same wall has another shape, and other walls are hidden."
        )
    place = round(answer)
    if place == 0:
        return hint("Photo 0 is the one that stays. Change the second number in `(0, 1)`.")
    if place not in shared or place != answer:
        return hint(f"Places are whole numbers from 1 to {max(shared)}; was this pair tried in step 3?")
    if shared[place] >= _FEWEST:
        return hint(
            "These two still share 50 or more. Go on.",
            f"Photo 0 and photo {place} share {shared[place]} verified matches: too many. Go on.",
        )
    return hint(
        "These two share fewer than 50. But are they the first?",
        f"Photo 0 and photo {place} share {shared[place]} verified matches. Go back one by one.",
    )


@exercise("What can pictures alone not tell, however many there are?", several("size", "place", "north", "shape"))
def gauge(answer: frozenset[str]) -> Outcome:
    if answer == {"size", "place", "north"}:
        return right(
            "Move, turn or grow the town and all cameras together, and no picture changes: 3 + 3 + 1 = 7 "
            "numbers, a similarity, just what the alignment `sim3` takes out. The shape is what pictures do "
            "tell."
        )
    if "shape" in answer:
        return hint(
            "Look at step 4: there were no sensors. Are the houses of the town at their places among each other?"
        )
    if "size" not in answer:
        return hint(
            "Could the photos be of a model of the town, taken by a tiny camera?", "One more: think of a model."
        )
    return hint(
        "Put the whole town on another island. Would a photo look different?",
        "Two of the alignment's parts are a shift and a turn. What do they stand for?",
    )


@exercise(
    "All GPS positions are 10 m too far east: after which alignment does POS notice?", choice("none", "se3", "sim3")
)
def bias(answer: str) -> Outcome:
    if answer == "none":
        return right(
            "A shift of all cameras is just what `se3` and `sim3` take out before they measure. So an aligned "
            "POS, as the paper's, never tells a constant error of GPS. Neither do the pictures: they do not "
            "know the place."
        )
    return hint(
        "What does this alignment do first, before it measures?",
        "Run it: `SENSORS` in step 1, then steps 2, 3, 5 and 6. Which POS of the row `sensors` grows by metres?",
    )


@exercise("How many pairs did step 3 try?", number("pairs"))
def pairs(answer: float, *, photos: int) -> Outcome:
    truth = photos * (photos - 1) // 2
    if near(answer, truth, relative=0, absolute=0.5):
        return right(
            f"{photos} photos make {photos}·{photos - 1}/2 = {truth} pairs. They grow with the square: "
            "ten times the photos are a hundred times the pairs."
        )
    if near(answer, 2 * truth):
        return hint("This counts each pair twice: (a, b) and (b, a) are the same pair.")
    if near(answer, photos**2) or near(answer, photos**2 / 2):
        return hint("Nearly: is a photo matched with itself?")
    return hint(
        "How many partners does one photo have? And how many photos are there?",
        f"Each of the {photos} photos has {photos - 1} partners. Now mind that a pair has two ends.",
    )


@exercise("By how many decibels does PSNR rise when the error is halved in every pixel?", number("dB"))
def decibels(answer: float) -> Outcome:
    truth = 20 * math.log10(2)
    if near(answer, truth, absolute=0.1):
        return right(
            "10·log10(4) = 6.02 dB: half the error is a quarter of its square. So the 6.5 dB between COLMAP and "
            "sensors in the paper are errors about twice as large."
        )
    if near(answer, truth / 2, absolute=0.1):
        return hint("MSE is the mean of the *squared* error. Half the error is which part of the square?")
    if near(answer, -truth, absolute=0.1):
        return hint("The size is right. Does PSNR grow or fall when the error gets smaller?")
    if near(answer, math.log(4), absolute=0.05) or near(answer, 10 * math.log(4), absolute=0.1):
        return hint("The logarithm of PSNR is that to the base 10: `numpy.log10`.")
    return hint(
        "Write PSNR for MSE and for MSE/4, and take the difference.",
        "10·log10(4/MSE) - 10·log10(1/MSE): what is left when MSE cancels?",
    )
