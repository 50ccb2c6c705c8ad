"""Depth networks of the ``transformers`` package: DPT (Ranftl et al. 2021) and Depth Anything V1 and V2.

Weights come from a folder or from the Hugging Face hub, as safetensors only; no code of a model is run. A network
whose file lacks some of its weights is refused: transformers would fill them with random numbers.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.depth.monocular import (
    DepthKind,
    DepthPrediction,
    checked_device,
    load_checked_picture,
)
from toolkit.errors import CapabilityError, DataError, WeightsMissingError
from toolkit.optional import require
from toolkit.pretrained import download_command, load_pretrained, require_complete
from toolkit.scene import Frame, Scene

#: The network of "3D Gaussian splatting from drone video", section 3.2.2.
DEFAULT_WEIGHTS = "Intel/dpt-large"

_HUB_NAME = re.compile(r"[\w-][\w.-]*/[\w-][\w.-]*")
# Fusion starts with one input, so this branch of the first layer is never run; published files leave it out.
_UNUSED = ("neck.fusion_stage.layers.0.residual_layer1.",)
_KINDS = ("dpt", "depth_anything")


class TransformersDepth:
    """DPT or Depth Anything.

    Parameters
    ----------
    weights:
        Folder as ``save_pretrained`` writes it (model and image processor), or a name on the hub, for example
        ``depth-anything/Depth-Anything-V2-Small-hf``. Empty: :data:`DEFAULT_WEIGHTS`.
    kind:
        What the network's values mean. None: affine disparity, or metric for a Depth Anything whose configuration
        says so. A DPT that was trained on metric depth (NYU, KITTI) does not say so: it needs ``"metric"``.
    download:
        Fetch what is missing from the hub. Never done unasked.
    device:
        Where to compute.

    Raises
    ------
    WeightsMissingError
        Where there are no weights.
    MissingDependencyError
        Without transformers.
    CapabilityError
        For a network of another kind, or a device that is not there.
    DataError
        For damaged or incomplete files.
    """

    def __init__(
        self, weights: str = "", *, kind: DepthKind | None = None, download: bool = False, device: str = "cpu"
    ) -> None:
        transformers = require("transformers")
        self._weights = weights or DEFAULT_WEIGHTS
        self._device = checked_device(device)
        _check_folder(self._weights)
        config = self._load(transformers.AutoConfig, download)
        if config.model_type not in _KINDS:
            raise CapabilityError(
                f"The network '{self._weights}' is not supported",
                expected="DPT or Depth Anything",
                found=f"a model of type '{config.model_type}'",
                todo="Compute its depth maps yourself and use the provider 'arrays'",
            )
        metric = config.model_type == "depth_anything" and config.depth_estimation_type == "metric"
        self._kind: DepthKind = kind or ("metric" if metric else "affine-disparity")
        self._processor = self._load(transformers.AutoImageProcessor, download)
        model, info = self._load(
            transformers.AutoModelForDepthEstimation, download, use_safetensors=True, output_loading_info=True
        )
        require_complete(self._weights, info, unused=_UNUSED)
        self._model = model.to(self._device).eval()

    @property
    def name(self) -> str:
        """Type of the network and its weights."""
        return f"{self._model.config.model_type} {self._weights}"

    def _load(self, kind: Any, download: bool, **options: Any) -> Any:
        return load_pretrained(
            kind,
            self._weights,
            what="depth network",
            files="the files of DPT or Depth Anything for transformers",
            download=download,
            **options,
        )

    def predict(self, scene: Scene, frame: Frame) -> DepthPrediction:
        """Return the network's output, resampled to the picture's size.

        Raises
        ------
        DataError
            Where the picture cannot be read, or the network answers with values that are not finite.
        """
        import torch

        picture = load_checked_picture(scene, frame)
        height, width = picture.shape[:2]
        inputs = self._processor(images=picture, return_tensors="pt", input_data_format="channels_last")
        with torch.inference_mode():
            raw = self._model(pixel_values=inputs["pixel_values"].to(self._device)).predicted_depth
            # Bilinear: bicubic overshoots where depth jumps. Pixel edges coincide, as everywhere here.
            full = torch.nn.functional.interpolate(
                raw[:, None].float(), size=(height, width), mode="bilinear", align_corners=False
            )
        values = full[0, 0].cpu().numpy().astype(np.float32)
        if not np.all(np.isfinite(values)):
            raise DataError(
                f"{self.name} gave no depth for frame '{frame.name}'",
                expected="finite values",
                found=f"{int(np.sum(~np.isfinite(values)))} that are not",
                todo="Check the weights",
            )
        return DepthPrediction(values, self._kind)


def _check_folder(weights: str) -> None:
    """Raise where ``weights`` is a folder that lacks a file, or neither a folder nor a possible name on the hub."""
    folder = Path(weights)
    if folder.is_dir():
        files = ("config.json", "preprocessor_config.json")
        missing = [name for name in files if not (folder / name).is_file()]
        # Large networks are split: model-00001-of-00003.safetensors.
        if not any(folder.glob("model*.safetensors")):
            missing.append("model.safetensors")
        if missing:
            raise WeightsMissingError(
                f"Weights missing: {folder} is no folder of a depth network",
                expected=", ".join([*files, "model.safetensors"]),
                found="no " + ", no ".join(missing),
                todo="Get the whole folder again, for example: " + download_command(DEFAULT_WEIGHTS, folder),
            )
    elif not _HUB_NAME.fullmatch(weights):
        raise WeightsMissingError(
            f"Weights missing: there is no folder '{weights}'",
            expected="a folder with config.json, preprocessor_config.json and model.safetensors, or a name on the "
            "hub (owner/model)",
            todo="For example: " + download_command(DEFAULT_WEIGHTS, folder),
        )
