"""What a training shows while it works: a render of one test photo, and the poses that it refines.

The files lie in the run's artifacts and are replaced in one step each, so that whoever looks at the run, from
whatever process and however often, needs nothing but its folder. Looking costs at most a share of the time, and
changes nothing of the training: it draws without gradients and without its random numbers.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from toolkit.files import atomic_path, write_json
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Scene


class Watched(Protocol):
    """What is looked at of a training of splats (:class:`toolkit.splat.trainer.Trainer`) or a radiance field."""

    @property
    def state(self) -> Any:
        """With ``step``, those that are done."""

    @property
    def settings(self) -> Any:
        """With ``steps``, those of the whole training."""

    @property
    def test_photo(self) -> Any:
        """With ``name`` and ``colours()`` (H, W, 3), or None."""

    def draw_test(self, photo: Any, /) -> tuple[Any, float]:
        """Return the view of a photo as it is drawn now, and its PSNR in dB."""

    def poses(self) -> dict[str, RigidTransform]:
        """Return the poses that are refined, by name."""


#: Folder among the artifacts, and what is in it.
LIVE, PHOTO, RENDER, VIEW, POSES = "live", "photo.jpg", "render.jpg", "view.json", "poses.json"
#: Least seconds between two looks, and the largest share of the time that they may take.
EVERY, SHARE = 2.0, 0.05
_QUALITY = 92


class LiveView:
    """An observer of a training (:class:`toolkit.splat.trainer.Observer`).

    - ``render.jpg``: the first test photo's view as it is drawn now; ``photo.jpg``: that photo, at the same size.
    - ``view.json``: ``name`` of the photo, ``step``, ``steps`` and ``psnr`` in dB.
    - ``poses.json``, where poses are refined: ``found``, the training photos' poses now, and ``reference``, those
      that they started from, each as in :func:`toolkit.runs.trajectories.trajectory_table`; and ``step``.

    Parameters
    ----------
    folder:
        Where to write; made where it is missing.
    scene:
        What is trained, with the poses it starts from.
    every, share:
        At least so many seconds from one look to the next, and more where a look would take a larger share.
    clock:
        Tells seconds.
    """

    def __init__(
        self,
        folder: Path,
        scene: Scene,
        *,
        every: float = EVERY,
        share: float = SHARE,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._folder, self._every, self._share, self._clock = folder, every, share, clock
        self._start = {f.name: f.cam_from_world for f in scene.of_split("train") if f.cam_from_world is not None}
        self._due: float | None = None
        self._photo_written = False

    def __call__(self, training: Watched) -> dict[str, float]:
        """Look where it is time to, and after the last step; return ``psnr_live`` of that look, or nothing.

        It is the measure that the training itself tells as ``psnr_test`` at fixed steps, which sweeps compare; at
        which steps it is told here depends on the time.

        Raises
        ------
        RunError
            When the disk is full or may not be written.
        """
        begun = self._clock()
        last = training.state.step == training.settings.steps
        if self._due is not None and begun < self._due and not last:
            return {}
        values = self._look(training)
        took = self._clock() - begun
        self._due = begun + took + max(self._every, took * (1 / self._share - 1))
        return values

    def _look(self, training: Watched) -> dict[str, float]:
        step, photo, values = training.state.step, training.test_photo, {}
        if photo is not None:
            if not self._photo_written:
                _write_picture(photo.colours().numpy(), self._folder / PHOTO)
                self._photo_written = True
            render, psnr = training.draw_test(photo)
            _write_picture(render.cpu().numpy(), self._folder / RENDER)
            told = {"name": photo.name, "step": step, "steps": training.settings.steps, "psnr": psnr}
            write_json(self._folder / VIEW, told)
            values["psnr_live"] = psnr
        poses = training.poses()
        if poses:
            start = {name: self._start[name] for name in poses}
            write_json(self._folder / POSES, {"step": step, "found": _rows(poses), "reference": _rows(start)})
        return values


def _rows(poses: dict[str, RigidTransform]) -> list[dict[str, Any]]:
    return [
        {"name": name, "centre": pose.centre.tolist(), "cam_from_world_wxyz": pose.quaternion.tolist()}
        for name, pose in poses.items()
    ]


def _write_picture(picture: NDArray[np.float32], path: Path) -> None:
    with atomic_path(path) as temporary:
        levels = (np.clip(picture, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
        Image.fromarray(levels).save(temporary, quality=_QUALITY)
