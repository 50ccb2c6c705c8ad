"""What the names of measures mean: which way is better, and which are taken from test pictures."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Literal

Better = Literal["higher", "lower"]

_HIGHER = frozenset(
    {*("psnr", "ssim", "registered", "inliers", "recall", "precision", "score", "fps"), *("within", "known")}
)
_LOWER = frozenset(
    {
        *("lpips", "pos", "rot", "ate", "rpe", "rmse", "mae", "l1", "error", "loss", "seconds", "outliers"),
        *("mte", "mre"),
        *("accuracy", "completeness", "normal"),  # of surfaces: distances and an angle
        *("absolute", "spread", "rms"),  # of differences
    }
)
_PICTURE = frozenset({"psnr", "ssim", "lpips"})
_WORD = re.compile(r"[a-z0-9]+")


def better(name: str) -> Better | None:
    """Return which way a measure is better, None where it only describes (a count of Gaussians, say).

    The last part of a dotted name decides, then those before it: ``poses.rpe.translation`` is an error.
    """
    for part in reversed(name.lower().split(".")):
        words = set(_WORD.findall(part))
        if words & _LOWER:
            return "lower"
        if words & _HIGHER:
            return "higher"
    return None


def is_picture_measure(name: str) -> bool:
    """Whether a measure compares test photos with renders: it means nothing across different photos."""
    return bool(set(_WORD.findall(name.lower())) & _PICTURE)


def best_of(name: str, values: Sequence[float | None]) -> frozenset[int]:
    """Return which of ``values`` are the best as they are shown (:func:`format_number`).

    None are where fewer than two are known, or all look the same.
    """
    direction = better(name)
    known = {i: value for i, value in enumerate(values) if value is not None and not math.isnan(value)}
    shown = {i: format_number(value) for i, value in known.items()}
    if direction is None or len(known) < 2 or len(set(shown.values())) == 1:
        return frozenset()
    best = max(known.values()) if direction == "higher" else min(known.values())
    return frozenset(i for i, text in shown.items() if text == format_number(best))


def format_number(value: float | None) -> str:
    """Return a measure as a person reads it: four significant digits, thousands with commas."""
    if value is None or math.isnan(value):
        return "–"
    if float(value).is_integer() and abs(value) < 1e15:
        return f"{int(value):,}"
    if abs(value) >= 1e4:
        return f"{value:,.0f}"
    if abs(value) >= 1e-3:
        return f"{value:.{max(0, 3 - math.floor(math.log10(abs(value))))}f}"
    return f"{value:.3g}"


def format_seconds(seconds: float) -> str:
    """Return a duration as a person reads it."""
    if seconds < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"
