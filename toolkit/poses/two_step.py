"""Structure from motion of distorted pictures: the lens within the adjustment, or taken out of the pictures first.

Blade-inspection-sfm, section 4.3: a first reconstruction finds the distortion under a camera model, the pictures
are undistorted with it, and features, matches and reconstruction are made anew from the undistorted pictures (Table
1, b to d). The second pass here uses a fixed PINHOLE camera of the undistorted pictures: the paper refines a model
again there, by which the two passes share the lens between them. The one-step keeps the model in the adjustment
(Table 1, a).
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from toolkit.errors import SettingsError, StageError
from toolkit.files import disk_errors
from toolkit.matching.database import copy_database, require_same_frames
from toolkit.poses.arc_sigma import ArcSigma, arc_sigma
from toolkit.poses.camera_start import plain_cameras, with_cameras, write_cameras
from toolkit.poses.refine_lens import SIMPLER, refine_lens
from toolkit.poses.sfm import SfmSettings, incremental_sfm
from toolkit.poses.sfm_result import SfmResult
from toolkit.poses.undistort import undistort
from toolkit.progress import Progress, silent
from toolkit.scene import Scene
from toolkit.scene.colmap import colmap_camera

#: The database of the undistorted pictures, in their folder.
MATCHES = "matches.db"
#: Finds features and verified matches of a scene's pictures and writes them into a new database at the path.
Rematch = Callable[[Scene, Path], None]


@dataclass(frozen=True, slots=True, eq=False)
class PassResult:
    """One pass of structure from motion and the arc of its cameras.

    Attributes
    ----------
    model:
        COLMAP's name of the camera model.
    fixed:
        Whether the intrinsics were kept.
    sfm:
        The reconstruction.
    arc:
        Arc and standard deviation. Where the intrinsics were kept it is that of an exact lens: what the pass that
        found the lens left open is in :attr:`TwoStepResult.sigma` only. None where the cameras make no circle; then
        ``arc_failure`` says why.
    arc_failure:
        See there.
    seconds:
        Wall time of the reconstruction.
    """

    model: str
    fixed: bool
    sfm: SfmResult
    arc: ArcSigma | None
    arc_failure: str
    seconds: float

    @property
    def scene(self) -> Scene:
        """The scene with poses, cameras and points."""
        return self.sfm.scene

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "model": self.model,
            "fixed": self.fixed,
            "sfm": self.sfm.to_dict(),
            "arc": None if self.arc is None else self.arc.to_dict(),
            "arc_failure": self.arc_failure,
            "seconds": self.seconds,
        }


@dataclass(frozen=True, slots=True, eq=False)
class TwoStepResult:
    """Both ways on the same pictures.

    Attributes
    ----------
    one_step:
        The first pass: the model within the adjustment of the distorted pictures.
    two_step:
        The second pass, with the fixed PINHOLE of the undistorted pictures; None where it found nothing, and then
        ``failure`` says why.
    failure:
        See there.
    seconds:
        Wall time of undistorting and of matching again.
    """

    one_step: PassResult
    two_step: PassResult | None
    failure: str
    seconds: Mapping[str, float]

    @property
    def sigma(self) -> float | None:
        """Standard deviation of the second pass's arc in degrees, with the lens as uncertain as the first left it.

        The variance that a lens to be found adds to the arc in the first pass, and that of the second pass. None
        where one of them is not known.
        """
        arcs = (self.one_step.arc, None if self.two_step is None else self.two_step.arc)
        parts = [None if arc is None else (arc.sigma, arc.sigma_fixed) for arc in arcs]
        first, second = parts
        if first is None or second is None or first[0] is None or first[1] is None or second[1] is None:
            return None
        return math.sqrt(max(first[0] ** 2 - first[1] ** 2, 0.0) + second[1] ** 2)

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "one_step": self.one_step.to_dict(),
            "two_step": None if self.two_step is None else self.two_step.to_dict(),
            "failure": self.failure,
            "sigma": self.sigma,
            "seconds": dict(self.seconds),
        }


def one_step(
    scene: Scene,
    database_path: Path,
    model: str,
    settings: SfmSettings,
    *,
    start_focal: float = 0.0,
    simple_first: bool = True,
    seed: int = 0,
    progress: Progress = silent,
    work_dir: Path,
) -> PassResult:
    """Reconstruct distorted pictures with a camera model that starts without distortion.

    Parameters
    ----------
    scene:
        Whose features are in the database. Its cameras give size, principal point and, unless ``start_focal`` does,
        the start focal length.
    database_path:
        With features and verified matches. It is only read.
    model:
        COLMAP's name of the camera model.
    settings:
        Of the reconstruction; focal length and distortion must be refined.
    start_focal:
        In pixels, with the principal point in the picture's middle; 0: those of the scene's cameras.
    simple_first:
        Whether a model of more than two coefficients gets its poses from one of two
        (:data:`toolkit.poses.refine_lens.SIMPLER`), and is refined from there. Without, it is in the mapper from
        the beginning, as COLMAP does it.
    seed:
        Of every random choice.
    progress:
        Raises to cancel.
    work_dir:
        Folder for files that are needed meanwhile and removed at the end.

    Raises
    ------
    SettingsError
        Where focal length or distortion is not to be refined.
    DataError, CapabilityError, StageError
        As :func:`toolkit.poses.sfm.incremental_sfm`.
    """
    if not (settings.refine_focal and settings.refine_distortion):
        raise SettingsError(
            "Settings 'refine_focal' and 'refine_distortion' keep the lens from being found",
            expected="true for both",
            todo="For a lens that is known, reconstruct with it (incremental_sfm)",
        )
    mapped_with = SIMPLER.get(model, model) if simple_first else model
    return _pass(
        with_cameras(scene, plain_cameras(scene, mapped_with, start_focal)),
        database_path,
        settings,
        model=model,
        seed=seed,
        progress=progress,
        work_dir=work_dir,
    )


def two_step(
    scene: Scene,
    database_path: Path,
    model: str,
    settings: SfmSettings,
    *,
    rematch: Rematch,
    folder: Path,
    start_focal: float = 0.0,
    simple_first: bool = True,
    seed: int = 0,
    progress: Progress = silent,
    work_dir: Path,
) -> TwoStepResult:
    """Find the lens, take its distortion out of the pictures, and reconstruct these anew with fixed pinholes.

    Parameters
    ----------
    scene, database_path, model, settings, start_focal, simple_first, seed, progress, work_dir:
        As of :func:`one_step`, which is the first pass.
    rematch:
        Finds features and matches of the undistorted pictures, with the settings and the method of the first pass.
        The scene that it is given has no poses, and the cameras and masks of the undistorted pictures.
    folder:
        New folder for the undistorted pictures (and masks, and the database ``matches.db``), which stay there.

    Raises
    ------
    SettingsError, DataError, CapabilityError, StageError
        As :func:`one_step` does for the first pass. What the second pass lacks is in the result.
    """
    first = one_step(
        scene,
        database_path,
        model,
        settings,
        start_focal=start_focal,
        simple_first=simple_first,
        seed=seed,
        progress=progress,
        work_dir=work_dir,
    )
    start = time.perf_counter()
    flat = _known_cameras(undistort(first.scene, folder, progress=progress))
    undistorted = time.perf_counter()
    again = folder / MATCHES
    try:
        rematch(flat.without_poses(), again)
        matched = time.perf_counter()
        seconds = {"undistort": undistorted - start, "match": matched - undistorted}
        fixed = settings.replace(
            {"refine_focal": False, "refine_distortion": False, "refine_principal_point": False}
        )
        second = _pass(
            flat.without_poses(), again, fixed, model="PINHOLE", seed=seed, progress=progress, work_dir=work_dir
        )
    except StageError as error:
        seconds = {"undistort": undistorted - start, "match": time.perf_counter() - undistorted}
        return TwoStepResult(first, None, str(error), seconds)
    return TwoStepResult(first, second, "", seconds)


def _known_cameras(scene: Scene) -> Scene:
    """Return the scene with cameras whose focal lengths count as measured: they are, by the first pass."""
    cameras = {
        number: dataclasses.replace(colmap_camera(scene, number), prior_focal_length=True)
        for number in scene.cameras
    }
    return with_cameras(scene, cameras)


def _pass(
    scene: Scene,
    database_path: Path,
    settings: SfmSettings,
    *,
    model: str,
    seed: int,
    progress: Progress,
    work_dir: Path,
) -> PassResult:
    """Reconstruct with the scene's cameras, whatever cameras the database has, and measure the arc.

    Cameras of another model than the one that is asked for find the poses only.
    """
    start = time.perf_counter()
    require_same_frames(database_path, scene)
    with disk_errors(work_dir, "writing"):
        work_dir.mkdir(parents=True, exist_ok=True)
    used = {frame.camera_id: colmap_camera(scene, frame.camera_id) for frame in scene.frames}
    with tempfile.TemporaryDirectory(dir=work_dir, prefix=".pass.", suffix=".tmp") as temporary:
        copy = Path(temporary) / "matches.db"
        copy_database(database_path, copy)
        write_cameras(copy, used)
        work = Path(temporary)
        found = incremental_sfm(scene, copy, settings, seed=seed, progress=progress, work_dir=work)
        if any(camera.model != model for camera in used.values()):
            found = refine_lens(found, copy, model, settings, seed=seed, progress=progress, work_dir=work)
    seconds = time.perf_counter() - start
    arc, failure = None, ""
    try:
        arc = arc_sigma(
            found.scene,
            refine_focal=settings.refine_focal,
            refine_distortion=settings.refine_distortion,
            refine_principal_point=found.adjustment.principal_point == "refined",
            progress=progress,
        )
    except StageError as error:
        failure = str(error)
    return PassResult(model, not settings.refine_focal, found, arc, failure, seconds)
