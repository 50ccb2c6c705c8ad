"""Exercises of the notebook on blades (SfM for avionics inspection videos)."""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.teach.exercise import Outcome, exercise, hint, right, untold
from toolkit.teach.kinds import near as close_to
from toolkit.teach.kinds import number, numbers

_OFF = 0.05  # degrees a step, in the question


class Arc(Protocol):
    """An arc that was found; see :class:`toolkit.poses.arc_sigma.ArcSigma`."""

    @property
    def arc_degrees(self) -> float:
        """Degrees."""

    @property
    def sigma(self) -> float | None:
        """Its standard deviation."""


@exercise("After how many frames is a blade where the last one was?", number("frames"))
def pitch(answer: float, *, blades: int, step: float) -> Outcome:
    truth = 360 / blades / step
    if close_to(answer, truth, relative=0.01):
        return right(
            f"{blades} blades are {360 / blades:g} degrees apart, a frame turns by {step:g}: {truth:g} frames. "
            f"So the second bright stripe lies {truth:g} frames beside the diagonal, the third {2 * truth:g}: "
            "each is the same picture, and another blade."
        )
    if close_to(answer, 360 / blades, relative=0.01):
        return hint("These are the degrees between two blades. How many frames is that?")
    if close_to(answer, 360 / step, relative=0.01):
        return hint("After so many frames the rotor has gone around once. A blade has a neighbour sooner.")
    if close_to(answer, 2 * truth) or close_to(answer, 3 * truth):
        return hint("This is a stripe, but not the first one beside the diagonal.")
    return hint(
        "How far from the diagonal is the next bright stripe?",
        f"There are {blades} blades on 360 degrees, and a frame turns by {step:g} degrees.",
    )


@exercise("How wide may the window be before the first wrong pair comes in?", number("frames"))
def window(answer: float, *, wrong: NDArray[np.int64], settings: Any) -> Outcome:
    if not len(wrong):
        return untold(
            f"With `near={settings.near}` the detector finds no wrong pair at all: set it to 2 or 3, run it again."
        )
    first = int(np.abs(np.diff(wrong, axis=1)).min())
    if close_to(answer, first - 1):
        return right(
            f"With {first - 1} frames there is none, with {first} the first. About half a blade is the limit: "
            "from there on the next blade is nearer to the place of this one than it is itself. A narrower "
            "window costs nothing but tracks that end sooner; a wider one costs the arc."
        )
    if close_to(answer, first):
        return hint("Just one too many: at this one the title already counts a wrong pair.")
    if answer > first:
        return hint(
            "The title still counts wrong pairs there. Go further back.",
            f"Between {max(1, first // 2)} and {first + 2}: go frame by frame.",
        )
    return hint("There is none yet with this one. Can it be wider?", "Go up frame by frame and watch the title.")


@exercise("With `near` a whole blade: how many wrong pairs does the detector find?", number("pairs"))
def near(answer: float, *, wrong: NDArray[np.int64], settings: Any, pitch: float) -> Outcome:
    if settings.near < math.floor(pitch + 1e-6):
        return untold(
            f"`near` is {settings.near} frames, less than the {pitch:g} of a blade. Change it in this cell, "
            "look at the picture, and answer then."
        )
    if close_to(answer, len(wrong), relative=0, absolute=0.5):
        return right(
            f"{len(wrong)}. Pairs up to `near` are believed: the chain is made of them. Now pairs a blade "
            "apart, which say that nothing moved, are in the chain, and what is judged by it agrees with the "
            "wrong ones as well as with the right ones. A witness may not be one of the accused."
        )
    return hint(
        "The title of the picture counts them, once the slider stands at its right end.", "`len(wrong.wrong)`."
    )


@exercise("By how many of its own sigmas is the arc of SIMPLE_RADIAL wrong?", number("sigmas"))
def sigma(answer: float, *, arc: Arc | None, truth: float | None) -> Outcome:
    if arc is None or arc.sigma is None or truth is None:
        return untold(
            "These data do not tell: SIMPLE_RADIAL has no arc with a sigma, or the true arc is not known."
        )
    missed = arc.arc_degrees - truth
    times = abs(missed) / arc.sigma
    if close_to(abs(answer), times, relative=0.03, absolute=0.1):
        judged = (
            "Three would be rare. The sigma asks how far noise could move this model, and believes the model "
            "itself. That one coefficient cannot bend like this lens is no noise: it is alike in all frames, "
            "and no sigma knows of it."
            if times > 3
            else "That is what noise does: over so short an arc one coefficient still follows the lens. Over 98 "
            "degrees it is 22 degrees off with a sigma of 0.9: what all frames have in common is no noise, and no "
            "sigma knows of it."
        )
        return right(f"|{arc.arc_degrees:.2f} - {truth:.2f}| / {arc.sigma:.2f} = {times:.1f}. {judged}")
    if close_to(abs(answer), abs(missed), absolute=0.02):
        return hint("These are degrees. How often does sigma go into them?")
    if close_to(answer, arc.arc_degrees / arc.sigma, relative=0.02):
        return hint("This is how far the arc is from nothing. How far is it from the truth?")
    return hint(
        "Take the column SIMPLE_RADIAL: its arc less the true one, by its sigma.",
        f"arc = {arc.arc_degrees:.3f}, truth = {truth:.3f}, sigma = {arc.sigma:.3f}.",
    )


@exercise(
    f"Each step is off by {_OFF} degrees: how far off is the end, if errors are independent, and if they are "
    "alike?",
    numbers("independent", "alike"),
)
def drift(answer: dict[str, float], *, frames: int) -> Outcome:
    steps = frames - 1
    alone, alike = _OFF * math.sqrt(steps), _OFF * steps
    # Who counts frames in place of steps has understood.
    good = {"independent": alone, "alike": alike}
    fits = {name: close_to(abs(answer[name]), value, relative=0.03) for name, value in good.items()}
    if all(fits.values()):
        return right(
            f"{_OFF}·sqrt({steps}) = {alone:.2f} and {_OFF}·{steps} = {alike:.2f} degrees. A wrong lens is "
            "alike in all frames, so it makes the second; a ring without a known end cannot tell it from a "
            "rotor of another size. What helps is to know that the footage goes around once."
        )
    if close_to(answer["independent"], alike, relative=0.03) and close_to(answer["alike"], alone, relative=0.03):
        return hint("You have both, the other way round: which errors cancel each other?")
    if not fits["alike"]:
        return hint("Begin with *alike*: each step adds the same.", f"There are {steps} steps.")
    return hint(
        "*alike* is right. Independent errors cancel each other in part: it is their squares that add up.",
        f"The sum of {steps} squares, and then the root.",
    )
