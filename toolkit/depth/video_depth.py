"""Video Depth Anything (Chen et al. 2025): the depth of all frames of a sequence at once, consistent in time.

The package is its authors' own, a checkout on the module path, with the calls of its ``run.py``:
``VideoDepthAnything``, ``load_state_dict`` and ``infer_video_depth``. Its weights are a torch file, read with
``weights_only``. A-3DGS (section 5) names it as what may mend the inconsistent depth of DPT.
"""

from __future__ import annotations

import importlib
import pickle
import re
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.monocular import DepthKind, DepthPrediction, checked_device, load_checked_picture
from toolkit.errors import DataError, MissingDependencyError, StageError, WeightsMissingError
from toolkit.optional import require
from toolkit.scene import Frame, Scene
from toolkit.scene.pictures import area_resize

#: The smallest; the other sizes may not be used commercially.
DEFAULT_WEIGHTS: Final = "depth-anything/Video-Depth-Anything-Small"
#: Shorter side in pixels at which the network looks at a picture.
INPUT_SIZE: Final = 518

_FILE = re.compile(r"(metric_)?video_depth_anything_(vit[sbl])\.pth")
_HUB = re.compile(r"[\w.-]+/(Metric-)?Video-Depth-Anything-(Small|Base|Large)")
_ENCODERS = {"Small": "vits", "Base": "vitb", "Large": "vitl"}
# The three sizes that are published, as run.py builds them.
_SHAPES: Final[dict[str, dict[str, Any]]] = {
    "vits": {"encoder": "vits", "features": 64, "out_channels": [48, 96, 192, 384]},
    "vitb": {"encoder": "vitb", "features": 128, "out_channels": [96, 192, 384, 768]},
    "vitl": {"encoder": "vitl", "features": 256, "out_channels": [256, 512, 1024, 1024]},
}


class VideoDepth:
    """Video Depth Anything on the frames of a split, in the scene's order.

    The first frame that is asked for costs the time of its whole sequence, whose depths are kept at the network's
    size. Training frames are never looked at together with test frames.

    Parameters
    ----------
    weights:
        The file ``[metric_]video_depth_anything_vit[s|b|l].pth`` (its name says what is in it), a folder that holds
        one of them, or a name on the hub. Empty: :data:`DEFAULT_WEIGHTS`.
    download:
        Fetch missing weights from the hub. Never done unasked.
    device:
        Where to compute.

    Raises
    ------
    WeightsMissingError
        Where there are no weights.
    MissingDependencyError
        Without the package, or with a version of it that takes other arguments.
    CapabilityError
        For a device that is not there.
    DataError
        For weights that are damaged or of another network.
    """

    def __init__(self, weights: str = "", *, download: bool = False, device: str = "cpu") -> None:
        require("video_depth_anything")
        try:
            module = importlib.import_module("video_depth_anything.video_depth")
        except ImportError as error:
            raise _unusable(error) from error
        self._weights = weights or DEFAULT_WEIGHTS
        self._device = checked_device(device)
        path = _weights_file(self._weights, download)
        named = _FILE.fullmatch(path.name)
        if named is None:
            raise DataError(
                f"The name of {path} does not say which network it holds",
                expected="[metric_]video_depth_anything_vit[s|b|l].pth",
                todo="Give the file its published name back",
            )
        metric = named.group(1) is not None
        self._kind: DepthKind = "metric" if metric else "affine-disparity"
        self._model = _load(module.VideoDepthAnything, path, named.group(2), metric).to(self._device).eval()
        self._sequence: tuple[tuple[Path, ...], NDArray[np.float32]] = ((), np.empty((0, 0, 0), np.float32))

    @property
    def name(self) -> str:
        """Network and weights."""
        return f"video-depth-anything {self._weights}"

    def predict(self, scene: Scene, frame: Frame) -> DepthPrediction:
        """Return the network's output for a frame among those of its split and size, resampled to its picture.

        Raises
        ------
        DataError
            Where a picture cannot be read, or the network's answer is not what it should be.
        """
        import torch

        camera = scene.camera_of(frame)
        size = (camera.height, camera.width)
        together = [other for other in scene.frames if other.split == frame.split and _size(scene, other) == size]
        paths = tuple(scene.image_path(other) for other in together)
        if paths != self._sequence[0]:
            self._sequence = (paths, self._depths(scene, together))
        small = torch.from_numpy(self._sequence[1][paths.index(scene.image_path(frame))])
        full = torch.nn.functional.interpolate(small[None, None], size=size, mode="bilinear", align_corners=False)
        return DepthPrediction(full[0, 0].numpy(), self._kind)

    def _depths(self, scene: Scene, frames: list[Frame]) -> NDArray[np.float32]:
        """Return the network's output (N, h, w) for all frames of a sequence."""
        pictures = np.stack([_shrunk(load_checked_picture(scene, frame)) for frame in frames])
        try:
            answer, _ = self._model.infer_video_depth(
                pictures, 1, input_size=INPUT_SIZE, device=self._device, fp32=self._device == "cpu"
            )
        except TypeError as error:
            raise _unusable(error) from error
        depths: NDArray[np.float32] = np.asarray(answer, dtype=np.float32)
        if depths.shape != pictures.shape[:3]:
            raise DataError(
                f"{self.name} gave depth of another size",
                expected=str(pictures.shape[:3]),
                found=str(depths.shape),
                todo="Install the version of the package that belongs to the weights",
            )
        if not np.isfinite(depths).all():
            raise StageError(
                f"{self.name} gave depth that is not finite",
                expected="finite values",
                found=f"{int(np.sum(~np.isfinite(depths)))} that are not",
                todo="Check the weights",
            )
        return depths


def _size(scene: Scene, frame: Frame) -> tuple[int, int]:
    camera = scene.camera_of(frame)
    return camera.height, camera.width


def _shrunk(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a picture no larger than the network looks at: a flight at full size does not fit into memory."""
    height, width = picture.shape[:2]
    scale = INPUT_SIZE / min(height, width)
    return picture if scale >= 1 else area_resize(picture, round(scale * width), round(scale * height))


def _weights_file(weights: str, download: bool) -> Path:
    """Return the file with the weights, on the local disk."""
    place = Path(weights)
    if place.is_dir():
        files = sorted(path for path in place.iterdir() if _FILE.fullmatch(path.name))
        if len(files) != 1:
            raise WeightsMissingError(
                f"Weights missing: {place} does not hold one network",
                expected="one file [metric_]video_depth_anything_vit[s|b|l].pth",
                found=", ".join(path.name for path in files) or "none",
                todo="Give the file itself, or " + _mend(),
            )
        return files[0]
    if place.is_file():
        return place
    on_hub = _HUB.fullmatch(weights)
    if on_hub is None:
        raise WeightsMissingError(
            f"Weights missing: there is no file or folder '{weights}'",
            expected="a .pth file, a folder that holds it, or a name on the hub such as " + DEFAULT_WEIGHTS,
            todo=_mend(),
        )
    hub = require("huggingface_hub")
    file = f"{'metric_' if on_hub.group(1) else ''}video_depth_anything_{_ENCODERS[on_hub.group(2)]}.pth"
    try:
        return Path(hub.hf_hub_download(weights, file, local_files_only=not download))
    except (OSError, ValueError) as error:
        where = "on the Hugging Face hub" if download else "in the Hugging Face cache (no download was asked)"
        raise WeightsMissingError(
            f"Weights missing: no '{weights}'",
            expected=f"the file {file} {where}",
            found=" ".join(str(error).split())[:300],
            todo=_mend(),
        ) from error


def _load(kind: Any, path: Path, encoder: str, metric: bool) -> Any:
    """Return the network with the weights of a file, all of them."""
    import torch

    try:
        model = kind(**_SHAPES[encoder], metric=metric)
    except TypeError as error:
        raise _unusable(error) from error
    try:
        model.load_state_dict(torch.load(path, map_location="cpu", weights_only=True), strict=True)
    except (OSError, RuntimeError, KeyError, TypeError, AttributeError, EOFError, pickle.UnpicklingError) as error:
        raise DataError(
            f"{path} holds no weights of Video Depth Anything ({encoder})",
            found=" ".join(str(error).split())[:300],
            todo=_mend(),
        ) from error
    return model


def _unusable(error: Exception) -> MissingDependencyError:
    return MissingDependencyError(
        "The package 'video_depth_anything' cannot be used",
        found=str(error),
        todo="Get its present version: git clone https://github.com/DepthAnything/Video-Depth-Anything.git",
    )


def _mend() -> str:
    return f"run: hf download {DEFAULT_WEIGHTS} video_depth_anything_vits.pth, or set download, or set weights"
