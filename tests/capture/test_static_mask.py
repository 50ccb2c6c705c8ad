"""What stands still is found and what moves is not, however noisy it is and whether it has texture or not."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from scipy.ndimage import binary_dilation
from turning import LEFT, RIGHT, Footage, overlap

from toolkit.capture.borders import CropSettings, find_borders
from toolkit.capture.static_mask import StaticMask, StaticMaskSettings, find_static_mask
from toolkit.capture.temporal import TemporalSettings, noise_level, sampled_numbers, temporal_statistics
from toolkit.errors import DataError, MissingDependencyError, StageError

pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'sightline-toolkit[video]'")

MOVING = (2.3,) * 79


def found(footage: Footage, **settings: float) -> StaticMask:
    statistics = temporal_statistics(footage.frames(), TemporalSettings())
    empty = find_borders(statistics, CropSettings()).empty
    return find_static_mask(statistics, StaticMaskSettings(**settings), empty=empty)


@pytest.mark.parametrize("noise", [0.5, 2.0, 5.0])
def test_casing_and_icon_are_masked_and_little_else(noise: float) -> None:
    footage = Footage(MOVING, noise=noise)
    made = found(footage)
    # The mask is grown by 6 px, and smoothing (1.2 px) spreads an edge by 2 more.
    recall, _ = overlap(made.mask, footage.truth)
    _, precision = overlap(made.mask, binary_dilation(footage.truth, iterations=10))
    assert recall > 0.995
    assert precision > 0.995
    assert made.to_dict()["pieces"] == 2
    assert made.statistics.noise == pytest.approx(noise, abs=0.5)


def test_the_bare_inside_of_the_casing_is_static_and_the_bare_band_that_moves_is_undecided() -> None:
    footage = Footage(MOVING)
    made = found(footage)
    band = np.s_[44:56, LEFT + 8 : RIGHT - 8]
    inside = np.s_[120:128, LEFT + 4 : LEFT + 16]
    # Both have next to no variance and no gradient: only the static outline tells them apart.
    deviation = np.sqrt(made.statistics.variance)
    assert max(deviation[band].max(), deviation[inside].max()) < 4
    assert made.undecided[band].all()
    assert not made.mask[band].any()
    assert made.mask[inside].all()
    assert not (made.undecided & made.mask).any()


def test_a_stop_that_fills_most_of_the_video_does_not_make_everything_static() -> None:
    footage = Footage((2.3,) * 30 + (0.0,) * 300)
    made = found(footage)
    assert (made.statistics.count, made.statistics.repeated) == (31, 300)
    assert overlap(made.mask, footage.truth)[0] > 0.99
    assert overlap(made.mask, binary_dilation(footage.truth, iterations=10))[1] > 0.99


def test_an_icon_through_which_the_wall_is_seen_is_found() -> None:
    footage = Footage(MOVING, static=False)
    icon = np.s_[66:82, 120:140]
    frames = []
    for frame in footage.frames():
        mixed = np.where(footage.inside, 120 + 0.4 * (frame.astype(float) - 120), 0.0)
        mixed[icon] = 0.4 * mixed[icon] + 0.6 * 250
        frames.append(mixed.astype(np.uint8))
    made = find_static_mask(
        temporal_statistics(frames, TemporalSettings()), StaticMaskSettings(), empty=~footage.inside
    )
    truth = np.zeros_like(made.mask)
    truth[icon] = True
    assert overlap(made.mask, truth)[0] > 0.95
    assert overlap(made.mask, binary_dilation(truth, iterations=10))[1] > 0.99


def test_nothing_is_masked_where_everything_moves() -> None:
    made = found(Footage(MOVING, static=False))
    assert not made.mask.any()
    assert not made.structure.any()
    assert made.to_dict()["masked"] == 0.0


def test_the_edge_of_a_round_picture_is_no_static_structure() -> None:
    footage = Footage(MOVING, round=True, static=False)
    assert not found(footage).mask.any()


def test_the_mask_is_grown_as_far_as_it_is_asked() -> None:
    footage = Footage(MOVING)
    sizes = [found(footage, grow=grow).mask for grow in (0, 3, 9)]
    for small, large, further in ((sizes[0], sizes[1], 3), (sizes[0], sizes[2], 9)):
        assert large.sum() > small.sum()
        assert (large <= binary_dilation(small, np.ones((3, 3)), iterations=further)).all()


def test_a_static_light_over_moving_parts_without_texture_is_no_structure() -> None:
    rng = np.random.default_rng(0)
    light = 60 + 100 * np.exp(-((np.arange(160) - 80) ** 2) / 4000.0)
    texture = np.zeros((120, 160))
    texture[:60] = 1.0

    def frames() -> list[np.ndarray]:
        wall = Footage((), static=False).wall[:120]
        parts = [wall[:, 3 * i : 3 * i + 160] - 120 for i in range(60)]
        return [
            np.clip(light + 0.5 * part * texture + 2 * rng.normal(size=part.shape), 0, 255).astype(np.uint8)
            for part in parts
        ]

    made = find_static_mask(temporal_statistics(frames(), TemporalSettings()), StaticMaskSettings())
    # 100 levels over 60 pixels are at most 1.4 levels a pixel.
    assert not made.mask.any()
    assert made.undecided[70:].mean() > 0.95


def test_a_video_without_motion_is_refused_and_not_masked_away() -> None:
    with pytest.raises(
        StageError,
        match=r"Nothing moves .* found 100 % of all structure standing still in 40 frames.*stills\.remove",
    ):
        found(Footage((0.0,) * 39))
    grey = [np.full((64, 80), 128, dtype=np.uint8)] * 5
    with pytest.raises(StageError, match="Nothing moves .* found no structure at all"):
        find_static_mask(temporal_statistics(grey, TemporalSettings()), StaticMaskSettings())


def test_frames_are_drawn_without_a_step_that_could_fall_on_the_blades() -> None:
    numbers = sampled_numbers(3632, 100, seed=1)
    assert len(set(numbers)) == 100
    assert numbers == sorted(numbers)
    assert numbers[-1] < 3632
    assert len(set(np.diff(numbers))) > 10
    assert numbers == sampled_numbers(3632, 100, seed=1) != sampled_numbers(3632, 100, seed=2)
    assert sampled_numbers(7, 10, seed=0) == list(range(7))


def test_statistics_are_those_of_each_pixel() -> None:
    frames = np.random.default_rng(0).integers(0, 60, (12, 40, 50)).astype(np.uint8)
    made = temporal_statistics(frames, TemporalSettings(dark=20))
    assert (made.count, made.repeated) == (12, 0)
    np.testing.assert_allclose(made.mean, frames.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(made.variance, frames.var(axis=0), atol=1e-7)
    np.testing.assert_allclose(made.dark_share, (frames <= 20).mean(axis=0), atol=1e-12)


def test_noise_is_told_from_texture() -> None:
    rng = np.random.default_rng(3)
    bare = 128 + 4.0 * rng.normal(size=(160, 160))
    half = bare.copy()
    half[:80] += 60 * rng.normal(size=(80, 160))
    for picture in (bare, half):
        # The lower quartile of blocks is a little below the mean: 10 %.
        assert noise_level(np.clip(picture, 0, 255).astype(np.uint8)) == pytest.approx(4.0, rel=0.15)
    assert noise_level(np.zeros((64, 64), dtype=np.uint8)) == 0.0
    assert noise_level(np.zeros((8, 8), dtype=np.uint8)) == 0.0


def test_too_few_frames_and_frames_of_two_sizes_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = np.zeros((32, 40), dtype=np.uint8)
    for few in ([], [frame]):
        with pytest.raises(DataError, match=f"expected at least 2 frames; found {len(few)}"):
            temporal_statistics(few, TemporalSettings())
    for other in (frame[:-1], frame.astype(np.float64), frame[..., None]):
        with pytest.raises(DataError, match=r"Frame 1 .* is not like the first; expected .* shape \(32, 40\)"):
            temporal_statistics([frame, other], TemporalSettings())
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingDependencyError, match="pip install"):
        temporal_statistics([frame, frame], TemporalSettings())
