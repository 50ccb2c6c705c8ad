"""Exercises of notebooks 00 to 02: right answers from the reader's own data, and a hint for each usual mistake."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from toolkit.teach import check, checking


@pytest.fixture(autouse=True)
def _no_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checking, "_wrong", {})


@dataclass(frozen=True)
class Points:
    """Points of which the first ``long`` are seen by three photos, the others by two."""

    count: int
    long: int

    def __len__(self) -> int:
        return self.count

    @property
    def tracks(self) -> Any:
        views = [3] * self.long + [2] * (self.count - self.long)
        return SimpleNamespace(point=np.repeat(np.arange(self.count), views))


def report(*inliers: int) -> Any:
    """Matches of photo 0 with 1, 2, ..., and one pair without photo 0."""
    pairs = np.array([(0, place) for place in range(1, len(inliers) + 1)] + [(1, 2)])
    return SimpleNamespace(pairs=pairs, inliers=np.array([*inliers, 0]))


def rays(pixels: float) -> Any:
    return SimpleNamespace(triangulation=SimpleNamespace(max_error=pixels))


NEAR = SimpleNamespace(near=3)
WRONG = np.array([[0, 9], [2, 8], [1, 11]])  # the nearest are 6 apart
HEADING = SimpleNamespace(value=2.6, sigma=0.2)
ARC = SimpleNamespace(arc_degrees=76.0, sigma=0.9)
EXPECTED = 2 * math.sqrt(2 / math.pi) * 3 * math.sqrt(1 - 7 / 108)

RIGHT: list[tuple[str, object, dict[str, Any], str]] = [
    ("tour.reach", 3, {"report": report(230, 62, 0, 0)}, "Photo 3 shares 0 matches with photo 0, photo 2 still 62"),
    ("tour.gauge", ["north", "size", "place"], {}, "7 numbers"),
    ("tour.bias", "none", {}, "take out before they measure"),
    ("tour.pairs", 276, {"photos": 24}, "24·23/2 = 276"),
    ("tour.decibels", 6, {}, "6.02 dB"),
    ("drone_poses.amdahl", 1.96, {}, "3.37 times as fast"),
    ("drone_poses.expected", round(EXPECTED, 1), {"photos": 36}, f"= {EXPECTED:.2f} m"),
    ("drone_poses.blind", {"gimbal sigma", "heading bias"}, {}, "positions only"),
    ("drone_poses.tight", 100, {"settings": rays(3.0), "points": Points(100, 5)}, "95 % of them are seen by two"),
    ("drone_poses.sigmas", 2.0, {"put_in": 3.0, "heading": HEADING}, "|2.60 - 3| / 0.20 = 2.0"),
    ("drone_poses.never", "height", {}, "known coordinates"),
    ("drone_poses.fitted", "poses", {}, "3.6 dB"),
    ("blades.pitch", 10, {"blades": 90, "step": 0.4}, "the third 20"),
    ("blades.window", 5, {"wrong": WRONG, "settings": NEAR}, "With 5 frames there is none"),
    ("blades.near", 3, {"wrong": WRONG, "settings": SimpleNamespace(near=10), "pitch": 10.0}, "in the chain"),
    ("blades.sigma", 24.2, {"arc": ARC, "truth": 97.8}, "Three would be rare"),
    ("blades.sigma", 0.2, {"arc": ARC, "truth": 76.2}, "what noise does"),
    ("blades.drift", {"independent": 0.55, "alike": 6.0}, {"frames": 121}, "0.05·120 = 6.00"),
]

WRONG_ONES: list[tuple[str, object, dict[str, Any], str]] = [
    ("tour.reach", 0, {"report": report(230, 62, 0)}, "the one that stays"),
    ("tour.reach", 2, {"report": report(230, 62, 0)}, "still share 50"),
    ("tour.reach", 4, {"report": report(230, 62, 0, 0)}, "are they the first"),
    ("tour.reach", 2.5, {"report": report(230, 62, 0)}, "whole numbers from 1 to 3"),
    ("tour.reach", 99, {"report": report(230, 62, 0)}, "whole numbers from 1 to 3"),
    ("tour.gauge", ["size", "place", "north", "shape"], {}, "there were no sensors"),
    ("tour.gauge", ["place", "north"], {}, "a model of the town"),
    ("tour.gauge", ["size"], {}, "another island"),
    ("tour.bias", "sim3", {}, "before it measures"),
    ("tour.decibels", 3.01, {}, "*squared* error"),
    ("tour.decibels", -6.02, {}, "grow or fall"),
    ("tour.decibels", 1.386, {}, "to the base 10"),
    ("tour.decibels", 100, {}, "take the difference"),
    ("drone_poses.amdahl", 3.37, {}, "gain of Sensor-DPT"),
    ("drone_poses.amdahl", 49, {}, "share of poses"),
    ("drone_poses.amdahl", 0.51, {}, "what is left of the time"),
    ("drone_poses.amdahl", 10, {}, "when the part for poses is gone"),
    ("drone_poses.expected", 3, {"photos": 36}, "sigma of one axis"),
    ("drone_poses.expected", 5.196, {"photos": 36}, "root mean square"),
    ("drone_poses.expected", 4.787, {"photos": 36}, "before the alignment"),
    ("drone_poses.expected", 9, {"photos": 36}, "What is n here"),
    ("drone_poses.blind", ["GPS sigma"], {}, "really stand still"),
    ("drone_poses.blind", ["heading bias"], {}, "one at a time"),
    ("drone_poses.tight", 7, {"settings": rays(3.0), "points": Points(100, 5)}, "above the first panel"),
    ("drone_poses.sigmas", 0.4, {"put_in": 3.0, "heading": HEADING}, "These are degrees"),
    ("drone_poses.sigmas", 13, {"put_in": 3.0, "heading": HEADING}, "from nothing"),
    ("drone_poses.sigmas", 7, {"put_in": 3.0, "heading": HEADING}, "found less put in"),
    ("drone_poses.never", "heading", {}, "was it found"),
    ("drone_poses.never", "tilt", {}, "hangs too high"),
    ("drone_poses.fitted", "splat", {}, "moves test cameras only"),
    ("blades.pitch", 4, {"blades": 90, "step": 0.4}, "degrees between two blades"),
    ("blades.pitch", 900, {"blades": 90, "step": 0.4}, "gone around once"),
    ("blades.pitch", 20, {"blades": 90, "step": 0.4}, "not the first one"),
    ("blades.pitch", 7, {"blades": 90, "step": 0.4}, "next bright stripe"),
    ("blades.window", 6, {"wrong": WRONG, "settings": NEAR}, "one too many"),
    ("blades.window", 8, {"wrong": WRONG, "settings": NEAR}, "further back"),
    ("blades.window", 2, {"wrong": WRONG, "settings": NEAR}, "Can it be wider"),
    ("blades.near", 9, {"wrong": WRONG, "settings": SimpleNamespace(near=10), "pitch": 10.0}, "right end"),
    ("blades.sigma", 21.8, {"arc": ARC, "truth": 97.8}, "These are degrees"),
    ("blades.sigma", 84.4, {"arc": ARC, "truth": 97.8}, "from the truth"),
    ("blades.sigma", 3, {"arc": ARC, "truth": 97.8}, "the column SIMPLE_RADIAL"),
    ("blades.drift", {"independent": 6.0, "alike": 0.55}, {"frames": 121}, "the other way round"),
    ("blades.drift", {"independent": 0.55, "alike": 1.0}, {"frames": 121}, "each step adds the same"),
    ("blades.drift", {"independent": 3.0, "alike": 6.0}, {"frames": 121}, "squares that add up"),
]

OPEN: list[tuple[str, object, dict[str, Any], str]] = [
    ("tour.reach", 3, {"report": report(230, 62)}, "every photo shares 50"),
    ("drone_poses.tight", 100, {"settings": rays(25.0), "points": Points(100, 5)}, "Change it to `3.0`"),
    (
        "drone_poses.sigmas",
        1,
        {"put_in": 3.0, "heading": SimpleNamespace(value=None, sigma=None)},
        "was determined",
    ),
    ("blades.window", 5, {"wrong": WRONG[:0], "settings": NEAR}, "no wrong pair at all"),
    ("blades.near", 3, {"wrong": WRONG, "settings": NEAR, "pitch": 10.0}, "less than the 10 of a blade"),
    ("blades.sigma", 24.2, {"arc": None, "truth": 97.8}, "do not tell"),
    ("blades.sigma", 24.2, {"arc": ARC, "truth": None}, "do not tell"),
]

ALL = [
    (state, *case) for state, cases in (("right", RIGHT), ("wrong", WRONG_ONES), ("open", OPEN)) for case in cases
]


@pytest.mark.parametrize(("state", "name", "answer", "facts", "said"), ALL)
def test_it_is_judged_by_the_data_and_answered_to_the_point(
    state: str, name: str, answer: object, facts: dict[str, Any], said: str
) -> None:
    verdict = check(name, answer, **facts)
    assert verdict.state == state, verdict
    assert said in verdict.text
