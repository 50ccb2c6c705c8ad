"""Known cameras of the Middlebury benchmark."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from toolkit.errors import DataError
from toolkit.metrics.circle import fit_circle
from toolkit.scene.capture_folders import capture_folder
from toolkit.scene.dataset import open_capture
from toolkit.scene.middlebury import read_cameras

LINE = "a{0}.png 100 0 31.5 0 110 23.5 0 0 1 1 0 0 0 1 0 0 0 1 {0} 2 3"


def benchmark(folder: Path, lines: list[str] | None = None) -> Path:
    """Write three small pictures with cameras that look the same way."""
    (folder / "images").mkdir(parents=True)
    for number in range(3):
        Image.new("RGB", (64, 48), (number * 50, 10, 10)).save(folder / "images" / f"a{number}.png")
    written = ["3", *(LINE.format(number) for number in range(3))] if lines is None else lines
    (folder / "small_par.txt").write_text("\n".join(written) + "\n", encoding="ascii")
    return folder


def test_cameras_are_the_reference_and_nothing_that_a_method_sees(tmp_path: Path) -> None:
    capture = open_capture(benchmark(tmp_path))

    assert not capture.scene.registered
    assert capture.reference is not None
    last = capture.reference.frames[2]
    assert last.cam_from_world is not None
    np.testing.assert_allclose(last.cam_from_world.translation, [2, 2, 3])
    # Pixel centres at +0.5.
    assert capture.reference.camera_of(last).params == (100, 110, 32, 24)
    found = capture_folder(tmp_path, tmp_path)
    assert found is not None
    assert found.layout == "Middlebury"


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["4", LINE.format(0)], "cut off"),
        ([], "cut off"),
        (["1", "a0.png 1 2 3"], "line 2 is damaged"),
        (["1", LINE.format(0).replace("23.5", "x")], "line 2 is damaged"),
        (["1", LINE.format(0).replace("100 0 31.5", "nan 0 31.5")], "line 2 is damaged"),
        (["1", LINE.format(0).replace("100 0 31.5", "100 5 31.5")], "no camera of the benchmark"),
        (["1", LINE.format(0).replace("1 0 0 0 1 0 0 0 1 0", "2 0 0 0 1 0 0 0 1 0")], "no camera of the benchmark"),
        (["1", LINE.format(7)], "No camera in"),
    ],
)
def test_damaged_files_are_told(tmp_path: Path, lines: list[str], message: str) -> None:
    with pytest.raises(DataError, match=message):
        open_capture(benchmark(tmp_path, lines))


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="Cannot read"):
        read_cameras(tmp_path / "none_par.txt")


@pytest.mark.real
def test_the_temple_was_taken_from_a_ring(real_data: Path) -> None:
    capture = open_capture(real_data / "turntable_temple_ring", check=False)

    assert capture.reference is not None
    centres = capture.reference.centres()
    assert len(centres) == 47
    # Its README: centres 1.7 mm RMS about a ring; one of radius 0.56 m. The order of files is not that of the ring.
    fit = fit_circle(centres)
    assert fit.radius * np.hypot(fit.radius_spread, fit.out_of_plane_rms) < 0.003
