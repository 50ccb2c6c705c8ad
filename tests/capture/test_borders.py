"""Empty borders are found and cut off, and the picture is cropped as asked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from turning import BOTTOM, HEIGHT, LEFT, RIGHT, TOP, WIDTH, Footage

from toolkit.capture.borders import Borders, CropSettings, Rectangle, chosen_rectangle, find_borders
from toolkit.capture.temporal import TemporalSettings, TemporalStatistics, temporal_statistics
from toolkit.errors import DataError, SettingsError

pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'sightline-toolkit[video]'")

MOVING = (2.3,) * 30


def statistics(footage: Footage) -> TemporalStatistics:
    return temporal_statistics(footage.frames(), TemporalSettings())


def borders() -> Borders:
    return find_borders(statistics(Footage(MOVING)), CropSettings())


def test_straight_borders_are_found_to_the_pixel() -> None:
    made = borders()
    assert made.rectangle == Rectangle(LEFT, TOP, RIGHT - LEFT, BOTTOM - TOP)
    assert not made.round
    np.testing.assert_array_equal(made.empty, ~Footage(MOVING).inside)
    assert made.to_dict()["rectangle"] == [16, 12, 160, 120]


def test_the_corners_about_a_round_picture_are_empty() -> None:
    footage = Footage(MOVING, round=True)
    made = find_borders(statistics(footage), CropSettings())
    assert made.round
    assert made.rectangle == Rectangle(38, 14, 116, 116)
    assert (made.empty != ~footage.inside).mean() < 0.002


def test_writing_in_the_border_is_not_part_of_the_picture_and_a_dark_gap_in_it_is() -> None:
    frames = list(Footage(MOVING).frames())
    for frame in frames:
        frame[2:8, 30:60:3] = 255
        frame[60:90, 90:100] = 0
    made = find_borders(temporal_statistics(frames, TemporalSettings()), CropSettings())
    assert made.rectangle == Rectangle(LEFT, TOP, RIGHT - LEFT, BOTTOM - TOP)
    assert not made.empty[60:90, 90:100].any()
    assert made.empty[2:8, 30:60].all()


def test_a_picture_without_borders_stays_whole() -> None:
    frames = [frame[TOP:BOTTOM, LEFT:RIGHT] for frame in Footage(MOVING).frames()]
    made = find_borders(temporal_statistics(frames, TemporalSettings()), CropSettings())
    assert made.rectangle == Rectangle(0, 0, 160, 120)
    assert not made.empty.any()


def test_a_video_that_is_dark_everywhere_is_refused() -> None:
    made = statistics(Footage(MOVING))
    dark = replace(made, dark_share=np.full_like(made.dark_share, 0.99))
    with pytest.raises(DataError, match=r"The video is dark; .*found at most 1 % of the frames.*temporal\.dark"):
        find_borders(dark, CropSettings())


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, [LEFT, TOP, 160, 120]),
        ({"borders": False}, [0, 0, WIDTH, HEIGHT]),
        ({"width": 100, "height": 80}, [46, 32, 100, 80]),
        ({"height": 60}, [LEFT, 42, 160, 60]),
        ({"rectangle": "5, 6,100,90"}, [5, 6, 100, 90]),
        ({"rectangle": "5,6,100,90", "width": 50}, [30, 6, 50, 90]),
    ],
)
def test_the_crop_is_as_asked(settings: dict[str, object], expected: list[int]) -> None:
    made = chosen_rectangle(borders(), CropSettings(**settings))
    assert made.to_list() == expected
    assert made.cut(np.zeros((HEIGHT, WIDTH, 3))).shape == (expected[3], expected[2], 3)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"width": 480, "height": 360}, "Nothing of 480 x 360 .*expected at most 160 x 120, which is left of 192"),
        ({"rectangle": "5,6,100"}, "no part of the frame; expected left,top,width,height inside 192 x 144"),
        ({"rectangle": "100,6,100,20"}, "no part of the frame"),
        ({"width": 20}, "Too little of the frame is kept: 20 x 120 pixels; expected at least 32 x 32"),
    ],
)
def test_a_crop_that_cannot_be_is_refused(settings: dict[str, object], said: str) -> None:
    with pytest.raises(SettingsError, match=said):
        chosen_rectangle(borders(), CropSettings(**settings))
