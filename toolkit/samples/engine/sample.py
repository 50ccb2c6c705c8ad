"""An engine in its folder, with everything that is known of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from toolkit.errors import DataError
from toolkit.files import read_json
from toolkit.geometry.cameras import Camera
from toolkit.samples.engine.motion import Motion
from toolkit.samples.engine.render import Caster, Surface
from toolkit.samples.engine.settings import EngineSettings
from toolkit.samples.engine.shape import build_rotor
from toolkit.scene import Scene

VIDEO, RECORD, TRUTH, MESH, STATIC = (
    "video.mp4",
    "sample.json",
    "truth/frames.json",
    "truth/mesh.ply",
    "truth/static.png",
)


@dataclass(frozen=True, eq=False)
class EngineSample:
    """A filmed rotor and its truth. In the world the rotor stands still, its axis is z, and the camera circles it.

    Attributes
    ----------
    folder:
        What :func:`toolkit.scene.folder.read_scene` opens.
    settings, seed:
        What it was made with.
    scene:
        All pictures with true poses and the true camera (number 1).
    angles:
        (n,) float64 degrees about the axis from the first picture, not wrapped.
    seen:
        For each picture the numbers of the blades that it shows.
    """

    folder: Path
    settings: EngineSettings
    seed: int
    scene: Scene
    angles: NDArray[np.float64]
    seen: tuple[frozenset[int], ...]

    @property
    def radius(self) -> float:
        """Metres of the camera's circle."""
        return Motion(self.settings, self.seed).radius

    @property
    def blades(self) -> int:
        """How many blades there are."""
        return self.settings.rotor.blades

    @property
    def camera(self) -> Camera:
        """The true camera."""
        return self.scene.cameras[1]

    @property
    def window(self) -> int:
        """The most pictures apart that are less than half a blade apart: the largest window for matching."""
        step = self.settings.film.step * self.settings.film.stride
        return max(1, int(np.ceil(180 / self.blades / step - 1e-9)) - 1)

    @property
    def mesh(self) -> Path:
        """The true surface of the whole rotor, a PLY mesh in the world's metres."""
        return self.folder / MESH

    @property
    def video(self) -> Path:
        """The video of all pictures, where one was asked for."""
        return self.folder / VIDEO

    @cached_property
    def static_mask(self) -> NDArray[np.bool_]:
        """(H, W) True where the pictures show what does not turn: casing, icon and border."""
        with Image.open(self.folder / STATIC) as picture:
            return np.asarray(picture) > 0

    def visible_blades(self, i: int) -> frozenset[int]:
        """Return the blades that picture ``i`` shows with at least one pixel in a thousand."""
        return self.seen[i]

    def shared_blades(self, i: int, j: int) -> int:
        """Return how many blades both pictures show; where it is 0, every match between them is wrong."""
        return len(self.seen[i] & self.seen[j])

    def surface(self, i: int, pixels: ArrayLike) -> Surface:
        """Return what is seen at ``pixels`` (N, 2) of picture ``i``, as if neither casing nor icon were there."""
        frame = self.scene.frames[i]
        assert frame.cam_from_world is not None
        directions = self.scene.camera_of(frame).ray(pixels)[1] @ frame.cam_from_world.rotation
        return self._caster.surface(frame.cam_from_world.centre, directions)

    def right_matches(
        self, i: int, j: int, pixels_i: ArrayLike, pixels_j: ArrayLike, *, tolerance: float = 3.0
    ) -> NDArray[np.bool_]:
        """Return (N,) which matches between pictures ``i`` and ``j`` show the same place of the same blade.

        Parameters
        ----------
        i, j:
            Numbers of pictures.
        pixels_i, pixels_j:
            (N, 2) where the matched features lie.
        tolerance:
            Pixels that the place seen at ``pixels_i`` may be from ``pixels_j`` in picture ``j``, and the reverse in
            picture ``i``: one of both must hold, since on an outline a ray may meet what is behind.
        """
        there, back = self._misses(i, j, pixels_i, pixels_j), self._misses(j, i, pixels_j, pixels_i)
        static = self._is_static(pixels_i) | self._is_static(pixels_j)
        return ((there <= tolerance) | (back <= tolerance)) & ~static

    def _misses(self, i: int, j: int, here: ArrayLike, there: ArrayLike) -> NDArray[np.float64]:
        """Return (N,) how many pixels what picture ``i`` shows at ``here`` is from ``there`` in picture ``j``."""
        frame = self.scene.frames[j]
        assert frame.cam_from_world is not None
        points = self.surface(i, here).points
        expected = self.scene.camera_of(frame).project(frame.cam_from_world.apply(points))
        miss = np.linalg.norm(expected - np.asarray(there, np.float64), axis=1)
        return np.where(np.isnan(miss), np.inf, miss)

    def _is_static(self, pixels: ArrayLike) -> NDArray[np.bool_]:
        height, width = self.static_mask.shape
        column, row = np.floor(np.asarray(pixels, np.float64).reshape(-1, 2)).astype(int).T
        return self.static_mask[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]

    @cached_property
    def _caster(self) -> Caster:
        return Caster(build_rotor(self.blades, self.settings.rotor.radius))


def read_truth(folder: Path, count: int) -> tuple[NDArray[np.float64], tuple[frozenset[int], ...]]:
    """Return angles (n,) and the blades seen from the truth of ``count`` pictures.

    Raises
    ------
    DataError
        Where it is missing, damaged or of another number of pictures.
    """
    path = folder / TRUTH
    record = read_json(path)
    try:
        angles = np.array([float(angle) for angle in record["angles"]])
        seen = tuple(frozenset(int(blade) for blade in blades) for blades in record["blades"])
    except (TypeError, KeyError, ValueError) as error:
        raise DataError(
            f"{path} is damaged", expected="'angles' and 'blades' of each picture", found=str(error)
        ) from error
    if not len(angles) == len(seen) == count:
        raise DataError(
            f"{path} does not fit to the scene",
            expected=f"{count} pictures",
            found=f"{len(angles)} and {len(seen)}",
        )
    return angles, seen
