"""Exercises of the notebook on localisation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from toolkit.teach.exercise import Outcome, exercise, hint, right, untold
from toolkit.teach.kinds import near, number, numbers, several

#: Fewer than this share of the queries: lost.
_LOST = 0.5
_FURTHER = "`OFFSETS = (20.0, 40.0, 80.0, 160.0)`"


class _Found(Protocol):
    """As :class:`toolkit.metrics.localization.LocalizationErrors`."""

    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def found(self) -> int: ...


class _Batch(Protocol):
    """As :class:`toolkit.localize.batch.Batch`."""

    @property
    def found(self) -> tuple[Any, ...]: ...


@exercise("From which offset of the start are fewer than half of the queries found by ours?", number("m"))
def lost(answer: float, *, errors: Mapping[float, _Found]) -> Outcome:
    counts = {offset: (errors[offset].found, len(errors[offset].names)) for offset in sorted(errors)}
    beyond = [offset for offset, (found, total) in counts.items() if found < _LOST * total]
    if not beyond:
        return untold(f"From all of your offsets at least half are found. Look farther: {_FURTHER}.")
    truth, (found, total) = beyond[0], counts[beyond[0]]
    if near(answer, truth):
        return right(
            f"From {truth:g} m off {found} of {total} are found. There photo and first render hardly show the same "
            "ground, and the fan of further starts reaches two standard deviations only. What counts: the others "
            "are told as not found, and no wrong pose is given."
        )
    nearest = min(counts, key=lambda offset: abs(offset - answer))
    if not near(answer, nearest):
        return hint(f"That is none of your offsets, which are {', '.join(f'{offset:g}' for offset in counts)} m.")
    found, total = counts[nearest]
    if answer < truth:
        return hint(f"From {nearest:g} m off {found} of {total} are found: that is still half or more.")
    return hint(
        f"From {nearest:g} m off fewer than half are found, but is that the smallest such offset?",
        "Below the axis, go from the left until the second number, that of ours, is below half of the last one.",
    )


@exercise(
    "With the judge switched off, photos of which kinds are believed?",
    several("black", "blurred", "town", "fields"),
)
def believed(answer: frozenset[str], *, answers: Mapping[str, _Batch], changed: Mapping[str, object]) -> Outcome:
    if "judge.min_likeness" not in changed or "judge.min_inliers" not in changed:
        return untold(
            "The judge is still on: put what *Change* of step 7 says into `OURS`, then run the cells of steps 3 "
            "and 7."
        )
    truth = {kind for kind, batch in answers.items() if any(bool(done) for done in batch.found)}
    if answer == truth:
        what = f"Believed: {', '.join(sorted(truth))}" if truth else "None, even so"
        return right(
            f"{what}. What was refused was refused by RANSAC itself: not enough matches agreed on any pose. A few "
            "matches always agree by chance, so a pose can be had for nearly every photo; that it is right must be "
            "asked for, by their number, by the covariance and by the look of the render."
        )
    too_many, missing = sorted(answer - truth), sorted(truth - answer)
    if too_many:
        return hint(f'Look at the lines of "{too_many[0]}" again: does one begin with FOUND?')
    return hint("There is at least one more kind.", f'Look at the lines of "{missing[0]}" again.')


@exercise(
    "All points of the map lie too far east: how far off is the position, how large are the residuals?",
    numbers("metres", "pixels"),
)
def shifted(answer: Mapping[str, float], *, shift: float) -> Outcome:
    position, residual = near(answer["metres"], shift), near(answer["pixels"], 0.0)
    if position and residual:
        return right(
            f"The camera is found {shift:g} m too far east, and every point is seen exactly where it should be: "
            "residuals and covariance are as good as without the error. No method can see an error that all points "
            "share; only something from outside can, GNSS or ground control. So a map has to be georeferenced well."
        )
    if position:
        return hint(
            "The position is right. Now move camera and points together: what does the camera see?",
            "Nothing changes in a picture when the whole world moves with the camera.",
        )
    if residual:
        return hint("The residuals are right. From where are the shifted points seen as in the photo?")
    return hint(
        "PnP looks for the place from which the points are seen as in the photo. Where is that, if all have moved?",
        "Add the same vector to the points and to the centre of the camera: what becomes of the pixels?",
    )
