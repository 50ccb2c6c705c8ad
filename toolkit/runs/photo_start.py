"""Where the search for a photo's pose begins: said by a person, by the photo's sensors, or near its own pose."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from toolkit.errors import DataError, SettingsError
from toolkit.geometry.attitude import Attitude, cam_from_enu
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.starts import Start, offset_starts, scenario_starts
from toolkit.runs.photo_query import Photo
from toolkit.runs.view_render import ViewPose
from toolkit.runs.view_scene import ViewScene
from toolkit.scene import Frame, Scene

StartKind = Literal["prior", "own", "pose"]
#: Standard deviations of a pose that a person gives, in metres and degrees, unless they say otherwise.
POSITION_SIGMA, ROTATION_SIGMA_DEG = 10.0, 10.0


@dataclass(frozen=True, slots=True, eq=False)
class StartChoice:
    """How a photo's start is found.

    Attributes
    ----------
    kind:
        ``"prior"``: position and attitude by the photo's sensors. ``"own"``: the pose that the scene has for it,
        moved and turned, to try what the method can do. ``"pose"``: the one given.
    metres, degrees:
        Of ``"own"``: how far it is moved, in a mostly level direction, and turned.
    pose:
        Of ``"pose"``: ``cam_from_world``.
    position_sigma, rotation_sigma_deg:
        Of ``"pose"``: its standard deviations on each axis, in scene units and degrees.

    Raises
    ------
    SettingsError
        Where the pose is missing, or a standard deviation is negative or no number.
    """

    kind: StartKind = "prior"
    metres: float = 0.0
    degrees: float = 0.0
    pose: RigidTransform | None = None
    position_sigma: float = POSITION_SIGMA
    rotation_sigma_deg: float = ROTATION_SIGMA_DEG

    def __post_init__(self) -> None:
        if self.kind == "pose" and self.pose is None:
            raise SettingsError("There is no start pose", expected="one, or another start")
        for what, value in (("position", self.position_sigma), ("rotation", self.rotation_sigma_deg)):
            if math.isnan(value) or value < 0:
                raise SettingsError(
                    f"The start's standard deviation of the {what} cannot be used",
                    expected="0 or more",
                    found=str(value),
                )


def photo_start(scene: Scene, photo: Photo, choice: StartChoice, *, seed: int = 0) -> Start:
    """Return where the search for a photo begins.

    Parameters
    ----------
    scene:
        Of the run, in whose world the start is.
    seed:
        Of direction and axis of a moved start.

    Raises
    ------
    DataError
        Where the photo has no pose of its own, or no position and attitude by sensors, or the map's photos have
        none, from which the turn between sensors and camera is found.
    SettingsError
        For a start that is to be moved by less than nothing or turned by more than 180 degrees.
    """
    name = photo.query.name
    if choice.kind == "pose":
        assert choice.pose is not None  # or there is no such choice
        return Start(name, choice.pose, choice.position_sigma, choice.rotation_sigma_deg)
    if choice.kind == "own":
        if photo.truth is None:
            raise DataError(
                f"Photo '{name}' has no pose of its own",
                expected="a frame of the run's scene that has one",
                todo="Begin with another start",
            )
        alone = Frame(name, 0, photo.truth, "test")
        (start,) = offset_starts(_with(scene, photo, alone), choice.metres, choice.degrees, seed=seed)
        return start
    prior = photo.prior
    if prior is None or prior.position is None or prior.rotation is None:
        raise DataError(
            f"Photo '{name}' has no start by sensors",
            expected="its position (GPS) and its attitude (gimbal or IMU)",
            found="neither" if prior is None else "no position" if prior.position is None else "no attitude",
            todo="Give a start pose",
        )
    # A name that no frame has: the photo may be one of the map's. Its pose plays no part but to be there.
    asked = Frame(f"{name}?", 0, RigidTransform.identity(), "test", prior=prior)
    (start,) = scenario_starts("calc-test", _with(scene, photo, *scene.of_split("train"), asked), seed=seed)
    return dataclasses.replace(start, name=name)


def parse_start(text: str, position_sigma: float, rotation_sigma_deg: float) -> StartChoice:
    """Return the start that a command line names: ``prior``, ``own`` or ``E,N,U,HEADING,PITCH``.

    Parameters
    ----------
    text:
        Metres east, north and up in the run's world, degrees clockwise from north and above the horizon (-90 looks
        straight down; then the heading is that of the picture's upper edge).
    position_sigma, rotation_sigma_deg:
        Of a pose.

    Raises
    ------
    SettingsError
        Where the text is none of these.
    """
    if text in ("prior", "own"):
        return StartChoice("prior" if text == "prior" else "own")
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 5 or not all(map(math.isfinite, values)):
        raise SettingsError(
            "The start cannot be read",
            expected="prior, own, or five numbers E,N,U,HEADING,PITCH (metres and degrees)",
            found=repr(text),
        )
    return StartChoice(
        "pose",
        pose=looking_from(values[:3], values[3], values[4]),
        position_sigma=position_sigma,
        rotation_sigma_deg=rotation_sigma_deg,
    )


def standing_start(
    view: ViewScene, standing: ViewPose, position_sigma: float, rotation_sigma_deg: float
) -> StartChoice:
    """Return the start where a viewer of a run stands. Raises :class:`SettingsError` as :class:`StartChoice`."""
    world_from_cam = RigidTransform.from_quaternion(standing.rotation, standing.position + view.centre)
    return StartChoice(
        "pose",
        pose=world_from_cam.inverse(),
        position_sigma=position_sigma,
        rotation_sigma_deg=rotation_sigma_deg,
    )


def looking_from(position: list[float], heading: float, pitch: float) -> RigidTransform:
    """Return ``cam_from_world`` of a camera without roll at (3,) metres east, north and up."""
    rotation = cam_from_enu(Attitude(heading, pitch))
    return RigidTransform(rotation, -rotation @ np.array(position))


def _with(scene: Scene, photo: Photo, *frames: Frame) -> Scene:
    """Return a scene of these frames; cameras play no part in starts."""
    cameras = dict.fromkeys([frame.camera_id for frame in frames], photo.query.camera)
    return scene.replace(cameras=cameras, frames=frames, points=None)
