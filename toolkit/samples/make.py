"""A sample: pictures of a flight over the town, with exact poses, depth maps and surface points."""

from __future__ import annotations

import shutil
import uuid
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from toolkit.errors import DataError, StageError
from toolkit.files import disk_errors, write_json
from toolkit.geometry.cameras import Camera, ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.optional import require
from toolkit.progress import Progress, silent, track
from toolkit.samples.flights import FlightSettings, flight_camera, flight_poses
from toolkit.samples.sensors import SensorReading, SensorSettings, prior_of, read_sensors, tags_of
from toolkit.samples.town import Material, RenderedView, Town, TownSettings, build_town, render_view
from toolkit.samples.video import write_srt, write_video
from toolkit.scene import Frame, Georeference, Points, Scene
from toolkit.scene.folder import read_scene, write_scene
from toolkit.scene.tag_writer import exif_block, xmp_packet
from toolkit.settings import Boolean, Group, Integer, Settings

ORIGIN = Georeference(latitude=48.0, longitude=9.0, altitude=600.0)
"""Where the town is said to lie."""

_JPEG_QUALITY = 92
_TEST_EVERY = 8
_TOWN, _FLIGHT, _PRIORS, _POINTS = range(4)  # streams of random numbers, so that one does not shift another


class SampleSettings(Settings):
    """A town and a flight over it."""

    town = Group(TownSettings())
    flight = Group(FlightSettings())
    sensors = Group(SensorSettings())
    points = Integer(4000, bounds=(0, 1000000), doc="Number of surface points in the true scene, at most.")
    video = Boolean(False, doc="Also write the pictures as video.mp4 and the sensors' readings as video.srt.")


def make_sample(folder: Path, settings: SampleSettings, *, seed: int = 0, progress: Progress = silent) -> Scene:
    """Fly over a town and write what the camera saw, with the truth, to a scene folder.

    The folder holds the scene (poses, camera, priors, surface points; every eighth frame is a test frame), its
    pictures in ``images/`` (with the priors in their tags, as a drone writes them), for each frame a depth map in
    ``depth/<frame name>.npz`` (see :func:`read_depth`) and ``sample.json`` with settings and seed. It appears whole
    or not at all. The same settings and seed give the same files on the same machine. With ``video`` there is the
    flight as ``video.mp4`` too, in real time, and the priors as DJI's subtitles in ``video.srt``.

    Returns
    -------
    Scene
        As read back from ``folder``. Its world is metres east, north, up from the middle of the town.

    Raises
    ------
    StageError
        When ``folder`` exists and is not empty, or the flight is blocked.
    RunError
        When the disk is full or may not be written.
    MissingDependencyError
        When a video is wanted and PyAV is missing.
    """
    if settings.video:
        require("av")  # before the work of rendering
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise StageError(
            f"{folder} is in the way", expected="a new or an empty folder", todo="Choose another or move it away"
        )
    town = town_of_sample(settings, seed)
    poses = flight_poses(settings.flight, town, np.random.default_rng([seed, _FLIGHT]))
    temporary = folder.with_name(f".{folder.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        with disk_errors(folder, "writing the sample to"):
            (temporary / "images").mkdir(parents=True)
            (temporary / "depth").mkdir()
            scene = _fly(temporary, town, poses, settings, seed, progress)
            write_scene(scene, temporary)
            if settings.video:
                rate = 1 / settings.flight.frame_interval
                write_video(scene, temporary / "video.mp4", frames_per_second=rate, progress=progress)
                write_srt(scene, temporary / "video.srt", frames_per_second=rate)
            write_json(temporary / "sample.json", {"seed": seed, "settings": settings.to_dict()})
            if folder.exists():
                folder.rmdir()
            temporary.rename(folder)
    finally:
        if temporary.exists():
            shutil.rmtree(temporary)
    return read_scene(folder)


def town_of_sample(settings: SampleSettings, seed: int) -> Town:
    """Return the town of a sample that was made with ``settings`` and ``seed``."""
    return build_town(settings.town, np.random.default_rng([seed, _TOWN]))


def depth_path(folder: Path, frame: Frame) -> Path:
    """Return where the depth map of ``frame`` lies in a sample's folder."""
    return folder / "depth" / f"{frame.name}.npz"


def read_depth(folder: Path, frame: Frame) -> NDArray[np.float32]:
    """Return the true depth map (H, W) of a frame of a sample.

    Values are the camera depth (z) in metres at pixel centres, exact to float32, and 0 where the sky is seen.

    Raises
    ------
    DataError
        When the file is missing or damaged.
    """
    path = depth_path(folder, frame)
    try:
        with path.open("rb") as handle, np.load(handle, allow_pickle=False) as stored:
            depth: NDArray[np.float32] = stored["depth"]
    except (OSError, ValueError, TypeError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError(
            f"Cannot read the depth map {path}", expected="an array 'depth'", found=str(error)
        ) from error
    return depth


def view_points(
    view: RenderedView, camera: Camera, cam_from_world: RigidTransform, pixels: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the world points (N, 3) at the centres of ``pixels`` (N, 2), column and row, of a rendered view."""
    origins, directions = camera.ray(pixels + 0.5)
    depth = view.depth[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    in_camera = origins + directions * (depth / directions[:, 2])[:, None]
    return cam_from_world.inverse().apply(in_camera)


def _fly(
    folder: Path, town: Town, poses: list[RigidTransform], settings: SampleSettings, seed: int, progress: Progress
) -> Scene:
    """Write pictures and depth maps below ``folder`` and return the true scene."""
    camera = flight_camera(settings.flight)
    readings = read_sensors(
        poses, settings.sensors, np.random.default_rng([seed, _PRIORS]), interval=settings.flight.frame_interval
    )
    chooser = np.random.default_rng([seed, _POINTS])
    frames: list[Frame] = []
    clouds: list[tuple[NDArray[np.float64], NDArray[np.uint8]]] = []
    share = -(-settings.points // len(poses))
    for number, pose in enumerate(track(poses, "sample.render", progress)):
        view = render_view(town, camera, pose, samples=settings.flight.samples)
        frame = Frame(
            name=f"frame_{number:04d}.jpg",
            camera_id=1,
            cam_from_world=pose,
            time=readings[number].time,
            prior=prior_of(readings[number]),
        )
        save_picture(
            view.colour,
            folder / "images" / frame.name,
            camera,
            readings[number],
            tags=settings.sensors.write_tags,
            rtk=settings.sensors.rtk,
        )
        np.savez_compressed(depth_path(folder, frame), depth=view.depth)
        clouds.append(_sample_points(view, camera, pose, town.settings.extent, share, chooser))
        frames.append(frame)
    xyz = np.concatenate([cloud[0] for cloud in clouds])[: settings.points]
    rgb = np.concatenate([cloud[1] for cloud in clouds])[: settings.points]
    return Scene(
        image_dir=folder / "images",
        cameras={1: camera},
        frames=tuple(frames),
        points=Points(xyz, rgb),
        georeference=ORIGIN,
    ).with_every_nth_as_test(_TEST_EVERY)


def save_picture(
    colour: NDArray[np.uint8], path: Path, camera: ColmapCamera, reading: SensorReading, *, tags: bool, rtk: bool
) -> None:
    """Write a picture (H, W, 3); with ``tags`` the reading is in them, with ``rtk`` the position's sigma, too."""
    metadata: dict[str, Any] = {}
    if tags:
        told = tags_of(reading, ORIGIN, focal=camera.params[0], rtk=rtk)
        metadata = {"exif": exif_block(told, camera.width, camera.height), "xmp": xmp_packet(told)}
    Image.fromarray(colour).save(path, quality=_JPEG_QUALITY, subsampling=0, **metadata)


def _sample_points(
    view: RenderedView,
    camera: Camera,
    pose: RigidTransform,
    reach: float,
    count: int,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return up to ``count`` surface points (N, 3) and colours (N, 3) within ``reach`` of the origin, no glass."""
    usable = np.argwhere((view.depth > 0) & (view.material != Material.GLASS))[:, ::-1]
    chosen = usable[rng.permutation(len(usable))[: 3 * count]]
    xyz = view_points(view, camera, pose, chosen)
    near = np.flatnonzero(np.linalg.norm(xyz[:, :2], axis=1) < reach)[:count]
    return xyz[near], view.colour[chosen[near, 1], chosen[near, 0]]
