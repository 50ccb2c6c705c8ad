"""Photos that are localised in a run's map: a frame of its scene, or a picture file of one of its cameras."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from toolkit.errors import CapabilityError, DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.query import Query, query_of
from toolkit.scene import PosePrior, Scene
from toolkit.scene.exif import PhotoTags, read_tags
from toolkit.scene.pictures import load_picture, open_picture
from toolkit.scene.priors import GeodeticReading, priors_from_readings


@dataclass(frozen=True, slots=True, eq=False)
class Photo:
    """A photo to be localised.

    Attributes
    ----------
    query:
        Name, pixels and camera.
    frame:
        Whether it is a frame of the run's scene.
    truth:
        The pose that the scene has for it, or None.
    prior:
        What its sensors say, or None.
    time:
        Seconds since the capture began, or None.
    """

    query: Query
    frame: bool
    truth: RigidTransform | None = None
    prior: PosePrior | None = None
    time: float | None = None


def frame_photo(scene: Scene, name: str) -> Photo:
    """Return a frame of a scene, train or test.

    Raises
    ------
    DataError
        Where there is no such frame, or its picture is missing, damaged or of another size than its camera.
    CapabilityError
        For a camera that is none of COLMAP's.
    """
    frame = scene.frame(name)
    return Photo(query_of(scene, frame), True, frame.cam_from_world, frame.prior, frame.time)


def file_photo(scene: Scene, path: Path, name: str = "") -> Photo:
    """Return a picture file as a photo of the scene's camera that has its size.

    Where several cameras have that size, it is the one that took most frames. A focal length by EXIF would not do:
    it is off by percents, which a pose turns into as many percents of the height.

    Parameters
    ----------
    path:
        A JPEG, PNG or TIFF file.
    name:
        What it is called; by default the file's name.

    Raises
    ------
    DataError
        Where the file is missing or damaged, or no camera of the scene has its size.
    CapabilityError
        Where the scene has no camera of COLMAP's.
    """
    picture = load_picture(path)
    height, width = picture.shape[:2]
    used = Counter(frame.camera_id for frame in scene.frames)
    cameras = {
        number: camera
        for number, camera in scene.cameras.items()
        if used[number] and isinstance(camera, ColmapCamera)
    }
    if not cameras:
        raise CapabilityError(
            "No photo can be localised in this scene",
            expected="a camera of COLMAP's",
            found=", ".join(sorted({type(camera).__name__ for camera in scene.cameras.values()})) or "no camera",
        )
    fitting = [number for number, camera in cameras.items() if (camera.width, camera.height) == (width, height)]
    if not fitting:
        sizes = sorted({(camera.width, camera.height) for camera in cameras.values()})
        raise DataError(
            f"No camera of the run's scene took {name or path.name}",
            expected="a picture of " + " or ".join(f"{wide}x{high}" for wide, high in sizes) + " pixels",
            found=f"{width}x{height}",
            todo="Give a photo of a camera that took the map's photos, in their size",
        )
    camera = cameras[max(fitting, key=lambda number: (used[number], -number))]
    with open_picture(path) as opened:
        tags = read_tags(opened)
    return Photo(Query(name or path.name, picture, camera), False, None, _prior(scene, tags))


def _prior(scene: Scene, tags: PhotoTags) -> PosePrior | None:
    if scene.georeference is None:
        return None
    reading = GeodeticReading(tags.position, tags.gimbal, tags.position_sigma)
    return priors_from_readings([reading], scene.georeference)[0]
