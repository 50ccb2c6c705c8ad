"""Data sets: procedural scenes with ground truth."""

from toolkit.samples.flights import FlightSettings, flight_camera, flight_poses
from toolkit.samples.make import SampleSettings, depth_path, make_sample, read_depth
from toolkit.samples.sensors import SensorSettings
from toolkit.samples.town import RenderedView, Town, TownSettings, build_town, render_view
from toolkit.samples.video import write_srt, write_video

__all__ = [
    "FlightSettings",
    "RenderedView",
    "SampleSettings",
    "SensorSettings",
    "Town",
    "TownSettings",
    "build_town",
    "depth_path",
    "flight_camera",
    "flight_poses",
    "make_sample",
    "read_depth",
    "render_view",
    "write_srt",
    "write_video",
]
