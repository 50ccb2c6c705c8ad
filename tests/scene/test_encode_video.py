"""Pictures become a video with as many frames, of their size and rate, or nothing at all."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from toolkit.errors import DataError, MissingDependencyError, SettingsError
from toolkit.scene.video import encode_video, frame_rate

av = pytest.importorskip("av", reason="PyAV is not installed: pip install 'sightline-toolkit[video]'")


def flat(count: int, width: int = 32, height: int = 24) -> list[NDArray[np.uint8]]:
    return [np.full((height, width, 3), 40 + 15 * i, np.uint8) for i in range(count)]


def test_every_picture_is_a_frame_of_its_brightness(tmp_path: Path) -> None:
    pictures = flat(9)
    assert encode_video(iter(pictures), tmp_path / "a.mp4", 12.5) == 9
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert float(container.streams.video[0].average_rate) == 12.5
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert [frame.shape for frame in frames] == 9 * [(24, 32, 3)]
    for frame, picture in zip(frames, pictures, strict=True):
        assert abs(frame.mean() - picture.mean()) < 6  # YUV of limited range, quantised


def test_odd_sides_are_continued_by_one(tmp_path: Path) -> None:
    encode_video(flat(2, 33, 21), tmp_path / "a.mp4", 25)
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert [(frame.width, frame.height) for frame in container.decode(video=0)] == 2 * [(34, 22)]


def test_no_pictures_and_two_sizes_are_refused_and_nothing_is_left(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="No pictures make no video; expected at least one picture"):
        encode_video([], tmp_path / "a.mp4", 25)
    with pytest.raises(
        DataError, match=r"Picture 1 of the video has another size.*expected \(24, 32, 3\); found \(32, 24, 3\)"
    ):
        encode_video([*flat(1), *flat(1, 24, 32)], tmp_path / "a.mp4", 25)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_asked_for_before_the_arguments_are_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never() -> Iterator[NDArray[np.uint8]]:
        pytest.fail("a picture was made")
        yield from flat(1)

    with pytest.raises(
        SettingsError, match="Frames per second are out of range; expected more than 0, at most 1000"
    ):
        encode_video(never(), tmp_path / "a.mp4", 0)
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'sightline-toolkit\[video\]'"):
        encode_video(never(), tmp_path / "a.mp4", 25)


def test_rates_are_fractions_that_the_file_holds() -> None:
    assert str(frame_rate(25)) == "25"
    assert str(frame_rate(29.97)) == "2997/100"
    with pytest.raises(SettingsError, match="expected at least 1/60000; found 1e-09"):
        frame_rate(1e-9)
