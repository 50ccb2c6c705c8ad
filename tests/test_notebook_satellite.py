"""What the notebook on satellites leans on: its city, its table, its stand-in for a network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from toolkit.files import write_json
from toolkit.notebook import sample_folder, satellite_measures, simulated_predictions
from toolkit.poses.feedforward.predictions_file import read_predictions
from toolkit.poses.feedforward.simulated import SimulatedNoiseSettings
from toolkit.runs.folder import RunFolder
from toolkit.samples.city import CitySettings, open_city

pytest.importorskip("rasterio", reason="satellite pictures need rasterio (extra 'geo')")
TINY = {"plan.size": 32.0, "plan.tallest": 20.0, "orbit.views": 3, "imager.ground_sampling": 1.0}


def test_a_city_is_made_once_and_a_simulated_prediction_is_of_the_chosen_pictures(tmp_path: Path) -> None:
    settings = CitySettings().replace(TINY)
    folder = sample_folder(tmp_path, settings)
    made = (folder / "sample.json").stat().st_mtime_ns
    assert sample_folder(tmp_path, settings) == folder
    assert (folder / "sample.json").stat().st_mtime_ns == made
    city = open_city(folder)
    names = [city.views[2].name, city.views[0].name]
    path = simulated_predictions(tmp_path, city, names, SimulatedNoiseSettings())
    said = read_predictions(path)
    assert sorted(said.names) == sorted(names)
    assert said.provider.startswith("simulated")
    assert said.depth.shape == (2, 32, 32)
    assert simulated_predictions(tmp_path, city, names[::-1], SimulatedNoiseSettings()) == path
    less = simulated_predictions(tmp_path, city, names, SimulatedNoiseSettings(depth=1.0))
    assert less != path
    assert not np.array_equal(said.depth, read_predictions(less).depth)


def test_only_what_a_run_on_satellite_pictures_has_is_in_its_table(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run")
    times = [{"name": n, "seconds": s, "reused": False} for n, s in (("heights", 3.6), ("measure", 9.0))]
    metrics = {"sfm.images": 16.0, "dsm.within_1m": 0.75, "test.psnr": None}
    write_json(run.result_file, {"metrics": metrics, "times": times, "reports": {}, "test_views": []})
    assert satellite_measures(run) == {"views": 16.0, "within 1 m [%]": 75.0, "time [s]": 4}
