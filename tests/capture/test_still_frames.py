"""Stops are found, slow motion is none, and what cannot be told is kept."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from turning import Footage

from toolkit.capture.still_frames import StillFrames, StillSettings, find_still_frames
from toolkit.errors import Cancelled, DataError, MissingDependencyError, StageError
from toolkit.progress import ProgressEvent

pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'sightline-toolkit[video]'")


def looked(footage: Footage, **settings: float) -> StillFrames:
    return find_still_frames(footage.frames(), StillSettings(**settings), ignore=footage.truth | ~footage.inside)


@pytest.mark.parametrize("noise", [0.5, 2.0, 5.0])
def test_a_stop_is_left_out_but_for_its_first_frame(noise: float) -> None:
    found = looked(Footage((3.0,) * 20 + (0.0,) * 30 + (3.0,) * 20, noise=noise))
    # Step i leads from frame i to i + 1: frame 20 is the first of the stop, and 50 shows the same.
    (stop,) = found.stops
    assert (stop.anchor, stop.first, stop.last, stop.frames) == (20, 21, 50, 30)
    assert stop.motion < 0.15
    assert found.kept.tolist() == [*range(21), *range(51, 71)]
    np.testing.assert_allclose(found.motion[1:21], 3.0, atol=0.2)
    said = found.to_dict()
    assert (said["kept"], said["removed"], said["unjudged"]) == (41, 30, 0)
    assert said["stops"][0]["kept"] == 20
    assert said["median_motion_px"] == pytest.approx(3.0, abs=0.1)


@pytest.mark.parametrize("step", [0.04, 0.1, 0.5])
def test_slow_motion_is_no_stop(step: float) -> None:
    found = looked(Footage((step,) * 60))
    assert found.stops == ()
    assert len(found.kept) == 61


def test_slower_motion_is_told_by_longer_stops() -> None:
    creeping = Footage((0.02,) * 80)
    assert len(looked(creeping).stops) > 0
    assert looked(creeping, least_frames=40).stops == ()


def test_two_stops_and_one_at_the_end_are_told_apart_and_short_ones_stay() -> None:
    go, stop, short = (2.0,) * 10, (0.0,) * 20, (0.0,) * 6
    found = looked(Footage(go + stop + go + short + go + stop))
    assert [(one.first, one.last) for one in found.stops] == [(11, 30), (57, 76)]


def test_a_flicker_does_not_end_a_stop() -> None:
    frames = list(Footage((3.0,) * 10 + (0.0,) * 40 + (3.0,) * 10).frames())
    frames[30] = np.roll(frames[30], 5, axis=1)
    inside = Footage(()).inside & ~Footage(()).truth
    found = find_still_frames(frames, StillSettings(), ignore=~inside)
    assert [(one.first, one.last) for one in found.stops] == [(11, 50)]
    assert found.motion[30] > 1.0
    assert found.stops[0].motion < 0.3
    twice = find_still_frames(frames, StillSettings(patience=1), ignore=~inside)
    assert [(one.first, one.last) for one in twice.stops] == [(11, 29), (32, 50)]


def test_static_structure_that_is_not_ignored_does_not_hide_motion_of_a_quarter_of_the_features() -> None:
    found = find_still_frames(Footage((1.0,) * 30).frames(), StillSettings())
    assert found.stops == ()


def test_a_video_without_motion_says_so() -> None:
    with pytest.raises(
        StageError, match=r"Nothing moves .*motion of over 0\.3 px in 12 frames; found 31 frames within 0\.\d+ px"
    ):
        looked(Footage((0.0,) * 30))


def test_frames_without_features_are_kept_and_counted() -> None:
    grey = [np.full((96, 128), 128, dtype=np.uint8)] * 30
    found = find_still_frames(grey, StillSettings())
    assert len(found.kept) == 30
    assert found.unjudged == 29
    assert np.isnan(found.motion).all()
    assert found.to_dict()["median_motion_px"] is None
    # Corners made of noise alone tell nothing either.
    noisy = (128 + 6 * np.random.default_rng(0).normal(size=(30, 96, 128))).astype(np.uint8)
    assert find_still_frames(noisy, StillSettings()).unjudged == 29


def test_bad_frames_are_refused_and_it_can_be_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = np.zeros((64, 64), dtype=np.uint8)
    with pytest.raises(DataError, match="There are no frames to look at"):
        find_still_frames([], StillSettings())
    with pytest.raises(DataError, match="Frame 1 .* not like the first"):
        find_still_frames([frame, frame[1:]], StillSettings())
    assert find_still_frames([frame], StillSettings()).kept.tolist() == [0]

    def stop(event: ProgressEvent) -> None:
        if event.done == 2:
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        find_still_frames([frame] * 4, StillSettings(), progress=stop)
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingDependencyError, match="pip install"):
        find_still_frames([frame], StillSettings())
