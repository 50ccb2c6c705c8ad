"""Multi-view stereo of a scene into a dense folder: choose views, search planes, reject, picture by picture.

The pipeline is that of COLMAP (Schoenberger et al. 2016, ECCV): a photometric search in every picture, a second one
in which the planes should agree with the depth of other pictures, and a filter. More is rejected before fusion.
"""

from __future__ import annotations

import dataclasses
import time
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from toolkit.depth.colmap_stereo import colmap_patch_match, require_cuda
from toolkit.depth.dense_folder import DenseFolder, Stage, require_pinhole
from toolkit.depth.dense_pictures import make_dense_folder
from toolkit.depth.dense_record import begin_record, read_record, scene_key
from toolkit.depth.patchmatch import PlaneMaps, StereoView, patch_match
from toolkit.depth.reject import rejected_pixels
from toolkit.depth.stereo_result import FrameStereo, StereoResult
from toolkit.depth.stereo_settings import StereoSettings
from toolkit.depth.stereo_views import load_stereo_view
from toolkit.depth.view_choice import ViewChoice, choose_views
from toolkit.errors import StageError
from toolkit.files import read_json, write_json
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.progress import Progress, silent, track
from toolkit.scene import Scene

# Views that are kept in memory besides a picture and its sources.
_MORE_VIEWS = 2


def stereo_depth(
    scene: Scene, settings: StereoSettings, folder: Path, *, seed: int = 0, progress: Progress = silent
) -> StereoResult:
    """Write depth and normal maps of all pictures with a pose into a dense folder of COLMAP's.

    What is whole in the folder from an earlier call with the same scene, settings and seed is not done again; maps
    of another call are deleted.

    Parameters
    ----------
    scene:
        With poses, PINHOLE cameras and points; pixels that its masks leave out have no depth.
    folder:
        Of the dense workspace.
    seed:
        Of the search. The same seed gives the same maps.
    progress:
        Told after each picture of each pass.

    Raises
    ------
    StageError
        With fewer than two posed pictures, without points, or where no picture has a source view; and where the
        folder holds something else.
    CapabilityError
        For cameras with distortion, and for ``colmap-cuda`` where pycolmap has no CUDA.
    DataError
        Where a picture or a mask cannot be used.
    """
    choices = _checked_choices(scene, settings)
    if settings.method == "colmap-cuda":
        require_cuda()
    key = scene_key(scene, settings, seed)
    begin_record(folder, key)
    dense = make_dense_folder(scene, folder, settings.max_side, progress=progress)
    usable = {choice.name: choice for choice in choices if choice}
    dense.write_lists({name: choice.sources for name, choice in usable.items()})
    if settings.method == "colmap-cuda":
        seconds = colmap_patch_match(dense, usable, settings, progress=progress)
    else:
        seconds = _Search(dense, usable, settings, seed).run(progress)
    frames = []
    for choice in choices:
        camera = dense.scene.camera_of(dense.scene.frame(choice.name))
        size = (camera.width, camera.height)
        rejected = read_record(dense, choice.name) if choice else {}
        spent = seconds.get(choice.name, 0.0)
        frames.append(
            FrameStereo(choice.name, choice.sources, choice.depth_range, size, rejected, spent, choice.reason)
        )
    return StereoResult(folder, tuple(frames))


def _checked_choices(scene: Scene, settings: StereoSettings) -> tuple[ViewChoice, ...]:
    """Return views and ranges, or raise where there is nothing to do."""
    if len(scene.registered) < 2:
        raise StageError(
            "Stereo needs two pictures with poses at least",
            expected="2 or more",
            found=f"{len(scene.registered)} of {len(scene)} frames with a pose",
            todo="Find poses first, or add pictures",
        )
    require_pinhole(scene)
    if scene.points is None or len(scene.points) == 0:
        raise StageError(
            "Stereo needs sparse points, which tell depth ranges and source views",
            expected="points of structure from motion",
            found="none",
            todo="Triangulate points under these poses first",
        )
    choices = choose_views(scene, settings.choice, settings.search.margin)
    if not any(choices):
        raise StageError(
            "No picture has another one to be compared with",
            expected="pictures that share points at a useful angle",
            found=f"for '{choices[0].name}': {choices[0].reason}",
            todo="Change the settings of the source views (choice), or add pictures and points",
        )
    return choices


class _Search:
    """The passes over the pictures of a dense folder."""

    def __init__(
        self, dense: DenseFolder, choices: dict[str, ViewChoice], settings: StereoSettings, seed: int
    ) -> None:
        self._dense, self._choices, self._settings, self._seed = dense, choices, settings, seed
        self._views: OrderedDict[str, StereoView] = OrderedDict()
        self._times = dense.stereo / "seconds.json"
        self._seconds: dict[str, float] = read_json(self._times) if self._times.is_file() else {}
        self._last: Stage = "searched" if settings.search.geometric else "photometric"

    def run(self, progress: Progress) -> dict[str, float]:
        """Search, reject and write; return the seconds that each picture's search took."""
        dense, names = self._dense, list(self._choices)
        if not all(dense.has(name) for name in names):
            _warm_up(self._settings)
            for name in track(names, "stereo.search", progress):
                if not dense.has(name, "photometric"):
                    self._photometric(name)
            if self._settings.search.geometric:
                for name in track(names, "stereo.refine", progress):
                    if not dense.has(name, "searched"):
                        self._geometric(name)
            for name in track(names, "stereo.reject", progress):
                if not dense.has(name):
                    self._reject(name)
        for name in names:  # what only the steps above needed
            dense.remove(name, "photometric")
            dense.remove(name, "searched")
        return self._seconds

    def _photometric(self, name: str) -> None:
        choice = self._choices[name]
        assert choice.depth_range is not None
        reference, sources = self._view(name), [self._view(other) for other in choice.sources]
        start = time.perf_counter()
        planes = patch_match(
            reference, sources, choice.depth_range, self._settings.search, seed=self._seed_of(name)
        )
        self._spent(name, start)
        self._write(name, planes, "photometric")

    def _geometric(self, name: str) -> None:
        choice = self._choices[name]
        assert choice.depth_range is not None
        reference, sources = self._view(name), self._with_depth(choice.sources, "photometric")
        before = self._read(name, "photometric")
        start = time.perf_counter()
        planes = patch_match(
            reference,
            sources,
            choice.depth_range,
            self._settings.search,
            seed=self._seed_of(name) + 1,
            start=before,
        )
        self._spent(name, start)
        self._write(name, planes, "searched")

    def _reject(self, name: str) -> None:
        planes = self._read(name, self._last)
        sources = self._with_depth(self._choices[name].sources, self._last)
        kept, counts = rejected_pixels(planes, self._view(name), sources, self._settings.reject)
        write_json(self._dense.stereo / "rejected" / f"{name}.json", counts)
        zero = np.float32(0)
        self._dense.write(
            name,
            np.where(kept, planes.depth, zero),
            np.where(kept[:, :, None], planes.normals, zero),
            np.where(kept, planes.confidence, zero),
        )

    def _view(self, name: str) -> StereoView:
        """Return a picture without depth; the latest ones are kept."""
        if name not in self._views:
            self._views[name] = load_stereo_view(self._dense.scene, name)
        self._views.move_to_end(name)
        while len(self._views) > 1 + self._settings.choice.views + _MORE_VIEWS:
            self._views.popitem(last=False)
        return self._views[name]

    def _with_depth(self, names: Sequence[str], stage: Stage) -> list[StereoView]:
        """Return sources with their depth; those that have none, as nothing could be chosen for them, without."""
        return [
            dataclasses.replace(self._view(name), depth=self._dense.depth(name, stage))
            if name in self._choices
            else self._view(name)
            for name in names
        ]

    def _seed_of(self, name: str) -> int:
        """Return a seed that does not depend on which pictures are done already."""
        return self._seed * 1_000_003 + 2 * list(self._choices).index(name)

    def _spent(self, name: str, start: float) -> None:
        self._seconds[name] = self._seconds.get(name, 0.0) + time.perf_counter() - start
        write_json(self._times, self._seconds)

    def _write(self, name: str, planes: PlaneMaps, stage: Stage) -> None:
        # Infinite where masked, which the format has no place for.
        cost = np.where(np.isfinite(planes.cost), planes.cost, np.float32(2))
        self._dense.write(name, planes.depth, planes.normals, np.stack([cost, planes.texture], axis=2), stage)

    def _read(self, name: str, stage: Stage) -> PlaneMaps:
        extra = self._dense.extra(name, 2, stage)
        assert extra is not None
        cost, texture = np.ascontiguousarray(extra[:, :, 0]), np.ascontiguousarray(extra[:, :, 1])
        normals = np.ascontiguousarray(self._dense.normals(name, stage))
        return PlaneMaps(self._dense.depth(name, stage), normals, cost, texture)


def _warm_up(settings: StereoSettings) -> None:
    """Compile the kernels on a few pixels, so that no picture's time has it."""
    camera = ColmapCamera.pinhole(32, 24, 30.0)
    grey = np.random.default_rng(0).random((24, 32)).astype(np.float32)
    poses = (RigidTransform.identity(), RigidTransform(np.eye(3), np.array([0.1, 0.0, 0.0])))
    views = [StereoView(grey, camera, pose, np.ones((24, 32), np.float32)) for pose in poses]
    few = settings.search.replace({"levels": 2, "iterations": 2, "radius": 1, "step": 1})
    planes = patch_match(views[0], views[1:], (0.5, 2.0), few)
    planes = patch_match(views[0], views[1:], (0.5, 2.0), few, start=planes)
    rejected_pixels(planes, views[0], views[1:], settings.reject)
