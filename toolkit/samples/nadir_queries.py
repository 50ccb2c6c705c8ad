"""Further queries for the map of a nadir flight: other light, heights and places, a descent, bad pictures.

What the paper on localisation left open (Matzke, Maas and Eltner, section 5), and pictures that must not be found.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, StageError, ToolkitError
from toolkit.geometry.rigid import RigidTransform
from toolkit.progress import Progress, silent
from toolkit.samples.flights import tops
from toolkit.samples.nadir_flight import (
    KIND,
    RECORD,
    NadirFlightSettings,
    flight_of_record,
    holds,
    readings_of,
    town_of_nadir,
    true_poses,
    write_nadir,
)
from toolkit.samples.nadir_path import nadir_path, require_clear, rotated_to_world, shaken_poses
from toolkit.samples.town import Town
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene
from toolkit.scene.scene import Split
from toolkit.settings import Choice, Group, Integer, Number, Settings

Array = NDArray[np.float64]

KINDS = ("sun", "height", "descent", "town", "fields", "blurred", "black")
"""The kinds of queries; those over another town and over the fields are outside the map."""

_DESCENT, _READINGS = 4, 5  # streams of random numbers after those of the flight
_PLACES = 400  # tried for a descent
_HEADROOM = 1.5  # metres that a descent keeps from what stands below it
_FIELDS = 500.0  # metres from the edge of the town to the middle of a flight over the fields
_ABOVE_ALL = 500.0


class NadirQuerySettings(Settings):
    """Which queries are taken. All but the descent are taken where the flight took its queries."""

    kind = Choice(
        "sun",
        choices=KINDS,
        doc="sun: in another light; height: from another height; descent: straight down over one place; town: over "
        "another town; fields: away from the town; blurred and black: pictures that are spoiled.",
    )
    frames = Integer(
        0, bounds=(0, 5000), unit="photos", doc="Evenly from all, at most as many as there are; 0: all of them."
    )
    sun_azimuth = Number(250.0, bounds=(0.0, 360.0), unit="deg", doc="sun: its direction, clockwise from north.")
    sun_elevation = Number(25.0, bounds=(5.0, 90.0), unit="deg", doc="sun: its height above the horizon.")
    exposure = Number(
        0.0, bounds=(-4.0, 4.0), unit="EV", doc="sun: how much lighter the pictures are; 1 doubles the light."
    )
    warmth = Number(
        0.0, bounds=(-0.9, 0.9), doc="sun: white balance; this share more red and less blue, below 0 the reverse."
    )
    height = Number(120.0, bounds=(2.0, 300.0), unit="m", doc="height: above the ground of the town.")
    descent_frames = Integer(24, bounds=(2, 5000), unit="photos", doc="descent: number of pictures.")
    descent_from = Number(120.0, bounds=(2.0, 300.0), unit="m", doc="descent: height at which it starts.")
    descent_to = Number(
        5.0, bounds=(1.0, 300.0), unit="m", doc="descent: height at which it ends; each is lower by the same share."
    )
    descent_speed = Number(4.0, bounds=(0.1, 20.0), unit="m/s", doc="descent: speed, which gives the times.")
    blur = Number(6.0, bounds=(0.1, 100.0), unit="px", doc="blurred: standard deviation of the Gaussian blur.")


class NadirQuerySampleSettings(Settings):
    """Queries over the town of a nadir flight: same seed and settings of the flight, same town."""

    flight = Group(NadirFlightSettings())
    queries = Group(NadirQuerySettings())


def make_nadir_queries(
    folder: Path,
    flight: NadirFlightSettings,
    settings: NadirQuerySettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
) -> Scene:
    """Take queries over the town of a flight and write them, unless the folder holds these very queries already.

    The folder is as :func:`toolkit.samples.nadir_flight.make_nadir_flight` writes it; every frame is split
    ``"test"``. Poses are true, in the world of the flight (over another town as if that one lay there). But for the
    descent, angles are those of the flight's own queries, and so are positions but for the height or the way to the
    fields. Errors of the sensors are drawn anew, the boresight is the same.

    Parameters
    ----------
    folder:
        New or empty.
    flight, seed:
        Of the flight: the same give the same town.
    settings:
        Which queries.
    progress:
        Told of each picture.

    Returns
    -------
    Scene
        As read back from ``folder``.

    Raises
    ------
    StageError
        When the folder holds something else, a camera has no room, a descent does not go down or finds no place.
    SettingsError
        When settings contradict one another.
    RunError
        When the disk is full or may not be written.
    """
    record = {"kind": KIND, "seed": seed, "settings": flight.to_dict(), "queries": settings.to_dict()}
    if holds(folder, record):
        return read_scene(folder)
    town = town_of_queries(flight, settings, seed)
    taken = (
        _descent(flight, settings, town, seed)
        if settings.kind == "descent"
        else _passed(flight, settings, town, seed)
    )
    require_clear(town, taken.poses)
    taken = taken.some(settings.frames)
    readings = readings_of(flight, taken.poses, taken.times, seed, _READINGS, KINDS.index(settings.kind))
    splits: list[Split] = ["test"] * len(readings)
    return write_nadir(
        folder,
        flight,
        town,
        taken.poses,
        readings,
        splits,
        record,
        finish=lambda colour: finished(colour, settings),
        progress=progress,
    )


def town_of_queries(flight: NadirFlightSettings, settings: NadirQuerySettings, seed: int) -> Town:
    """Return the town that queries are taken over: the flight's, in their light, or another one."""
    if settings.kind == "town":
        return town_of_nadir(flight, seed, 1)
    if settings.kind == "sun":
        light = {"town.sun_azimuth": settings.sun_azimuth, "town.sun_elevation": settings.sun_elevation}
        return town_of_nadir(flight.replace(light), seed)
    return town_of_nadir(flight, seed)


def town_of_record(folder: Path, record: dict[str, Any]) -> Town:
    """Return the town of the nadir flight or queries in a folder whose ``sample.json`` holds ``record``.

    Raises
    ------
    DataError
        Where it is damaged.
    """
    flight, seed = flight_of_record(record, folder / RECORD)
    if "queries" not in record:
        return town_of_nadir(flight, seed)
    try:
        settings = NadirQuerySettings.from_dict(record["queries"])
    except ToolkitError as error:
        raise DataError(f"{folder / RECORD} is damaged", expected="nadir queries", found=str(error)) from error
    return town_of_queries(flight, settings, seed)


def finished(colour: NDArray[np.uint8], settings: NadirQuerySettings) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) as the settings want it: in another exposure and white balance, blurred, or black.

    Light is changed in linear values of the sRGB curve.
    """
    if settings.kind == "black":
        return np.zeros_like(colour)
    if settings.kind == "blurred":
        from scipy.ndimage import gaussian_filter

        soft = gaussian_filter(colour.astype(np.float64), (settings.blur, settings.blur, 0.0), mode="nearest")
        return np.asarray(np.round(soft), np.uint8)
    if settings.kind != "sun" or (settings.exposure == 0.0 and settings.warmth == 0.0):
        return colour
    shown = colour / 255.0
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    gain = 2.0**settings.exposure * np.array([1.0 + settings.warmth, 1.0, 1.0 - settings.warmth])
    light = np.clip(linear * gain, 0.0, 1.0)
    curved = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(np.round(255.0 * curved), np.uint8)


@dataclass(frozen=True, slots=True)
class _Taken:
    """Where and when queries are taken."""

    poses: list[RigidTransform]
    times: Array

    def some(self, count: int) -> _Taken:
        """Return ``count`` of them, evenly from the first to the last; 0: all."""
        if count == 0 or count >= len(self.poses):
            return self
        chosen = np.round(np.linspace(0, len(self.poses) - 1, count)).astype(int)
        return _Taken([self.poses[number] for number in chosen], self.times[chosen])


def _passed(flight: NadirFlightSettings, settings: NadirQuerySettings, town: Town, seed: int) -> _Taken:
    """Return the queries of the flight itself, moved where the kind moves them."""
    own = town_of_nadir(flight, seed) if settings.kind == "town" else town  # its streets give the course
    poses = true_poses(flight, own, seed)[1::2]
    times = flight.path.interval * np.arange(1, flight.path.frames, 2)
    if settings.kind == "height":
        poses = _moved(poses, np.array([0.0, 0.0, settings.height - flight.path.height]))
    elif settings.kind == "fields":
        away = flight.town.extent / 2 + _FIELDS
        poses = _moved(poses, np.array([*rotated_to_world(town, np.array([[0.0, away]]))[0], 0.0]))
        centres = np.array([pose.centre for pose in poses])
        start = centres + np.array([0.0, 0.0, _ABOVE_ALL])
        land = start[:, 2] - town.cast(start, np.broadcast_to([0.0, 0.0, -1.0], start.shape)).distance
        poses = _moved(poses, np.array([0.0, 0.0, float(land.mean())]))
    return _Taken(poses, times)


def _moved(poses: Sequence[RigidTransform], shift: Array) -> list[RigidTransform]:
    return [dataclasses.replace(pose, translation=-pose.rotation @ (pose.centre + shift)) for pose in poses]


def _descent(flight: NadirFlightSettings, settings: NadirQuerySettings, town: Town, seed: int) -> _Taken:
    """Return a descent over a place below the first leg, heading as the flight did there."""
    top, bottom = settings.descent_from, settings.descent_to
    if top <= bottom:
        raise StageError(
            f"A descent from {top:g} m to {bottom:g} m does not go down",
            expected=f"descent_from above {bottom:g} m",
            todo="Raise descent_from or lower descent_to",
        )
    rng = np.random.default_rng([seed, _DESCENT])
    place, heading = _open_place(flight, town, bottom, rng)
    heights = np.geomspace(top, bottom, settings.descent_frames)
    centres = np.column_stack([np.tile(place, (len(heights), 1)), heights])
    poses = shaken_poses(flight.path, centres, np.tile(heading, (len(heights), 1)), rng)
    return _Taken(poses, (top - heights) / settings.descent_speed)


def _open_place(
    flight: NadirFlightSettings, town: Town, bottom: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return a place (2,) where nothing comes near to ``bottom`` metres of height, and the flight heading (2,)."""
    plane, heading = (rotated_to_world(town, part) for part in nadir_path(flight.path))
    leg = max(1, math.floor(len(plane) * 0.4))  # the turn is in the middle
    number = rng.integers(leg, size=_PLACES)
    aside = rng.uniform(-0.5, 0.5, size=_PLACES) * flight.path.leg_spacing
    right = np.stack([heading[:, 1], -heading[:, 0]], axis=1)
    places = plane[number] + aside[:, None] * right[number]
    room = 3 * flight.path.position_jitter
    high = tops(town, np.column_stack([places, np.full(_PLACES, bottom)]))
    free = np.flatnonzero(high + _HEADROOM + room < bottom)
    if not len(free):
        raise StageError(
            "There is no open place for a descent below the first leg",
            expected=f"one where all is {_HEADROOM + room:.1f} m below {bottom:g} m",
            found=f"{_PLACES} places, the lowest thing on one is {high.min():.1f} m high",
            todo="Raise descent_to or choose another seed",
        )
    return places[free[0]], heading[number[free[0]]]
