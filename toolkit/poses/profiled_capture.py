"""A data folder again, with the camera of a profile in the place of its own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from toolkit.errors import DataError
from toolkit.files import disk_errors, stand_in
from toolkit.poses.calibrate import camera_name
from toolkit.poses.camera_profile import CameraProfile, find_profile, read_profile, with_profile
from toolkit.progress import Progress, silent
from toolkit.scene import Scene
from toolkit.scene.dataset import VIDEO_FILE, Capture, capture_fingerprint, open_capture
from toolkit.scene.folder import SCENE_FILE, write_scene
from toolkit.workspace import file_fingerprint, fingerprint


@dataclass(frozen=True, slots=True)
class ProfiledCapture:
    """A scene folder with a profile's camera.

    Attributes
    ----------
    folder:
        What :func:`~toolkit.scene.dataset.open_capture` opens.
    profile:
        As it was read.
    warnings:
        What the user should know, a sentence each.
    """

    folder: Path
    profile: CameraProfile
    warnings: tuple[str, ...]


def capture_with_profile(
    folder: Path, profile_path: Path, captures_dir: Path, *, progress: Progress = silent
) -> ProfiledCapture:
    """Write a scene folder that refers to the pictures of another folder and has a profile's camera.

    Parameters
    ----------
    folder:
        What :func:`~toolkit.scene.dataset.open_capture` opens; it stays as it is.
    profile_path:
        A profile, or a folder of profiles, of which the one of the photos' camera (EXIF) is taken.
    captures_dir:
        Where the new folder comes, under a name made of all that it has and refers to; one that is there serves.
    progress:
        Told after each picture.

    Raises
    ------
    DataError
        Where the folder or the profile is damaged or they do not fit together.
    RunError
        Where the new folder cannot be written.
    """
    capture = open_capture(folder, progress=progress)
    profile = _profile(capture.scene, profile_path)
    scene = with_profile(_whole(capture), profile)
    warnings = capture.warnings
    if capture.reference is not None and not scene.registered:
        warnings += (f"the true poses of {folder} are in a world of their own and were left out",)
    key = _key(scene, capture.video, progress)
    target = captures_dir / f"{folder.resolve().name}-{key[:12]}"
    if not (target / SCENE_FILE).is_file():
        if capture.video is not None:
            with disk_errors(target, "writing"):
                target.mkdir(parents=True, exist_ok=True)
                (target / VIDEO_FILE).unlink(missing_ok=True)
                stand_in(capture.video, target / VIDEO_FILE)
        write_scene(scene, target)
    return ProfiledCapture(target, profile, warnings)


def _key(scene: Scene, video: Path | None, progress: Progress) -> str:
    """Return a hash of what the new folder has, and of where that lies to which it only refers."""
    poses = {
        frame.name: [frame.cam_from_world.rotation.tolist(), frame.cam_from_world.translation.tolist()]
        for frame in scene.registered
        if frame.cam_from_world is not None
    }
    return fingerprint(
        {
            "scene": capture_fingerprint(scene, progress=progress),
            "poses": poses,
            "images": str(scene.image_dir.resolve()),
            "masks": None if scene.mask_dir is None else str(scene.mask_dir.resolve()),
            "video": None if video is None else [str(video.resolve()), file_fingerprint(video)],
        }
    )


def _profile(scene: Scene, path: Path) -> CameraProfile:
    if not path.is_dir():
        return read_profile(path)
    name, camera = camera_name(scene), scene.camera_of(scene.frames[0])
    if not name:
        raise DataError(
            f"The photos in {scene.image_dir} do not tell make and model of their camera",
            expected="EXIF tags, to find their profile by",
            todo=f"Name one of the files in {path}",
        )
    return find_profile(path, name, camera.width, camera.height)


def _whole(capture: Capture) -> Scene:
    """Return the scene with its true poses where these are in the world of its priors."""
    scene, truth = capture.scene, capture.reference
    if (
        truth is None
        or truth.georeference != scene.georeference
        or not all(mine.prior is true.prior for mine, true in zip(scene.frames, truth.frames, strict=True))
    ):
        return scene
    return truth
