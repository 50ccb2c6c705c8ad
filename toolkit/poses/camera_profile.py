"""A camera's intrinsics, found once and kept in a file that later flights use.

The paper leaves the search for intrinsics out of its times and proposes to do it once for each drone (A-3DGS,
section 5.3); :func:`toolkit.poses.calibrate.calibrate` does it and says how long it took.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

from toolkit.errors import DataError
from toolkit.files import read_json, write_json
from toolkit.geometry.cameras import Camera, ColmapCamera
from toolkit.scene import Scene
from toolkit.scene.colmap_model import checked_camera
from toolkit.scene.records import field, finite
from toolkit.settings import Settings

S = TypeVar("S", bound=Settings)

#: Ending of profiles that :func:`find_profile` looks at.
PROFILE_ENDING = ".camera.json"

_FORMAT = "sightline-camera"
_VERSION = 1
# EXIF's focal length is good to a few percent; another lens of a drone differs by half and more.
_FOCAL_APART = 0.2
_REFINED = ("refine_focal", "refine_distortion", "refine_principal_point")


@dataclass(frozen=True, slots=True)
class CameraProfile:
    """Intrinsics of a camera, and where they are from.

    Attributes
    ----------
    name:
        Make and model as EXIF tells them, or what the user calls it.
    model:
        COLMAP's name of the camera model.
    width, height:
        Size of the pictures in pixels.
    params:
        In COLMAP's order, in pixels.
    focal_sigma:
        Relative standard deviation of the focal length by the adjustment, of independent residuals: the true error
        is larger.
    reprojection_error:
        Mean over the points, in pixels.
    photos:
        How many pictures it was found from.
    source:
        Name of their folder.
    created:
        Date and time (ISO 8601, UTC).
    seconds:
        How long it took.

    Raises
    ------
    DataError
        For intrinsics that are none of COLMAP's, and numbers out of range.
    """

    name: str
    model: str
    width: int
    height: int
    params: tuple[float, ...]
    focal_sigma: float
    reprojection_error: float
    photos: int
    source: str
    created: str
    seconds: float

    def __post_init__(self) -> None:
        checked_camera(self.model, self.width, self.height, list(self.params), f"Profile '{self.name}'")
        if not self.name.strip():
            raise DataError("A camera profile has no name", expected="make and model, or a name of your own")
        for name in ("focal_sigma", "reprojection_error", "seconds"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise DataError(
                    f"{name} of camera profile '{self.name}' is out of range",
                    expected="a number from 0",
                    found=str(getattr(self, name)),
                )
        if self.photos < 1:
            raise DataError(
                f"photos of camera profile '{self.name}' is out of range",
                expected="a whole number from 1",
                found=str(self.photos),
            )

    @property
    def camera(self) -> ColmapCamera:
        """The camera at the size of the profile, with a focal length that counts as measured."""
        return ColmapCamera(self.model, self.width, self.height, self.params, prior_focal_length=True)

    def fits(self, width: int, height: int) -> bool:
        """Whether pictures of this size have the profile's aspect ratio, to the rounding of a pixel."""
        return abs(width * self.height - height * self.width) <= max(self.width, self.height)

    def camera_for(self, width: int, height: int) -> ColmapCamera:
        """Return the camera of the same pictures resampled to ``width`` x ``height`` pixels.

        A size cannot tell pictures that use another part of the sensor: a video mode that crops needs a profile of
        its own.

        Raises
        ------
        DataError
            For another aspect ratio: such pictures are cropped, nobody knows where.
        """
        if not self.fits(width, height):
            raise DataError(
                f"Camera profile '{self.name}' does not fit pictures of {width} x {height} px",
                expected=f"the aspect ratio of {self.width} x {self.height} px",
                found=f"{width / height:.4f} instead of {self.width / self.height:.4f}",
                todo="Calibrate with pictures of this format (toolkit calibrate)",
            )
        return self.camera.scaled(width, height)


def write_profile(profile: CameraProfile, path: Path) -> None:
    """Write a profile as JSON in one step. Raises :class:`~toolkit.errors.RunError` where it cannot be written."""
    write_json(path, {"format": _FORMAT, "version": _VERSION, **dataclasses.asdict(profile)})


def read_profile(path: Path) -> CameraProfile:
    """Return the profile in a file.

    Raises
    ------
    DataError
        Where it is missing, no profile, of another version or damaged; the message names the file and the key.
    """
    record = read_json(path)
    kind = field(record, "format", str, str(path)), field(record, "version", int, str(path))
    if kind != (_FORMAT, _VERSION):
        raise DataError(
            f"Cannot read {path}",
            expected=f"a camera profile: format '{_FORMAT}', version {_VERSION}",
            found=f"format '{kind[0][:40]}', version {kind[1]}",
            todo="Make one with toolkit calibrate",
        )
    where = str(path)

    def number(name: str) -> float:
        return finite(field(record, name, (int, float), where), f"{name} of {where}")

    params = [finite(value, f"params of {where}") for value in field(record, "params", list, where)]
    created = field(record, "created", str, where)
    try:
        datetime.fromisoformat(created)
    except ValueError as error:
        raise DataError(f"created in {where} is no date", found=repr(created[:40])) from error
    values: dict[str, Any] = {
        name: field(record, name, kind_of, where)
        for name, kind_of in (
            ("name", str),
            ("model", str),
            ("width", int),
            ("height", int),
            ("photos", int),
            ("source", str),
        )
    }
    for name in ("focal_sigma", "reprojection_error", "seconds"):
        values[name] = number(name)
    try:
        return CameraProfile(params=tuple(params), created=created, **values)
    except DataError as error:
        raise DataError(f"{path} holds no camera profile", found=str(error).rstrip(".")) from error


def find_profile(folder: Path, name: str, width: int, height: int) -> CameraProfile:
    """Return the profile of a camera among the ``*.camera.json`` files of a folder.

    Of several with its name and aspect ratio the one with the nearest width, of these the newest.

    Parameters
    ----------
    folder:
        Of profiles.
    name:
        Make and model; capitals do not matter.
    width, height:
        Of the pictures.

    Raises
    ------
    DataError
        Where there is none, or one is damaged; the message tells which there are.
    """
    if not folder.is_dir():
        raise DataError(f"Folder {folder} is missing", expected="a folder with camera profiles")
    known = [read_profile(path) for path in sorted(folder.glob(f"*{PROFILE_ENDING}"))]
    wanted = name.strip().casefold()
    fitting = [one for one in known if one.name.strip().casefold() == wanted and one.fits(width, height)]
    if not fitting:
        there = ", ".join(f"'{one.name}' {one.width} x {one.height}" for one in known)
        raise DataError(
            f"No profile in {folder} is of camera '{name}' with pictures of {width} x {height} px",
            expected=f"a file *{PROFILE_ENDING} of this camera and aspect ratio",
            found=there or "no profile",
            todo="Make one with toolkit calibrate, or name the file",
        )
    return max(fitting, key=lambda one: (-abs(one.width - width), datetime.fromisoformat(one.created).timestamp()))


def with_profile(scene: Scene, profile: CameraProfile) -> Scene:
    """Return the scene with the profile's intrinsics for all of its cameras, scaled to their pictures.

    Structure from motion still refines them unless :func:`with_fixed_cameras` or the user says no.

    Raises
    ------
    DataError
        For pictures of another aspect ratio, or whose measured focal length (EXIF) is off by more than a fifth:
        those are of another lens.
    """
    cameras: dict[int, Camera] = {}
    for number, camera in scene.cameras.items():
        made = profile.camera_for(camera.width, camera.height)
        _check_lens(profile, made, camera)
        cameras[number] = made
    return scene.replace(cameras=cameras)


def _check_lens(profile: CameraProfile, made: ColmapCamera, camera: Camera) -> None:
    if not (isinstance(camera, ColmapCamera) and camera.prior_focal_length):
        return
    told, found = camera.to_pycolmap().mean_focal_length(), made.to_pycolmap().mean_focal_length()
    if abs(found / told - 1.0) > _FOCAL_APART:
        raise DataError(
            f"Camera profile '{profile.name}' is of another lens or zoom than the pictures",
            expected=f"a focal length near {told:.0f} px, as the pictures tell",
            found=f"{found:.0f} px",
            todo="Calibrate with pictures of this lens (toolkit calibrate)",
        )


def with_fixed_cameras(settings: S) -> S:
    """Return a recipe's settings by which no stage refines known intrinsics.

    That is with every ``refine_focal``, ``refine_distortion`` and ``refine_principal_point`` set to no.
    """
    return settings.replace({name: False for name, _ in settings.items() if name.rpartition(".")[2] in _REFINED})
