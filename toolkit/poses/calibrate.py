"""A camera's intrinsics from pictures of anything: structure from motion on a few of them (A-3DGS, section 5.3)."""

from __future__ import annotations

import time
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from toolkit.errors import CapabilityError, DataError, SettingsError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.features import SiftSettings
from toolkit.matching.match import MatchSettings
from toolkit.poses.adjust import focal_sigma
from toolkit.poses.camera_profile import CameraProfile
from toolkit.poses.pipeline import SfmPipelineSettings, sfm
from toolkit.poses.sfm import SfmSettings
from toolkit.poses.sfm_result import SfmResult
from toolkit.progress import Progress, silent
from toolkit.scene import Scene
from toolkit.scene.dataset import open_capture
from toolkit.scene.exif import read_tags
from toolkit.scene.photos import start_camera
from toolkit.scene.pictures import open_picture
from toolkit.settings import Choice, Group, Integer, Number, Settings, Text

_LEAST_PHOTOS = 3


class CalibrationSettings(Settings):
    """A camera's intrinsics from pictures."""

    camera_name = Text("", doc="What to call the camera; empty: make and model as the photos tell them.")
    camera_model = Choice(
        "SIMPLE_RADIAL",
        choices=(
            "SIMPLE_PINHOLE",
            "PINHOLE",
            "SIMPLE_RADIAL",
            "RADIAL",
            "OPENCV",
            "SIMPLE_RADIAL_FISHEYE",
            "RADIAL_FISHEYE",
            "OPENCV_FISHEYE",
        ),
        doc="COLMAP's camera model. One with more parameters than the lens needs makes poses worse.",
    )
    max_photos = Integer(
        40, bounds=(_LEAST_PHOTOS, 1000), unit="photos", doc="Of more, so many spread evenly are used."
    )
    exhaustive = Integer(
        40,
        bounds=(0, 1000),
        unit="photos",
        doc="Up to so many photos every pair is matched; of more, each with those that follow it.",
    )
    max_focal_sigma = Number(
        0.5,
        bounds=(0.001, 10.0),
        unit="%",
        doc="A focal length with a larger standard deviation counts as not determined.",
    )
    sift = Group(SiftSettings(), doc="Features")
    match = Group(MatchSettings(), doc="Matching and geometric verification")
    sfm = Group(SfmSettings(), doc="Incremental structure from motion")


def calibrate(
    scene: Scene,
    settings: CalibrationSettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
    work_dir: Path,
    source: str = "",
) -> CameraProfile:
    """Find the intrinsics of the camera that took most pictures of a scene.

    The focal length starts from what the pictures tell of it, or from 1.2 times the longer side; distortion starts
    from none, whatever the scene's cameras say.

    Parameters
    ----------
    scene:
        With pictures of anything with depth, from many sides. Poses and priors are not used.
    settings:
        As declared.
    seed:
        Of every random choice.
    progress:
        Told of every part; raises to cancel.
    work_dir:
        Folder for the databases of features and matches, which stay there.
    source:
        What to call the pictures in the profile; empty: the name of their folder.

    Raises
    ------
    SettingsError
        Where the focal length is not to be refined, or positions are to be used: the pictures alone decide.
    DataError
        Where the camera has no name, there are too few pictures, or as the parts do.
    StageError
        Where the pictures do not determine the focal length, or as the parts do.
    """
    start = time.perf_counter()
    _check(settings)
    chosen = _one_camera(scene, settings)
    name = settings.camera_name.strip() or camera_name(chosen)
    if not name:
        raise DataError(
            f"The photos in {scene.image_dir} do not tell make and model of their camera",
            expected="EXIF tags, or a name",
            todo="Give it a name with camera_name",
        )
    method = "exhaustive" if len(chosen) <= settings.exhaustive else "sequential"
    steps = SfmPipelineSettings().replace(
        {"sift": settings.sift, "match": settings.match, "sfm": settings.sfm, "pairs.method": method}
    )
    found = sfm(chosen, steps, work_dir=work_dir, seed=seed, progress=progress).sfm
    sigma = _focal_sigma(found, settings)
    (camera,) = found.scene.cameras.values()
    assert isinstance(camera, ColmapCamera)
    return CameraProfile(
        name=name,
        model=camera.model,
        width=camera.width,
        height=camera.height,
        params=camera.params,
        focal_sigma=sigma,
        reprojection_error=found.mean_reprojection_error,
        photos=len(found.scene.registered),
        source=source or scene.image_dir.name,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        seconds=time.perf_counter() - start,
    )


def calibrate_folder(
    folder: Path, settings: CalibrationSettings, *, seed: int = 0, progress: Progress = silent, work_dir: Path
) -> CameraProfile:
    """Calibrate from a folder that :func:`~toolkit.scene.dataset.open_capture` opens; else as :func:`calibrate`."""
    _check(settings)
    scene = open_capture(folder, check=False).scene
    name = folder.resolve().name
    return calibrate(scene, settings, seed=seed, progress=progress, work_dir=work_dir, source=name)


def camera_name(scene: Scene) -> str:
    """Return make and model that the scene's first picture tells, or the empty text.

    Raises
    ------
    DataError
        Where there is no picture, or it is damaged.
    """
    if not scene.frames:
        raise DataError("The scene has no frames", expected="at least one picture")
    with open_picture(scene.image_path(scene.frames[0])) as picture:
        return read_tags(picture).camera


def _check(settings: CalibrationSettings) -> None:
    for name, wanted, why in (
        ("refine_focal", True, "the focal length is what is looked for"),
        ("use_positions", False, "with GPS a wrong focal length hides behind a wrong height"),
    ):
        if getattr(settings.sfm, name) is not wanted:
            raise SettingsError(
                f"Setting 'sfm.{name}' does not serve a calibration: {why}",
                expected=str(wanted).lower(),
                found=str(not wanted).lower(),
            )


def _one_camera(scene: Scene, settings: CalibrationSettings) -> Scene:
    """Return evenly spread frames of the camera with most of them, which starts with the wanted model."""
    frames = scene.frames
    if frames:
        number = Counter(frame.camera_id for frame in frames).most_common(1)[0][0]
        frames = tuple(frame for frame in frames if frame.camera_id == number)
    if len(frames) < _LEAST_PHOTOS:
        raise DataError(
            "There are too few pictures of one camera to calibrate it",
            expected=f"at least {_LEAST_PHOTOS}, better 20",
            found=str(len(frames)),
        )
    camera = scene.cameras[frames[0].camera_id]
    if not isinstance(camera, ColmapCamera):
        raise CapabilityError(
            "This camera cannot be calibrated",
            expected="a central camera of one of COLMAP's models",
            found=type(camera).__name__,
        )
    focal = camera.to_pycolmap().mean_focal_length() if camera.prior_focal_length else None
    first = start_camera(settings.camera_model, camera.width, camera.height, focal)
    rows = np.unique(np.linspace(0, len(frames) - 1, min(settings.max_photos, len(frames))).round().astype(int))
    picked = tuple(frames[i] for i in rows)
    return scene.replace(cameras={picked[0].camera_id: first}, frames=picked).without_poses()


def _focal_sigma(found: SfmResult, settings: CalibrationSettings) -> float:
    """Return the relative standard deviation of the focal length, or raise where it is too large."""
    sigma = focal_sigma(
        found.scene.to_pycolmap(),
        refine_distortion=settings.sfm.refine_distortion,
        refine_principal_point=found.adjustment.principal_point == "refined",
    )
    if sigma is None or not 100.0 * sigma <= settings.max_focal_sigma:
        raise StageError(
            "The pictures do not determine the focal length",
            expected=f"a standard deviation of at most {settings.max_focal_sigma:g} %",
            found="none at all" if sigma is None else f"{100.0 * sigma:.2g} %",
            todo="Over flat ground, pictures that all look down from one height fit any focal length: take oblique "
            "pictures, from several heights, of something with depth, or a camera model with fewer parameters",
        )
    return sigma
