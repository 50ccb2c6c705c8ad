"""Which frames become keyframes, and why."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from toolkit.capture.keyframes import KeyframeSettings, choose_keyframes
from toolkit.capture.video import decoded_frames
from toolkit.errors import Cancelled, DataError, MissingDependencyError, SettingsError, StageError
from toolkit.progress import ProgressEvent
from toolkit.scene.video import encode_video

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'sightline-toolkit[video]'")

WIDTH, HEIGHT = 200, 160


def wall() -> np.ndarray:
    """Return a wide wall of smooth random blots, on which there are hundreds of corners."""
    rough = gaussian_filter(np.random.default_rng(0).normal(size=(HEIGHT, 1200)), 1.5)
    return np.clip(128 + 60 * rough / rough.std(), 0, 255).astype(np.uint8)


def pan(steps: list[int]) -> Iterator[np.ndarray]:
    """Yield views of the wall, each so many pixels further right than the one before."""
    picture, place = wall(), 0
    for step in steps:
        place += step
        yield picture[:, place : place + WIDTH]


def test_keyframes_are_20_frames_apart_while_the_camera_moves() -> None:
    chosen = choose_keyframes(pan([4] * 70), KeyframeSettings())
    # In 20 frames of 4 px a wall of 200 px loses 40 % of its features.
    assert chosen.numbers.tolist() == [0, 20, 40, 60]
    assert chosen.reasons[0].startswith("first, ")
    assert chosen.reasons[1].startswith("20 frames, ")
    assert chosen.report == {
        "method": "paper-rule",
        "frames": 70,
        "keyframes": 4,
        "median_interval": 20.0,
        "longest_interval": 20,
    }
    assert chosen.to_dict()["numbers"] == [0, 20, 40, 60]


def test_a_camera_that_stands_still_gives_no_keyframes_until_it_moves() -> None:
    assert choose_keyframes(pan([0] * 50), KeyframeSettings()).numbers.tolist() == [0]
    later = choose_keyframes(pan([0] * 40 + [4] * 20), KeyframeSettings()).numbers
    # ORB keeps 31 px from the border: a tenth of the 138 px with corners has left after 45 px, 11 or 12 frames.
    assert len(later) == 2
    assert 46 <= later[1] <= 53


def test_the_share_of_features_is_a_setting() -> None:
    steps = [2] * 60
    strict = choose_keyframes(pan(steps), KeyframeSettings(max_shared=0.5))
    loose = choose_keyframes(pan(steps), KeyframeSettings(max_shared=0.95, min_interval=5))
    assert len(strict.numbers) < len(loose.numbers)
    assert (np.diff(strict.numbers) >= 20).all()
    assert (np.diff(loose.numbers) >= 5).all()


def test_frames_without_features_are_no_keyframes() -> None:
    dark = [np.zeros((HEIGHT, WIDTH), dtype=np.uint8)] * 25
    chosen = choose_keyframes([*dark, *pan([4] * 15), *dark, *pan([4] * 3)], KeyframeSettings())
    assert chosen.numbers.tolist() == [25, 65]
    with pytest.raises(
        StageError, match=r"No frame can be a keyframe; expected 50 features; found at most 0 in 25"
    ):
        choose_keyframes(dark, KeyframeSettings())


def test_large_frames_are_shrunk_for_tracking() -> None:
    large = [np.repeat(np.repeat(view, 4, axis=0), 4, axis=1) for view in pan([4] * 25)]
    assert choose_keyframes(large, KeyframeSettings(tracking_size=200)).numbers.tolist() == [0, 20]


def test_every_nth_and_given_numbers(tmp_path: Path) -> None:
    clip = tmp_path / "a.mp4"
    encode_video((np.repeat(view[..., None], 3, axis=2) for view in pan([4] * 23)), clip, 10)
    assert choose_keyframes(clip, KeyframeSettings()).numbers.tolist() == [0, 20]
    nth = KeyframeSettings(method="every-nth")
    assert choose_keyframes(clip, nth).numbers.tolist() == [0, 10, 20]
    assert choose_keyframes(pan([4] * 23), nth).report["frames"] == 23
    given = KeyframeSettings(method="given")
    assert choose_keyframes(clip, given, given=[3, 5]).numbers.tolist() == [3, 5]
    assert choose_keyframes(clip, given, given=[3, 5]).reasons == ("given", "given")
    with pytest.raises(DataError, match="There is no frame 23; expected 0 to 22; found 23 frames"):
        choose_keyframes(clip, given, given=[3, 23])
    with pytest.raises(DataError, match="no frame numbers"):
        choose_keyframes(clip, given, given=[5, 3])
    for settings, numbers in ((given, None), (nth, [3])):
        with pytest.raises(SettingsError, match="go with the method 'given'; expected both or none"):
            choose_keyframes(clip, settings, given=numbers)


def test_no_frames_and_frames_of_two_sizes_are_refused() -> None:
    for method in ("paper-rule", "every-nth"):
        with pytest.raises(DataError, match="There are no frames to choose from"):
            choose_keyframes([], KeyframeSettings(method=method))
    views = list(pan([1, 1]))
    for other in (views[1][:-1], views[1].astype(np.float64)):
        with pytest.raises(DataError, match="Frames are not all alike"):
            choose_keyframes([views[0], other], KeyframeSettings())


def test_it_can_be_cancelled_and_the_missing_package_names_its_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(event: ProgressEvent) -> None:
        if event.done == 2:
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        choose_keyframes(pan([1] * 5), KeyframeSettings(), progress=stop)
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'sightline-toolkit\[video\]'"):
        choose_keyframes(pan([1]), KeyframeSettings())


@pytest.mark.real
def test_a_car_that_drives_needs_a_keyframe_every_20_frames(real_data: Path) -> None:
    frames = (frame.grey() for frame in islice(decoded_frames(real_data / "video_kitti_03" / "video.mp4"), 45))
    assert choose_keyframes(frames, KeyframeSettings()).numbers.tolist() == [0, 20, 40]
