"""SIFT features of a scene's pictures, in a COLMAP database."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from toolkit.errors import CapabilityError, DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.colmap_job import run_colmap
from toolkit.matching.database import create_database, keypoint_counts, settle, watch
from toolkit.progress import Progress, ProgressEvent, silent, track
from toolkit.scene import Scene
from toolkit.scene.pictures import check_picture, picture_size
from toolkit.settings import Choice, Integer, Number, Settings

#: With fewer features than this a picture cannot be placed: a pair alone needs 15 inliers.
FEW_FEATURES = 20

CAMERA_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "OPENCV_FISHEYE",
)


def camera_model_choice() -> Choice:
    """Declare the setting of which camera model the database starts from."""
    return Choice(
        "scene",
        choices=("scene", *CAMERA_MODELS),
        doc="Camera model to start from; 'scene' keeps the scene's cameras as they are, another model keeps their "
        "focal length and principal point and starts without distortion.",
    )


class SiftSettings(Settings):
    """SIFT features, and the camera model that structure from motion starts from."""

    max_features = Integer(
        8192,
        bounds=(16, 65536),
        unit="features",
        doc="Most keypoints kept per picture; one with two orientations makes two features.",
    )
    max_image_side = Integer(
        1600, bounds=(64, 20000), unit="px", doc="Larger pictures are shrunk to this longer side before."
    )
    first_octave = Integer(
        -1,
        bounds=(-1, 0),
        doc="-1 doubles the picture first: more and finer features for three times the time of 0.",
    )
    peak_threshold = Number(
        0.0067,
        bounds=(0.0, 0.1),
        doc="Least contrast of a feature, of a grey value range of 1; lower finds more in flat pictures.",
    )
    camera_model = camera_model_choice()
    threads = Integer(0, bounds=(0, 256), doc="Pictures worked on at once; 0: as many as there are cores.")


@dataclass(frozen=True, slots=True)
class FeatureReport:
    """What the extraction found.

    Attributes
    ----------
    counts:
        Number of features by the name of the picture, in the order of the scene.
    seconds:
        Wall time.
    """

    counts: Mapping[str, int]
    seconds: float

    @property
    def too_few(self) -> tuple[str, ...]:
        """Names of the pictures with fewer than 20 features: these will hardly be registered."""
        return tuple(name for name, count in self.counts.items() if count < FEW_FEATURES)

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        found = list(self.counts.values())
        return {
            "images": len(found),
            "features": sum(found),
            "features_mean": float(np.mean(found)),
            "features_min": min(found),
            "too_few": list(self.too_few),
            "features_per_image": dict(self.counts),
            "seconds": self.seconds,
        }


def extract_sift(
    scene: Scene, database_path: Path, settings: SiftSettings, *, seed: int = 0, progress: Progress = silent
) -> FeatureReport:
    """Write a new COLMAP database with the scene's cameras, frames, position priors and their SIFT features.

    Features under a mask's zeros are left out. The result does not depend on the number of threads.

    Parameters
    ----------
    scene:
        Its pictures. Position priors are taken from its frames, never from EXIF.
    database_path:
        Where to write; a database that was there is replaced.
    settings:
        As declared.
    seed:
        SIFT makes no random choice; taken because every stage takes it.
    progress:
        Told how many pictures are done; raises to cancel.

    Raises
    ------
    DataError
        For a scene without frames, a picture that is missing or damaged, or of another size than its camera; the
        message names it.
    CapabilityError
        For a camera that is none of COLMAP's.
    """
    start = time.perf_counter()
    check_pictures(scene, progress)
    create_database(database_path, scene, start_cameras(scene, settings.camera_model))
    options = pycolmap.FeatureExtractionOptions(
        type=pycolmap.FeatureExtractorType.SIFT,
        max_image_size=settings.max_image_side,
        num_threads=settings.threads or -1,
        use_gpu=False,
    )
    options.sift.max_num_features = settings.max_features
    options.sift.first_octave = settings.first_octave
    options.sift.peak_threshold = settings.peak_threshold
    names = [frame.name for frame in scene.frames]
    # COLMAP refuses a picture whose mask is missing, so those without one are read without a mask folder.
    masked = [frame.name for frame in scene.frames if scene.mask_path(frame) is not None]
    jobs = [(sorted(set(names) - set(masked)), pycolmap.ImageReaderOptions())]
    if masked:
        jobs.append((masked, pycolmap.ImageReaderOptions(mask_path=scene.mask_dir)))

    def extract(token: pycolmap.CancellationToken) -> None:
        pycolmap.set_random_seed(seed)
        # No name at all would mean every file in the folder.
        for chosen, reader in (job for job in jobs if job[0]):
            pycolmap.extract_features(
                database_path,
                scene.image_dir,
                image_names=chosen,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
                cancellation_token=token,
            )

    waiting = set(range(1, len(names) + 1))
    with watch(database_path) as database:

        def event() -> ProgressEvent:
            waiting.difference_update([number for number in waiting if database.exists_keypoints(number)])
            return ProgressEvent("features", len(names) - len(waiting), len(names))

        run_colmap(extract, event, progress, database_path)
    settle(database_path)
    counts = keypoint_counts(database_path)
    for frame in scene.frames:
        if counts[frame.name] is None:
            raise DataError(
                f"COLMAP could not use picture {scene.image_path(frame)}",
                expected="a complete picture, and a complete mask where there is one",
                todo="Write the mask again, or take the frame out of the scene",
            )
    return FeatureReport({name: count or 0 for name, count in counts.items()}, time.perf_counter() - start)


def start_cameras(scene: Scene, model: str) -> dict[int, ColmapCamera]:
    """Return the cameras that structure from motion starts from, by the scene's numbers.

    Parameters
    ----------
    scene:
        Its cameras must be of COLMAP's models.
    model:
        ``"scene"`` to keep them, or the name of the model to give them: same focal lengths (their mean where the
        model has one), same principal point, no distortion. Cameras of that model already are kept.

    Raises
    ------
    CapabilityError
        For a camera that is none of COLMAP's.
    """
    cameras = {}
    for camera_id in sorted({frame.camera_id for frame in scene.frames}):
        camera = scene.cameras[camera_id]
        if not isinstance(camera, ColmapCamera):
            raise CapabilityError(
                f"Structure from motion cannot use camera {camera_id}",
                expected="a central camera of one of COLMAP's models",
                found=type(camera).__name__,
            )
        cameras[camera_id] = camera if model in ("scene", camera.model) else _of_model(camera, model)
    return cameras


def _of_model(camera: ColmapCamera, model: str) -> ColmapCamera:
    old = camera.to_pycolmap()
    new = pycolmap.Camera.create_from_model_name(
        camera_id=1, model_name=model, focal_length=old.mean_focal_length(), width=old.width, height=old.height
    )
    params = np.array(new.params)
    focal = list(new.focal_length_idxs())
    params[focal] = [old.focal_length_x, old.focal_length_y] if len(focal) == 2 else old.mean_focal_length()
    params[list(new.principal_point_idxs())] = [old.principal_point_x, old.principal_point_y]
    return ColmapCamera(model, camera.width, camera.height, tuple(params), camera.prior_focal_length)


def check_pictures(scene: Scene, progress: Progress) -> None:
    """Refuse a scene without pictures, and pictures that are missing, damaged or of another size.

    COLMAP takes what it can decode of a damaged picture and says nothing.
    """
    if not scene.frames:
        raise DataError("The scene has no pictures", expected="at least 2 frames")
    for frame in track(scene.frames, "features.check", progress):
        path, camera = scene.image_path(frame), scene.camera_of(frame)
        size = picture_size(path)
        if size != (camera.width, camera.height):
            raise DataError(
                f"Picture {path} has another size than its camera",
                expected=f"{camera.width}x{camera.height}",
                found=f"{size[0]}x{size[1]}",
                todo="Give the frame a camera of its size",
            )
        check_picture(path)
