"""Presets that refine poses: what goes beyond the paper is in the short one alone."""

from __future__ import annotations

import pytest

from toolkit.splat.pose_presets import pose_preset_settings


@pytest.mark.parametrize("name", ["orbslam-noposegs", "sensor-dpt"])
def test_the_papers_presets_refine_poses_as_noposegs_does(name: str) -> None:
    chosen = pose_preset_settings(name)
    assert not chosen.pose_pivot
    assert (chosen.pose_start, chosen.pose_ramp, chosen.pose_prior_weight, chosen.pose_prior_reach) == (0, 0, 0, 0)


def test_the_short_preset_has_a_pivot_and_holds_good_poses_only() -> None:
    chosen = pose_preset_settings("poses-short")
    assert chosen.pose_pivot
    assert chosen.pose_ramp > 0
    assert chosen.pose_prior == "start"
    assert chosen.pose_prior_weight > 0
    # A pull without an end would hold poses that are a degree off, too.
    assert 0 < chosen.pose_prior_reach * chosen.pose_rotation_sigma < 0.1
