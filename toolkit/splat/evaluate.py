"""Renders of trained Gaussians beside the photos that were held back."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.progress import Progress, silent, track
from toolkit.scene import Frame, Scene
from toolkit.splat.exposure import expose
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.images import Photo, load_photo
from toolkit.splat.rasterize import BackendName, Kind, RasterSettings, RenderOutput, rasterize
from toolkit.splat.train_settings import TrainSettings

Image = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class RenderedView:
    """A photo and what the Gaussians look like from where it was taken.

    Attributes
    ----------
    name:
        Of the frame.
    photo, render:
        (H, W, 3) float32, 0 to 1.
    depth:
        (H, W) float32 median camera depth in scene units, 0 where nothing was drawn; NaN there in affine views,
        where 0 is a depth like any other.
    weights:
        (H, W) float32, 0 where the frame's mask says that the photo does not count, or None without mask.
    """

    name: str
    photo: Image
    render: Image
    depth: Image
    weights: Image | None = None


def render_test_views(
    gaussians: Gaussians,
    scene: Scene,
    settings: TrainSettings,
    *,
    device: str = "cpu",
    progress: Progress = silent,
) -> Iterator[RenderedView]:
    """Yield every test frame with a pose, at the size of the training.

    A random background of the training is black here.

    Raises
    ------
    DataError
        As :func:`toolkit.splat.images.load_photo`.
    """
    for frame in track(scene.of_split("test"), "splat.test_views", progress):
        yield _rendered(gaussians, scene, frame, settings, device, None)


def render_training_views(
    gaussians: Gaussians,
    scene: Scene,
    settings: TrainSettings,
    exposures: Mapping[str, Sequence[Sequence[float]]],
    *,
    device: str = "cpu",
    progress: Progress = silent,
) -> Iterator[RenderedView]:
    """Yield every training frame with a pose as the training saw it last: with its learned change of colours.

    Parameters
    ----------
    exposures:
        Rows of (3, 4) maps of colours by the frames' names (:class:`~toolkit.splat.train.TrainResult`); frames
        without one keep theirs.
    """
    for frame in track(scene.of_split("train"), "splat.training_views", progress):
        yield _rendered(gaussians, scene, frame, settings, device, exposures.get(frame.name))


def _rendered(
    gaussians: Gaussians,
    scene: Scene,
    frame: Frame,
    settings: TrainSettings,
    device: str,
    exposure: Sequence[Sequence[float]] | None,
) -> RenderedView:
    photo = load_photo(scene, frame, settings.max_side, device=device)
    output = draw(gaussians, photo, settings)
    colour, weights = output.colour[0], photo.weights()
    if exposure is not None:
        colour = expose(colour, colour.new_tensor(exposure))
    return RenderedView(
        name=frame.name,
        photo=photo.colours().numpy(),
        render=colour.clamp(0, 1).cpu().numpy(),
        depth=_median_depth(output, photo).cpu().numpy(),
        weights=None if weights is None else weights.numpy(),
    )


def _median_depth(output: RenderOutput, photo: Photo) -> Tensor:
    depth, drawn = output.median_depth[0], output.alpha[0] > 0
    return torch.where(drawn, depth, float("nan")) if photo.views.affine else depth


@torch.no_grad()
def draw(gaussians: Gaussians, photo: Photo, settings: TrainSettings) -> RenderOutput:
    """Return the render of a photo's view, without gradients."""
    return rasterize(
        gaussians.detach(),
        photo.views,
        raster_settings(settings),
        background=fixed_background(settings, gaussians.means),
    )


def raster_settings(settings: TrainSettings) -> RasterSettings:
    """Return how the rasterizer is called in training and evaluation."""
    backend: BackendName = settings.backend
    kind: Kind = settings.kind
    return RasterSettings(kind=kind, backend=backend, absolute_gradients=settings.absolute_gradients)


def fixed_background(settings: TrainSettings, like: Tensor) -> Tensor:
    """Return the background colour (3,) with which views are compared: black also where training varies it."""
    return like.new_full((3,), 1.0 if settings.background == "white" else 0.0)
