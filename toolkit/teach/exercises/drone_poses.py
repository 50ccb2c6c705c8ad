"""Exercises of the notebook on poses of a drone (A-3DGS)."""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np

from toolkit.teach.exercise import Outcome, exercise, hint, right, untold
from toolkit.teach.kinds import choice, near, number, several

# A-3DGS, Table 3, seconds.
_POSES, _SCENE, _TOTAL = 29 * 60 + 10, 30 * 60 + 30, 59 * 60 + 41
_SENSOR_SCENE, _SENSOR_TOTAL = 17 * 60 + 12, 17 * 60 + 43

_MAXWELL = 2 * math.sqrt(2 / math.pi)  # mean length of three errors of sigma 1
_SIGMA = 3.0  # metres, in the question
_TIGHT = 3.0  # pixels, in the question


class Estimated(Protocol):
    """A constant error that was found; see :class:`toolkit.poses.sensor_biases.Estimate`."""

    @property
    def value(self) -> float | None:
        """Degrees."""

    @property
    def sigma(self) -> float | None:
        """Its standard deviation."""


@exercise("If poses cost nothing at all, how many times as fast would COLMAP + 3DGS be?", number("times"))
def amdahl(answer: float) -> Outcome:
    if near(answer, _TOTAL / _SCENE, absolute=0.06):
        return right(
            f"59:41 / 30:30 = {_TOTAL / _SCENE:.2f}: what is left bounds the gain (Amdahl's law). Sensor-DPT is "
            f"{_TOTAL / _SENSOR_TOTAL:.2f} times as fast, more than that: its training, too, is shorter "
            f"({_SCENE / _SENSOR_SCENE:.1f} times), with fewer Gaussians, and that costs quality."
        )
    if near(answer, _TOTAL / _SENSOR_TOTAL, absolute=0.06):
        return hint(
            "This is the gain of Sensor-DPT. But its training is another one, too: leave COLMAP's as it is."
        )
    if near(answer, _POSES / _TOTAL, absolute=0.02) or near(answer, 100 * _POSES / _TOTAL, absolute=2):
        return hint("This is the share of poses in the time. If it goes, how much is left of the whole?")
    if near(answer, _SCENE / _TOTAL, absolute=0.01):
        return hint("This is what is left of the time. The gain is how often it goes into the whole.")
    return hint(
        "Take the bar of COLMAP + 3DGS. What is left when the part for poses is gone?",
        "The gain is the whole time by what is left: 59:41 by the part for the scene.",
    )


@exercise(f"Which POS is to be expected from a GPS with {_SIGMA:g} m on each axis?", number("m"))
def expected(answer: float, *, photos: int) -> Outcome:
    free = math.sqrt(max(0.0, 1 - 7 / (3 * photos)))
    truth = _MAXWELL * _SIGMA * free
    if near(answer, truth, relative=0.015):
        return right(
            f"1.6 · 3 m · sqrt(1 - 7/{3 * photos}) = {truth:.2f} m. One flight scatters around it: now set the "
            "GPS slider to 3 and compare what is measured with what is expected, in the title of the map."
        )
    if near(answer, _SIGMA):
        return hint("This is sigma of one axis. An error has three: how long is it on average?")
    if near(answer, math.sqrt(3) * _SIGMA):
        return hint("This is the root mean square of the length, ATE without alignment. POS is the mean length.")
    if near(answer, _MAXWELL * _SIGMA, relative=0.003):
        return hint("Right before the alignment. Which part of the numbers does the alignment use up?")
    return hint(
        "The formula is above: 1.6 sigma, and what the alignment uses up. What is n here?",
        f"There are n = {photos} photos; 7 of 3n numbers go into the alignment.",
    )


@exercise("Which sliders do POS and ATE not feel at all?", several("GPS sigma", "heading bias", "gimbal sigma"))
def blind(answer: frozenset[str]) -> Outcome:
    if answer == {"heading bias", "gimbal sigma"}:
        return right(
            "POS and ATE look at positions only. A camera may look anywhere and they stay perfect; so always "
            "give ROT, too. The reverse does not hold: noise of GPS turns the alignment a little, and ROT "
            "feels that."
        )
    if "GPS sigma" in answer:
        return hint("Move it from 1.5 to 10: does the number behind POS really stand still?")
    return hint(
        "Go through the sliders once more, one at a time, and watch POS alone.",
        "Which of the three numbers of a slider's name are positions, and which are angles?",
    )


@exercise(f"How many points of matches are there when rays may miss by {_TIGHT:g} px only?", number("points"))
def tight(answer: float, *, settings: Any, points: Any) -> Outcome:
    allowed = settings.triangulation.max_error
    if allowed != _TIGHT:
        return untold(
            f"Rays may still miss each other by {allowed:g} px. Change it to `{_TIGHT}`, look at the panels, "
            "and answer then."
        )
    if near(answer, len(points), relative=0.01, absolute=0.5):
        views = np.bincount(points.tracks.point)
        return right(
            f"{len(points)}: not fewer to speak of. But {100 * np.mean(views == 2):.0f} % of them are seen by "
            "two photos only (mind the panel: they lie anywhere in height). Two rays nearly always meet "
            "somewhere; it takes a third one to object, and it was cut off. So trust the length of tracks "
            "more than the number of points, and be loose first and tight when poses are good."
        )
    return hint("The number stands above the first panel of the picture.", "Read the title of the panel *matches*.")


@exercise("By how many sigmas does the heading that was found miss what was put in?", number("sigmas"))
def sigmas(answer: float, *, put_in: float, heading: Estimated) -> Outcome:
    if heading.value is None or not heading.sigma:
        return untold("No heading error was determined on these photos; the table's row is empty.")
    missed = heading.value - put_in
    truth = abs(missed) / heading.sigma
    if near(answer, truth, relative=0.03, absolute=0.06) or near(answer, -truth, relative=0.03, absolute=0.06):
        judged = (
            "Below 2, as here, it is what chance does; the sigma is honest."
            if truth < 2
            else "Beyond 2 chance alone seldom goes: the sigma knows of noise, not of all that can be wrong."
        )
        return right(f"|{heading.value:.2f} - {put_in:g}| / {heading.sigma:.2f} = {truth:.1f}. {judged}")
    if near(answer, abs(missed), absolute=0.005):
        return hint("These are degrees. How often does sigma go into them?")
    if near(answer, abs(heading.value) / heading.sigma, relative=0.03):
        return hint("This is how far it is from nothing. How far is it from what was put in?")
    return hint(
        "Take the row *heading*: found less put in, by sigma.",
        f"found = {heading.value:.3f}, put in = {put_in:g}, sigma = {heading.sigma:.3f}.",
    )


@exercise(
    "Which constant error can pictures and readings together never find?", choice("heading", "tilt", "height")
)
def never(answer: str) -> Outcome:
    if answer == "height":
        return right(
            "If every position is too high by the same metres, the town is built higher, too, and no photo "
            "and no reading objects: the same with east and north. Only something from outside can tell, such "
            "as a point on the ground with known coordinates. Headings and tilts are told by the way from "
            "photo to photo."
        )
    if answer == "heading":
        return hint("Look at the table: was it found? The way from photo to photo has a direction, too.")
    return hint(
        "Look at the table: was it found? A camera that hangs too high builds the town tilted against the "
        "flight's plane.",
        "Which of the three could all photos and all readings have in common, so that nothing contradicts it?",
    )


@exercise(
    "20.103 dB with test poses as they are, 23.727 dB with fitted ones: what was wrong?", choice("splat", "poses")
)
def fitted(answer: str) -> Outcome:
    if answer == "poses":
        return right(
            "The same splat looks 3.6 dB better once the test cameras stand where it believes that they "
            "stood. So the splat is fine, and the test poses were not where its training cameras had moved "
            "to. With COLMAP, where no camera moves, both numbers are the same (24.033 and 24.034 dB)."
        )
    return hint(
        "Fitting moves test cameras only. Does it change the splat?",
        "If the same splat gets better by moving the camera alone, what had been wrong?",
    )
