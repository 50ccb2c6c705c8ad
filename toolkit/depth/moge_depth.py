"""MoGe (Wang et al. 2025): point maps from single pictures, metric with version 2.

The package is its authors' own, with the call that their repository documents: ``MoGeModel.from_pretrained`` and
``infer``. Its weights are a torch file, which the package reads with ``weights_only``.
"""

from __future__ import annotations

import importlib
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.depth.monocular import (
    DepthKind,
    DepthPrediction,
    checked_device,
    load_checked_picture,
)
from toolkit.errors import DataError, MissingDependencyError, WeightsMissingError
from toolkit.geometry.cameras import Camera, ColmapCamera
from toolkit.optional import require
from toolkit.scene import Frame, Scene

DEFAULT_WEIGHTS = {"v1": "Ruicheng/moge-vitl", "v2": "Ruicheng/moge-2-vitl"}


class MogeDepth:
    """MoGe, told the field of view where the camera is a pinhole; elsewhere it estimates its own.

    Parameters
    ----------
    weights:
        The file ``model.pt``, a folder that holds it, or a name on the hub. Empty: :data:`DEFAULT_WEIGHTS`.
    version:
        ``"v1"`` or ``"v2"``, as the weights are.
    download:
        Fetch missing weights from the hub. Never done unasked.
    device:
        Where to compute.

    Raises
    ------
    WeightsMissingError
        Where there are no weights.
    MissingDependencyError
        Without the package.
    CapabilityError
        For a device that is not there.
    DataError
        For weights that do not fit the version, or are damaged.
    """

    def __init__(
        self, weights: str = "", *, version: str = "v2", download: bool = False, device: str = "cpu"
    ) -> None:
        require("moge")
        try:
            module = importlib.import_module(f"moge.model.{version}")
        except ImportError as error:
            raise MissingDependencyError(
                f"The package 'moge' has no usable model of version {version}",
                found=str(error),
                todo="Install it anew: pip install git+https://github.com/microsoft/MoGe.git",
            ) from error
        self._weights = weights or DEFAULT_WEIGHTS[version]
        self._version = version
        self._device = checked_device(device)
        model = _load(module.MoGeModel, self._weights, version, download)
        self._model = model.to(self._device).eval()
        # Only a network with this head predicts the size of the scene.
        self._kind: DepthKind = "metric" if hasattr(self._model, "scale_head") else "affine-depth"

    @property
    def name(self) -> str:
        """Version and weights."""
        return f"moge-{self._version} {self._weights}"

    def predict(self, scene: Scene, frame: Frame) -> DepthPrediction:
        """Return the z of MoGe's point map: metric, or up to scale (and what is left of a shift) for version 1.

        NaN where MoGe's mask says that there is no surface.

        Raises
        ------
        DataError
            Where the picture cannot be read, or MoGe's answer is not of its size.
        """
        import torch

        picture = load_checked_picture(scene, frame)
        image = torch.from_numpy(picture).to(self._device).permute(2, 0, 1).float() / 255
        with torch.inference_mode():
            answer = self._model.infer(
                image,
                fov_x=_horizontal_field(scene.camera_of(frame)),
                apply_mask=True,
                force_projection=True,
                use_fp16=self._device != "cpu",
            )
        depth = answer["depth"].float().cpu().numpy().astype(np.float32)
        if depth.shape != picture.shape[:2]:
            raise DataError(
                f"{self.name} gave depth of another size for frame '{frame.name}'",
                expected=str(picture.shape[:2]),
                found=str(depth.shape),
                todo="Install the version of the package that belongs to the weights",
            )
        return DepthPrediction(np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan)), self._kind)


def _horizontal_field(camera: Camera) -> float | None:
    """Return the horizontal field of view in degrees of a pinhole camera, None for any other."""
    if isinstance(camera, ColmapCamera) and camera.is_pinhole:
        return math.degrees(2 * math.atan(camera.width / (2 * float(camera.intrinsics[0, 0]))))
    return None


def _load(kind: Any, weights: str, version: str, download: bool) -> Any:
    place = Path(weights)
    path = place / "model.pt" if place.is_dir() else place
    options = {} if path.is_file() else {"local_files_only": not download}
    if place.is_dir() and not path.is_file():
        raise WeightsMissingError(f"Weights missing: no {path}", todo=_mend(version))
    try:
        return kind.from_pretrained(str(path) if path.is_file() else weights, **options)
    except (OSError, ValueError, RuntimeError, KeyError, TypeError, pickle.UnpicklingError) as error:
        found = " ".join(str(error).split())[:300]
        if path.is_file():
            raise DataError(
                f"{path} holds no weights of MoGe {version}",
                found=found,
                todo="Check moge_version; " + _mend(version),
            ) from error
        where = "on the Hugging Face hub" if download else "in the Hugging Face cache (no download was asked)"
        raise WeightsMissingError(
            f"Weights missing: no '{weights}'",
            expected=f"a file, a folder with model.pt, or the network {where}",
            found=found,
            todo=_mend(version),
        ) from error


def _mend(version: str) -> str:
    command = f"hf download {DEFAULT_WEIGHTS[version]} model.pt"
    return f"Run: {command}, or set download, or set weights to the file model.pt"
