"""How wrong the depth of rendered test views is, where the data have true depth: the samples."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.geometry.ray_casting import MeshCaster
from toolkit.metrics.depth import depth_errors
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.recipes.base import RecipeInput
from toolkit.samples.make import depth_path
from toolkit.samples.surfaces import sample_folder, true_depth, true_surface
from toolkit.scene import Scene

if TYPE_CHECKING:
    from toolkit.splat.evaluate import RenderedView


class DepthJudge:
    """Lets rendered views pass, and compares the median depth of each with the true one."""

    def __init__(self, scene: Scene, data: RecipeInput) -> None:
        self._scene, self._reference = scene, data.reference
        self._errors: list[dict[str, Any]] = []
        self._folder, self._scale, self._reason = None, 1.0, "the data have no true depth"
        self._caster: MeshCaster | None = None
        folder = None if data.reference is None else sample_folder(data.reference)
        if folder is None or data.reference is None:
            return
        try:
            self._scale = trajectory_errors(scene, data.reference, "sim3").reference_from_estimate.scale
        except StageError as error:
            self._reason = str(error)
        else:
            self._folder = folder

    def watch(self, views: Iterable[RenderedView]) -> Iterator[RenderedView]:
        """Yield the views as they come."""
        for view in views:
            self._judge(view)
            yield view

    def _judge(self, view: RenderedView) -> None:
        if self._folder is None or self._reference is None:
            return
        frame = self._scene.frame(view.name)
        if self._scene.camera_of(frame) != self._reference.camera_of(self._reference.frame(view.name)):
            self._folder, self._reason = None, "the pictures are undistorted, or their lens was found: other pixels"
            return
        if self._caster is None and not depth_path(self._folder, frame).is_file():
            self._caster = MeshCaster(true_surface(self._folder))
        truth = _nearest(true_depth(self._folder, frame, caster=self._caster), view.depth.shape)
        if view.weights is not None:
            truth = np.where(view.weights > 0, truth, np.float32(0))
        try:
            self._errors.append(depth_errors(view.depth * np.float32(self._scale), truth).to_dict())
        except StageError as error:
            self._reason = str(error)

    def metrics(self) -> tuple[dict[str, float | None], dict[str, Any]]:
        """Return means over the views, in units of the reference, as ``depth.<measure>``, and why not."""
        if not self._errors:
            return {}, {"depth": {"reason": self._reason}}
        names = [name for name, value in self._errors[0].items() if isinstance(value, float)]
        means = {name: float(np.mean([errors[name] for errors in self._errors])) for name in names}
        return {f"depth.{name}": value for name, value in means.items()}, {"depth": {"views": self._errors}}


def _nearest(image: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return an image at another size, each pixel that in which its centre lies: depth must not be mixed."""
    rows, columns = (
        ((np.arange(new) + 0.5) * old / new).astype(int) for old, new in zip(image.shape, shape, strict=True)
    )
    return image[np.ix_(rows, columns)]
