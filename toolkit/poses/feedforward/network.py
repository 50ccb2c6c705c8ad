"""What the adapters of all networks share: their packages, and one way to hand over what they say."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import CapabilityError, DataError, MissingDependencyError
from toolkit.poses.feedforward.conversions import nearest_rigid, picture_camera
from toolkit.poses.feedforward.map_plan import MapPlan, Picture
from toolkit.poses.feedforward.prediction import Prediction

_ELSEWHERE = "or predict on another machine and give the file predictions.npz (provider=file)"
_CURES = {
    "vggt": f"pip install git+https://github.com/facebookresearch/vggt.git, {_ELSEWHERE}",
    "dust3r": (
        "git clone --recursive https://github.com/naver/dust3r.git, pip install -r dust3r/requirements.txt, and "
        f"name the checkout in PYTHONPATH (its licence is CC BY-NC-SA 4.0), {_ELSEWHERE}"
    ),
    "mast3r": (
        "git clone --recursive https://github.com/naver/mast3r.git, pip install -r mast3r/requirements.txt and "
        "mast3r/dust3r/requirements.txt, and name the checkout in PYTHONPATH (its licence is CC BY-NC-SA 4.0), "
        f"{_ELSEWHERE}"
    ),
    "depth_anything_3": (
        f"pip install git+https://github.com/ByteDance-Seed/Depth-Anything-3.git, {_ELSEWHERE}; it asks for "
        "numpy below 2, so an environment of its own is the way without trouble"
    ),
}


class FeedForwardNetwork(Protocol):
    """A network that sees all pictures at once."""

    @property
    def name(self) -> str:
        """Network and weights, as a result is to be recorded."""

    def predict(self, pictures: Sequence[Picture], names: Sequence[str], *, seed: int = 0) -> Prediction:
        """Return cameras, depth, confidence and points of pictures, each (h, w, 3) uint8, called ``names``."""


def import_package(module: str) -> ModuleType:
    """Import a module of a network's package.

    Raises
    ------
    MissingDependencyError
        Where it cannot be imported; the message gives the command that installs the package.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise MissingDependencyError(
            f"The package '{package}' cannot be imported", found=str(error), todo=f"Install it: {_CURES[package]}"
        ) from error


def checked_device(device: str) -> str:
    """Return ``device``. Raises :class:`CapabilityError` where it is a GPU and there is none."""
    import torch

    if device.startswith("cuda") and not torch.cuda.is_available():
        raise CapabilityError(
            f"The network cannot run on '{device}'",
            expected="a CUDA GPU that torch can use",
            found="none",
            todo="Choose device=cpu",
        )
    return device


def assemble(
    provider: str,
    names: Sequence[str],
    plans: Sequence[MapPlan],
    maps: Sequence[Picture],
    *,
    intrinsics: NDArray[Any],
    cam_from_world: Sequence[NDArray[Any]],
    depth: Sequence[NDArray[Any]],
    confidence: Sequence[NDArray[Any]],
    points: Sequence[NDArray[Any]] | None = None,
) -> Prediction:
    """Return a prediction from what a network says of each map.

    Parameters
    ----------
    provider, names:
        Of the network and the pictures.
    plans, maps:
        How each map was cut from its picture, and the map (h, w, 3).
    intrinsics:
        (F, 3, 3) in pixels of the maps, centres at +0.5.
    cam_from_world:
        (F,) of (3, 4) or (4, 4).
    depth, confidence:
        (F,) of (h, w). Padding, and depth that is not positive and finite, get confidence 0.
    points:
        (F,) of (h, w, 3), or None: depth gives them.

    Raises
    ------
    DataError
        For maps of other sizes than the network was given, and what
        :class:`~toolkit.poses.feedforward.prediction.Prediction` refuses.
    """
    width, height = (max(plan.size[axis] for plan in plans) for axis in (0, 1))
    count = len(plans)
    depths, confidences = np.zeros((2, count, height, width), dtype=np.float32)
    places = np.zeros((count, height, width, 3), dtype=np.float32)
    colours = np.zeros((count, height, width, 3), dtype=np.uint8)
    for i, plan in enumerate(plans):
        shape = (plan.size[1], plan.size[0])
        for what, array in (("depth", depth[i]), ("confidence", confidence[i])):
            if array.shape != shape:
                raise DataError(
                    f"{provider} gave a map of another size ({what} of '{names[i]}')",
                    expected=str(shape),
                    found=str(array.shape),
                    todo="Install the version of the package that belongs to the weights",
                )
        sound = plan.shown & np.isfinite(depth[i]) & (depth[i] > 0) & np.isfinite(confidence[i])
        if points is not None:
            sound &= np.isfinite(points[i]).all(axis=-1)
            places[i, : shape[0], : shape[1]] = np.where(sound[..., None], points[i], 0)
        depths[i, : shape[0], : shape[1]] = np.where(sound, depth[i], 0)
        confidences[i, : shape[0], : shape[1]] = np.where(sound, np.maximum(confidence[i], 0), 0)
        colours[i, : shape[0], : shape[1]] = maps[i]
    rows = np.array([plan.picture_from_map for plan in plans])
    made = Prediction(
        provider=provider,
        names=tuple(names),
        cameras=tuple(
            picture_camera(np.asarray(k, dtype=np.float64), np.array(plan.picture), row)
            for k, plan, row in zip(intrinsics, plans, rows, strict=True)
        ),
        cam_from_world=tuple(nearest_rigid(matrix) for matrix in cam_from_world),
        depth=depths,
        confidence=confidences,
        points=places,
        picture_from_map=rows,
        colours=colours,
    )
    return made if points is not None else made.with_points_from_depth()


@contextmanager
def seeded(seed: int, device: str) -> Iterator[None]:
    """Seed torch's random numbers inside the block, and leave those outside as they were."""
    import torch

    with torch.random.fork_rng(devices=[] if device == "cpu" else [torch.cuda.current_device()]):
        torch.manual_seed(seed)
        yield


def to_array(tensor: Any) -> NDArray[Any]:
    """Return a tensor of any device and precision, or an array, as an array of float32."""
    if hasattr(tensor, "detach"):
        tensor = tensor.detach().float().cpu().numpy()
    return np.asarray(tensor, dtype=np.float32)


def inverse_of_rigid(matrix: ArrayLike) -> NDArray[np.float64]:
    """Return ``cam_from_world`` (4, 4) of ``world_from_cam``, as DUSt3R gives its poses."""
    return nearest_rigid(np.asarray(matrix, dtype=np.float64)).inverse().matrix
