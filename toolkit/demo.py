"""The demonstration: a sample flight, one method run in two ways on it, the two laid side by side."""

from __future__ import annotations

from pathlib import Path

from toolkit.errors import RunError
from toolkit.progress import Progress
from toolkit.recipes.registry import find_recipe
from toolkit.runs.compare import Comparison, compare_runs
from toolkit.runs.launch import create_run, execute
from toolkit.samples.make import SampleSettings, make_sample

_RECIPE = "colmap-3dgs"

# A size that ends within about five minutes on two cores.
_SAMPLE = {
    "flight.frames": 32,
    "flight.width": 480,
    "flight.height_px": 360,
}
_SETTINGS = {
    "sift.max_features": 2048,
    "sift.first_octave": 0,
    "train.steps": 600,
    "train.max_side": 320,
}
_WAYS = {"exhaustive": {"pairs.method": "exhaustive"}, "spatial": {"pairs.method": "spatial"}}
