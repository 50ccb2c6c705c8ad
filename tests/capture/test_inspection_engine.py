"""Borders, mask and stop of the made-up engine are found; footage of a car has none of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_dilation
from turning import overlap

from toolkit.capture.borders import CropSettings, find_borders
from toolkit.capture.inspection import InspectionSettings, open_inspection
from toolkit.capture.sources import frame_source
from toolkit.capture.static_mask import StaticMaskSettings, find_static_mask
from toolkit.capture.still_frames import StillSettings, find_still_frames
from toolkit.capture.temporal import TemporalSettings, temporal_statistics
from toolkit.samples.engine import EngineSettings, make_engine

pytest.importorskip("av", reason="PyAV is not installed: pip install 'sightline-toolkit[video]'")
pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'sightline-toolkit[video]'")

BORDER = 8


def test_the_engines_casing_icon_border_and_stop_are_found(tmp_path: Path) -> None:
    settings = EngineSettings().replace(
        {
            "borescope.image_width": 160,
            "borescope.image_height": 120,
            "borescope.border": BORDER,
            "film.frames": 40,
            "film.stride": 2,
            "film.samples": 1,
            "film.noise": 2.0,
            "film.shake": 0.5,
            "film.pause_at": 13,
            "film.pause": 14,
            "points": 0,
        }
    )
    sample = make_engine(tmp_path / "engine", settings)
    made = open_inspection(sample.folder, tmp_path / "scene", InspectionSettings().replace({"rate": 0.0}))
    assert made.rectangle.to_list() == [BORDER, BORDER, 160, 120]
    assert made.stills is not None
    assert [(stop.first, stop.last) for stop in made.stills.stops] == [(14, 27)]
    truth = made.rectangle.cut(sample.static_mask)
    assert overlap(made.mask, truth)[0] > 0.97
    # In a picture as small as this the rims of the turning hub and of the blade tips stand nearly still, and parts
    # of them are masked; at 480 x 360 pixels hardly any are.
    assert overlap(made.mask, binary_dilation(truth, np.ones((3, 3)), iterations=8))[1] > 0.75
    assert made.mask.mean() < 0.25


@pytest.mark.real
def test_a_car_that_drives_has_nothing_static_and_no_border_or_stop(real_data: Path) -> None:
    source = frame_source(real_data / "video_kitti_03" / "video.mp4")
    frames = [frame.grey() for frame in source.frames(range(80))]
    statistics = temporal_statistics(frames, TemporalSettings())
    borders = find_borders(statistics, CropSettings())
    assert borders.rectangle.to_list() == [0, 0, 828, 250]
    assert not find_static_mask(statistics, StaticMaskSettings(), empty=borders.empty).mask.any()
    stills = find_still_frames(frames[:30], StillSettings())
    assert stills.stops == ()
    assert stills.unjudged == 0
