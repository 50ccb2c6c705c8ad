"""A nadir flight over the town as in the paper on localisation: photos for a map, and queries between them.

Matzke, Maas and Eltner, "Evaluating Gaussian Splatting Maps for Absolute Visual Localization of UAVs", section 4.1:
two straight legs in opposite directions with a turn between them, 80 m above the ground at 8 m/s, 77 photos one
second apart for the map and the 76 between them as queries, positions by RTK and attitudes by an IMU.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, StageError, ToolkitError
from toolkit.files import atomic_folder, read_json, write_json
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.progress import Progress, silent, track
from toolkit.samples.make import ORIGIN, save_picture
from toolkit.samples.nadir_path import (
    NadirCameraSettings,
    NadirPathSettings,
    nadir_camera,
    nadir_poses,
    require_clear,
)
from toolkit.samples.nadir_sensors import NadirSensorSettings, draw_boresight, nadir_readings
from toolkit.samples.sensors import SensorReading, prior_of
from toolkit.samples.town import Town, TownSettings, build_town, render_view
from toolkit.scene import Frame, Scene
from toolkit.scene.folder import read_scene, write_scene
from toolkit.scene.scene import Split
from toolkit.settings import Group, Settings

KIND = "nadir"
"""What the record of such a sample calls it."""
RECORD = "sample.json"

_TOWN, _FLIGHT, _PRIORS, _BORESIGHT = range(4)  # streams of random numbers, so that one does not shift another


class NadirFlightSettings(Settings):
    """Two legs and a turn over a town, looking straight down: photos for a map and queries between them."""

    town = Group(TownSettings(extent=430.0, buildings=190, trees=450))
    path = Group(NadirPathSettings())
    camera = Group(NadirCameraSettings())
    sensors = Group(NadirSensorSettings())


def make_nadir_flight(
    folder: Path, settings: NadirFlightSettings, *, seed: int = 0, progress: Progress = silent
) -> Scene:
    """Fly over a town and write what the camera saw, unless the folder holds this very flight already.

    The folder holds the scene (true poses, camera, priors; no points), its pictures in ``images/`` (with the priors
    in their tags) and ``sample.json``. Frames are in order of time: photos of the map, split ``"train"``, and the
    queries between them, split ``"test"``. It appears whole or not at all. There are no depth maps:
    :func:`toolkit.samples.surfaces.true_depth` casts rays. A picture of 640 x 480 pixels takes a second or less.

    Every frame has a prior: the position with its standard deviation, and the attitude by the IMU, which is off by
    a constant boresight and an angle that varies slowly (:mod:`toolkit.samples.nadir_sensors`).

    Returns
    -------
    Scene
        As read back from ``folder``. Its world is metres east, north, up from the middle of the town.

    Raises
    ------
    StageError
        When the folder holds something else, the path is too short for its turn or blocked, or the town has too
        few plots.
    SettingsError
        When settings contradict one another.
    RunError
        When the disk is full or may not be written.
    """
    record = {"kind": KIND, "seed": seed, "settings": settings.to_dict()}
    if holds(folder, record):
        return read_scene(folder)
    town = town_of_nadir(settings, seed)
    poses = true_poses(settings, town, seed)
    times = settings.path.interval * np.arange(len(poses))
    readings = readings_of(settings, poses, times, seed)
    splits: list[Split] = ["train" if number % 2 == 0 else "test" for number in range(len(poses))]
    return write_nadir(folder, settings, town, poses, readings, splits, record, progress=progress)


def town_of_nadir(settings: NadirFlightSettings, seed: int, *others: int) -> Town:
    """Return the town that a flight with these settings and this seed is over; ``others`` name different towns."""
    return build_town(settings.town, np.random.default_rng([seed, _TOWN, *others]))


def true_poses(settings: NadirFlightSettings, town: Town, seed: int) -> list[RigidTransform]:
    """Return the true ``cam_from_world`` of each frame of the flight, photos of the map and queries in turn.

    Raises
    ------
    StageError
        When the path is too short for its turn, or blocked.
    """
    poses = nadir_poses(settings.path, town, np.random.default_rng([seed, _FLIGHT]))
    require_clear(town, poses)
    return poses


def readings_of(
    settings: NadirFlightSettings,
    poses: Sequence[RigidTransform],
    times: Sequence[float] | NDArray[np.float64],
    seed: int,
    *others: int,
) -> list[SensorReading]:
    """Return what the sensors say of poses; ``others`` name further flights of the same drone.

    The boresight is the same in all of them.
    """
    boresight = draw_boresight(settings.sensors, np.random.default_rng([seed, _BORESIGHT]))
    rng = np.random.default_rng([seed, _PRIORS, *others])
    return nadir_readings(poses, [float(time) for time in times], settings.sensors, rng, boresight=boresight)


def holds(folder: Path, record: dict[str, Any]) -> bool:
    """Return whether a folder holds the sample of ``record`` already; False where it is new or empty.

    Raises
    ------
    StageError
        Where it holds something else.
    """
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return False
    path = folder / RECORD
    if not path.is_file() or read_json(path) != record:
        raise StageError(
            f"{folder} is in the way",
            expected="a new or an empty folder, or the sample with these settings and this seed",
            todo="Choose another or move it away",
        )
    return True


def write_nadir(
    folder: Path,
    settings: NadirFlightSettings,
    town: Town,
    poses: Sequence[RigidTransform],
    readings: Sequence[SensorReading],
    splits: Sequence[Split],
    record: dict[str, Any],
    *,
    finish: Callable[[NDArray[np.uint8]], NDArray[np.uint8]] = lambda colour: colour,
    progress: Progress = silent,
) -> Scene:
    """Render a flight and write its folder, whole or not at all.

    Parameters
    ----------
    folder:
        New or empty.
    settings:
        Of the flight.
    town:
        What is seen.
    poses, readings, splits:
        Of each frame.
    record:
        For ``sample.json``.
    finish:
        What becomes of a picture (H, W, 3) before it is written.
    progress:
        Told of each picture.
    """
    camera = nadir_camera(settings.camera)
    frames = tuple(
        Frame(f"frame_{number:04d}.jpg", 1, pose, split=split, time=reading.time, prior=prior_of(reading))
        for number, (pose, reading, split) in enumerate(zip(poses, readings, splits, strict=True))
    )
    if folder.exists():
        folder.rmdir()
    with atomic_folder(folder) as temporary:
        pictures = temporary / "images"
        pictures.mkdir(parents=True)
        numbers = list(range(len(frames)))
        for number in track(numbers, "sample.render", progress):
            view = render_view(town, camera, poses[number], samples=settings.camera.samples)
            _save(finish(view.colour), pictures / frames[number].name, camera, readings[number], settings)
        write_scene(Scene(pictures, {1: camera}, frames, georeference=ORIGIN), temporary)
        write_json(temporary / RECORD, record)
    return read_scene(folder)


def flight_of_record(record: dict[str, Any], where: Path) -> tuple[NadirFlightSettings, int]:
    """Return settings of the flight and seed of what ``sample.json`` holds; ``where`` is its path, for the error.

    Raises
    ------
    DataError
        Where it is damaged.
    """
    try:
        return NadirFlightSettings.from_dict(record["settings"]), int(record["seed"])
    except (KeyError, TypeError, ValueError, ToolkitError) as error:
        raise DataError(f"{where} is damaged", expected="a nadir flight", found=str(error)) from error


def _save(
    colour: NDArray[np.uint8],
    path: Path,
    camera: ColmapCamera,
    reading: SensorReading,
    settings: NadirFlightSettings,
) -> None:
    sensors = settings.sensors
    save_picture(colour, path, camera, reading, tags=sensors.write_tags, rtk=sensors.rtk)
