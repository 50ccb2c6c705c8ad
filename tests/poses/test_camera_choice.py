"""Choosing among models from residuals alone, and the withholding of observations."""

from __future__ import annotations

import dataclasses
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from arc_matches import MILD, arc_database, arc_scene
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.poses.camera_choice import ModelChoice, Score, choose
from toolkit.poses.camera_judge import t_log_likelihood, t_scale
from toolkit.poses.held_out import MatchedTracks, hold_out, matched_tracks, withhold

COUNT, LENGTH = 400, 6


def tracks() -> MatchedTracks:
    rows = np.repeat(np.arange(COUNT), LENGTH)
    held = np.zeros(len(rows), bool)
    held[::LENGTH] = True
    return MatchedTracks(
        rows, np.tile(np.arange(LENGTH), COUNT), rows, np.zeros((len(rows), 2)), held, COUNT, {"uncalibrated": 1}
    )


def noise(sigma: float, seed: int = 0) -> NDArray[np.float64]:
    return sigma * np.random.default_rng(seed).normal(size=(COUNT * LENGTH, 2))


def chosen(residuals: dict[str, NDArray[np.float64]], free: dict[str, int]) -> tuple[dict[str, Score], ModelChoice]:
    return choose(residuals, free, tracks(), max_error=4.0, resamples=500, seed=0)


def test_the_smaller_held_out_error_is_chosen() -> None:
    scores, choice = chosen({"good": noise(0.5), "bad": 1.3 * noise(0.5, 1)}, {"good": 3, "bad": 2})
    assert choice.chosen == "good"
    assert choice.candidates == ("good",)
    # 400 lengths of two coordinates each: 2.5 % for the RMS.
    assert scores["good"].held_out_rms == pytest.approx(0.5 * np.sqrt(2), rel=0.08)
    margin = choice.margins["bad"]
    assert margin.held_out == pytest.approx(0.3 * 0.5 * np.sqrt(2), rel=0.4)
    # Two independent spreads, each known to 2.5 %.
    assert margin.held_out_error == pytest.approx(0.03, rel=0.4)
    assert "bad" in choice.reason


def test_equal_errors_are_decided_by_the_number_of_parameters_or_not_at_all() -> None:
    same = noise(0.5)
    _, choice = chosen({"wide": same, "slim": same}, {"wide": 8, "slim": 2})
    assert choice.chosen == "slim"
    assert "least BIC, by" in choice.reason
    _, choice = chosen({"one": same, "other": same}, {"one": 3, "other": 3})
    assert choice.chosen is None
    assert set(choice.candidates) == {"one", "other"}
    assert "Neither" in choice.reason


def test_a_model_that_fits_the_training_better_alone_is_not_chosen() -> None:
    """It has learnt the noise of what it was fitted to: what it did not see is worse."""
    true, learnt = noise(0.5), 0.7 * noise(0.5)
    learnt[::LENGTH] = 1.5 * true[::LENGTH]
    scores, choice = chosen({"true": true, "learnt": learnt}, {"true": 3, "learnt": 12})
    assert scores["learnt"].training_median < scores["true"].training_median
    assert scores["learnt"].bic < scores["true"].bic
    assert choice.chosen == "true"


def test_wrong_matches_count_for_no_model_and_points_without_image_against_theirs() -> None:
    clean, wild = noise(0.5), noise(0.5)
    wild[: 20 * LENGTH : LENGTH] += 50.0
    without, _ = chosen({"a": clean, "b": clean}, {"a": 3, "b": 3})
    scores, _ = chosen({"a": wild, "b": wild}, {"a": 3, "b": 3})
    assert scores["a"].held_out == without["a"].held_out - 20
    assert scores["a"].held_out_rms == pytest.approx(without["a"].held_out_rms, rel=0.05)
    gone = clean.copy()
    gone[: 20 * LENGTH : LENGTH] = np.nan
    scores, choice = chosen({"a": clean, "b": gone}, {"a": 3, "b": 3})
    assert scores["b"].missed == 20
    assert scores["b"].held_out_rms > 2 * scores["a"].held_out_rms
    assert choice.chosen == "a"


def test_the_robust_scale_is_that_of_normal_noise_to_a_constant() -> None:
    values = np.random.default_rng(0).normal(size=20000)
    # Student's t with 4 degrees of freedom fits a normal distribution with 0.83 of its deviation.
    assert t_scale(values) == pytest.approx(0.83, rel=0.03)
    wild = values.copy()
    wild[:400] *= 100
    assert t_scale(wild) == pytest.approx(t_scale(values), rel=0.1)
    grid = np.linspace(-400, 400, 800001)
    assert np.exp(t_log_likelihood(grid, 0.7)).sum() * (grid[1] - grid[0]) == pytest.approx(1.0, abs=1e-6)


def test_tracks_are_those_of_the_truth_and_withheld_keypoints_lose_their_matches(tmp_path: Path) -> None:
    truth = arc_scene(tmp_path, MILD, frames=6, arc=20.0, points=600)
    assert truth.points is not None
    assert truth.points.tracks is not None
    database = arc_database(tmp_path / "matches.db", truth, window=3)
    found = matched_tracks(database)
    assert found.count == len(truth.points)
    assert sorted(np.bincount(found.track)) == sorted(np.bincount(truth.points.tracks.point))
    kept = hold_out(found, share=0.5, min_length=4, most=1000, seed=1)
    lengths = np.bincount(kept.track)
    assert lengths.min() >= 4
    withheld = np.bincount(kept.track, weights=kept.held_out)
    assert withheld.max() == 1
    assert withheld.sum() == round(0.5 * kept.count)
    again = hold_out(found, share=0.5, min_length=4, most=1000, seed=1)
    assert np.array_equal(again.held_out, kept.held_out)
    assert not np.array_equal(hold_out(found, share=0.5, min_length=4, most=1000, seed=2).held_out, kept.held_out)
    withhold(database, kept)
    gone = {(int(f), int(k)) for f, k in zip(kept.frame[kept.held_out], kept.keypoint[kept.held_out], strict=True)}
    with closing(pycolmap.Database.open(database)) as opened:
        for pair_id, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            one, other = pycolmap.pair_id_to_image_pair(pair_id)
            for left, right in np.asarray(geometry.inlier_matches).tolist():
                assert (one - 1, left) not in gone
                assert (other - 1, right) not in gone
    left = matched_tracks(database)
    assert len(left.track) == len(found.track) - len(gone)


def test_tracks_that_meet_a_picture_twice_are_no_tracks(tmp_path: Path) -> None:
    truth = arc_scene(tmp_path, MILD, frames=3, arc=8.0, points=300)
    database = arc_database(tmp_path / "matches.db", truth, window=1)
    before = matched_tracks(database).count
    with closing(pycolmap.Database.open(database)) as opened:
        geometry = opened.read_two_view_geometry(1, 2)
        inliers = np.asarray(geometry.inlier_matches)
        geometry.inlier_matches = np.concatenate([inliers, [[inliers[0, 0], inliers[1, 1]]]]).astype(np.uint32)
        opened.delete_two_view_geometry(1, 2)
        opened.write_two_view_geometry(1, 2, geometry)
    # Two tracks have become one that sees the second picture twice.
    assert matched_tracks(database).count == before - 2


def test_too_few_tracks_cannot_be_held_out() -> None:
    with pytest.raises(StageError, match="found 4 of 400 tracks of 4 pictures"):
        hold_out(dataclasses.replace(tracks()), share=0.01, min_length=4, most=1000, seed=0)
