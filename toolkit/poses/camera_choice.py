"""Scores of camera models on the same observations, and the choice among them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.poses.camera_judge import t_log_likelihood, t_scale
from toolkit.poses.held_out import MatchedTracks

Array = NDArray[np.float64]

#: Differences within so many standard errors are none: about a dozen models are compared with the luckiest one.
SURE = 3.0
#: Least difference of BIC that decides: "very strong" (Kass and Raftery 1995, "Bayes factors").
LEAST_BIC = 10.0
# A withheld observation that is off by so many standard deviations in every model is a wrong match.
_OUTLIER = 6.0
# An error counts at most as so many times that limit, also that of a point without an image.
_CAP = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """A model's errors on the observations that all models are judged by.

    Attributes
    ----------
    held_out:
        Number of withheld observations that count.
    held_out_median, held_out_rms:
        Of the distances in pixels between withheld observations and the images of points placed without them.
        Wrong matches are left out for all models: those that are farther off in every model than ``limit``. Of the
        others each counts at most as 5 limits.
    limit:
        In pixels: 6 robust standard deviations of the model with the least median, at most ``max_error``.
    missed:
        Withheld observations whose points have no image in this model.
    observations:
        Number of the observations that were adjusted.
    training_median:
        Median distance of those, in pixels; smaller with every parameter more, so nothing is chosen by it.
    noise:
        Scale of Student's t with 4 degrees of freedom that fits their coordinates, in pixels.
    free_parameters:
        Intrinsics that were found.
    bic:
        Bayesian information criterion (Schwarz 1978) of intrinsics; poses and points are as many in every model.
        Only differences mean something.
    """

    held_out: int
    held_out_median: float
    held_out_rms: float
    limit: float
    missed: int
    observations: int
    training_median: float
    noise: float
    free_parameters: int
    bic: float

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {name: getattr(self, name) for name in self.__slots__}


@dataclass(frozen=True, slots=True)
class Margin:
    """By how much a model is worse than the one with the least held-out error and than the one with the least BIC.

    Attributes
    ----------
    held_out, held_out_error:
        Difference of the held-out RMS in pixels, and its standard error by the bootstrap over tracks.
    bic, bic_error:
        Difference of BIC, and its standard error by the scatter over tracks (Vuong 1989).
    """

    held_out: float
    held_out_error: float
    bic: float
    bic_error: float


@dataclass(frozen=True, slots=True)
class ModelChoice:
    """Which model was chosen.

    Attributes
    ----------
    chosen:
        Its name, or None where the observations do not decide.
    reason:
        Why, in a sentence.
    candidates:
        Models that the withheld observations cannot tell from the best, the least BIC first.
    margins:
        Of every fitted model.
    """

    chosen: str | None
    reason: str
    candidates: tuple[str, ...]
    margins: Mapping[str, Margin]

    def to_dict(self) -> dict[str, Any]:
        """Return the choice, ready for JSON."""
        return {
            "chosen": self.chosen,
            "reason": self.reason,
            "candidates": list(self.candidates),
            "margins": {
                name: {key: getattr(margin, key) for key in margin.__slots__}
                for name, margin in self.margins.items()
            },
        }


def choose(
    residuals: Mapping[str, Array],
    free_parameters: Mapping[str, int],
    tracks: MatchedTracks,
    *,
    max_error: float,
    resamples: int,
    seed: int,
) -> tuple[dict[str, Score], ModelChoice]:
    """Score models and choose one: first by withheld observations, among those that these cannot tell apart by BIC.

    Parameters
    ----------
    residuals:
        By model, (T, 2) of all observations in ``tracks``, in pixels; NaN where a point has no image.
    free_parameters:
        By model, number of intrinsics that were found.
    tracks:
        The observations, some withheld.
    max_error:
        In pixels: a withheld observation with a larger error in every model is a wrong match, whatever the noise.
    resamples:
        Of the bootstrap.
    seed:
        Of the bootstrap.
    """
    names = list(residuals)
    length = {name: np.linalg.norm(values, axis=1) for name, values in residuals.items()}
    held = np.stack([length[name][tracks.held_out] for name in names])
    missed = ~np.isfinite(held)
    held = np.where(missed, np.inf, held)
    # The length of a normal residual has a median of 1.18 standard deviations of a coordinate.
    usual = float(np.median(held, axis=1).min()) / 1.1774
    limit = min(max_error, max(_OUTLIER * usual, 1e-6))
    wrong = (held > limit).all(axis=0)
    cap = _CAP * limit
    held = np.minimum(held, cap)
    held, missed = held[:, ~wrong], missed[:, ~wrong]
    made: dict[str, Score] = {}
    fit: dict[str, Array] = {}
    for row, name in enumerate(names):
        training = np.nan_to_num(residuals[name][~tracks.held_out], nan=cap)
        scale = t_scale(training)
        of_each = t_log_likelihood(training, scale).sum(axis=1)
        fit[name] = np.zeros(tracks.count)
        np.add.at(fit[name], tracks.track[~tracks.held_out], of_each)
        made[name] = Score(
            held_out=held.shape[1],
            held_out_median=float(np.median(held[row])),
            held_out_rms=_rms(held[row]),
            limit=limit,
            missed=int(missed[row].sum()),
            observations=len(training),
            training_median=float(np.median(np.linalg.norm(training, axis=1))),
            noise=scale,
            free_parameters=free_parameters[name],
            bic=free_parameters[name] * math.log(training.size) - 2.0 * float(fit[name].sum()),
        )
    return made, _choice(made, held, fit, resamples, seed)


def _choice(
    made: Mapping[str, Score], held: Array, fit: Mapping[str, Array], resamples: int, seed: int
) -> ModelChoice:
    names = list(made)
    best = min(range(len(names)), key=lambda row: made[names[row]].held_out_rms)
    least = min(names, key=lambda name: made[name].bic)
    count = held.shape[1]
    # One withheld observation a track: tracks are drawn anew, and each model sees the same draw.
    drawn = np.random.default_rng(seed).multinomial(count, np.full(count, 1.0 / count), size=resamples)
    spread = np.sqrt(drawn @ np.square(held).T / count)
    error = (spread - spread[:, [best]]).std(axis=0)
    margins = {
        name: Margin(
            made[name].held_out_rms - made[names[best]].held_out_rms,
            float(error[row]),
            made[name].bic - made[least].bic,
            _bic_error(fit[name], fit[least]),
        )
        for row, name in enumerate(names)
    }
    alike = [name for name in names if margins[name].held_out <= SURE * margins[name].held_out_error]
    alike.sort(key=lambda name: made[name].bic)
    first = alike[0]
    rivals = [
        name
        for name in alike[1:]
        if made[name].bic - made[first].bic <= max(LEAST_BIC, SURE * _bic_error(fit[name], fit[first]))
    ]
    if rivals:
        reason = (
            f"Neither withheld observations nor BIC tell {_listed([first, *rivals])} apart: their held-out errors "
            f"are within {SURE:g} standard errors and their BIC within {LEAST_BIC:g} or {SURE:g} standard errors"
        )
        return ModelChoice(None, reason, tuple(alike), margins)
    return ModelChoice(first, _reason(first, alike, made, margins), tuple(alike), margins)


def _reason(first: str, alike: list[str], made: Mapping[str, Score], margins: Mapping[str, Margin]) -> str:
    others = [name for name in made if name not in alike]
    parts = []
    if others:
        near = min(others, key=lambda name: made[name].held_out_rms)
        parts.append(
            f"the held-out error of the next one, {near}, is larger by {margins[near].held_out:.3g} +- "
            f"{margins[near].held_out_error:.2g} px"
        )
    if len(alike) > 1:
        parts.append(
            f"of {_listed(alike)}, whose held-out errors are within {SURE:g} standard errors, it has the least "
            f"BIC, by {made[alike[1]].bic - made[first].bic:.1f}"
        )
    return f"{first}: " + ("; ".join(parts) or "no other model could be fitted")


def _bic_error(one: Array, other: Array) -> float:
    """Return the standard error of a BIC difference by the log-likelihoods (P,) of the tracks."""
    return 2.0 * math.sqrt(len(one)) * float(np.std(one - other))


def _rms(values: Array) -> float:
    return math.sqrt(float(np.mean(np.square(values)))) if len(values) else math.nan


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]
