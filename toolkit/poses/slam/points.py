"""Points under the poses of keyframes: a SLAM backend need not give its map away."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import numpy as np
import pycolmap

from toolkit.errors import StageError
from toolkit.files import disk_errors
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.colmap_job import run_colmap
from toolkit.matching.database import require_same_frames
from toolkit.matching.features import SiftSettings
from toolkit.matching.match import MatchSettings
from toolkit.matching.pairs import PairSettings
from toolkit.matching.scene_matches import match_scene
from toolkit.poses.triangulation import triangulation_options
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene import Scene, scene_from_pycolmap
from toolkit.settings import Group, Number, Settings


class TriangulationSettings(Settings):
    """Which points are kept."""

    max_error = Number(3.0, bounds=(0.1, 100.0), unit="px", doc="Observations that miss their point by more go.")
    min_angle = Number(
        1.5, bounds=(0.0, 45.0), unit="degrees", doc="Points whose rays meet under a smaller angle go."
    )


class SlamPointSettings(Settings):
    """Points of keyframes: features, matches of neighbours, triangulation."""

    sift = Group(SiftSettings(max_features=2048, first_octave=0), doc="Features")
    pairs = Group(
        PairSettings(method="sequential", overlap=5, quadratic=False), doc="Which keyframes are matched with which"
    )
    match = Group(MatchSettings(), doc="Matching and geometric verification")
    triangulation = Group(TriangulationSettings(), doc="Triangulation")


def slam_points(
    scene: Scene, settings: SlamPointSettings, *, seed: int = 0, progress: Progress = silent, work_dir: Path
) -> Scene:
    """Return the scene with points and tracks triangulated from its frames with poses. Poses and cameras stay.

    Parameters
    ----------
    scene:
        With poses, as :func:`~toolkit.poses.slam.segments.scene_with_segment` gives.
    settings:
        As declared.
    seed:
        Of every random choice.
    progress:
        Told of each step; raises to cancel.
    work_dir:
        Folder for files that are needed meanwhile and removed at the end.

    Raises
    ------
    DataError, CapabilityError
        As :func:`~toolkit.matching.features.extract_sift` does.
    StageError
        For fewer than two frames with a pose, or where no point could be triangulated.
    """
    posed = scene.replace(frames=scene.registered, points=None)
    with disk_errors(work_dir, "writing"):
        work_dir.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=work_dir, prefix=".points.", suffix=".tmp") as temporary:
        database = Path(temporary) / "matches.db"
        match_scene(posed, database, settings.sift, settings.pairs, settings.match, seed=seed, progress=progress)
        made = triangulated(posed, database, settings.triangulation, seed=seed, progress=progress)
    points = made.points
    if points is None or points.tracks is None:
        raise AssertionError("a triangulated scene has points and tracks")
    place = {frame.name: i for i, frame in enumerate(scene.frames)}
    index = np.array([place[frame.name] for frame in posed.frames], dtype=np.int64)
    return scene.replace(
        points=type(points)(
            points.xyz,
            points.rgb,
            points.error,
            type(points.tracks)(points.tracks.point, index[points.tracks.frame], points.tracks.pixel),
        )
    )


def triangulated(
    scene: Scene,
    database_path: Path,
    settings: TriangulationSettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
) -> Scene:
    """Return the scene with the points of a database's matches, triangulated under its poses, which stay.

    Parameters
    ----------
    scene:
        With a pose for each frame.
    database_path:
        With features and verified matches of its frames. COLMAP changes it by opening it, and writes beside it.
    settings:
        As declared.
    seed:
        Of COLMAP's random choices.
    progress:
        Told that it goes on; raises to cancel.

    Raises
    ------
    DataError
        For a database of another scene.
    StageError
        Where no point is left.
    """
    require_same_frames(database_path, scene)
    model = scene.replace(points=None).to_pycolmap()
    cameras = {scene.camera_of(frame) for frame in scene.registered}
    focal = min(camera.intrinsics[0, 0] for camera in cameras if isinstance(camera, ColmapCamera))
    options = triangulation_options(
        degrees=math.degrees(math.atan(settings.max_error / focal)),
        pixels=settings.max_error,
        min_angle=settings.min_angle,
        seed=seed,
    )

    def call(token: pycolmap.CancellationToken) -> pycolmap.Reconstruction:
        return pycolmap.triangulate_points(
            model,
            database_path,
            scene.image_dir,
            database_path.parent / "model",
            clear_points=True,
            options=options,
            cancellation_token=token,
        )

    made = run_colmap(call, lambda: ProgressEvent("slam.points", 0), progress, database_path)
    if not made.num_points3D():
        raise StageError(
            "No point could be triangulated under the poses of the keyframes",
            expected=f"matches that fit to {settings.max_error:g} px and meet under {settings.min_angle:g} degrees",
            found="none",
            todo="Raise max_error, lower min_angle, or match frames that lie farther apart (overlap)",
        )
    return scene_from_pycolmap(made, scene.image_dir, like=scene)
