"""VGGT (Wang et al. 2025, "VGGT: Visual geometry grounded transformer"): all pictures in one pass.

The package is its authors' own: ``VGGT()`` and ``pose_encoding_to_extri_intri``, as their README calls them.
Pictures are scaled here by the rules of its ``load_and_preprocess_images``, so that it is known where each pixel
comes from.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image

from toolkit.poses.feedforward.map_plan import Picture, of_one_size, vggt_plan
from toolkit.poses.feedforward.network import assemble, checked_device, import_package, to_array
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.weights import find_weights, loaded, read_config, read_state

DEFAULT_WEIGHTS = "facebook/VGGT-1B"
_FILES = ("model.safetensors", "model.pt")


class VggtNetwork:
    """VGGT.

    Parameters
    ----------
    weights:
        The file ``model.pt`` or ``model.safetensors``, a folder with one of them, or a name on the hub. Empty:
        :data:`DEFAULT_WEIGHTS`.
    download:
        Fetch missing weights from the hub. Never done unasked.
    device:
        Where to compute.
    fit:
        ``"crop"``: the width is scaled to 518 pixels, and of tall pictures the middle is taken; ``"pad"``: the
        whole picture is kept.
    points:
        ``"depth"``: points from depth and cameras, which its authors found more accurate (section 4.3);
        ``"head"``: those of the network's point head, with that head's confidence.

    Raises
    ------
    MissingDependencyError
        Without the package.
    WeightsMissingError
        Where there are no weights.
    CapabilityError
        For a device that is not there.
    DataError
        For weights that are damaged or of another network.
    """

    def __init__(
        self,
        weights: str = "",
        *,
        download: bool = False,
        device: str = "cpu",
        fit: str = "crop",
        points: Literal["depth", "head"] | str = "depth",
    ) -> None:
        module = import_package("vggt.models.vggt")
        self._decode = import_package("vggt.utils.pose_enc").pose_encoding_to_extri_intri
        self._device, self._fit, self._points = checked_device(device), fit, points
        self._weights = weights or DEFAULT_WEIGHTS
        path = find_weights(weights, DEFAULT_WEIGHTS, download=download, files=_FILES)
        self._model = loaded(lambda: _make(module.VGGT, path), path).to(self._device).eval()

    @property
    def name(self) -> str:
        """Network and weights."""
        return f"VGGT {self._weights}"

    def predict(self, pictures: Sequence[Picture], names: Sequence[str], *, seed: int = 0) -> Prediction:
        """Return what VGGT says of the pictures. It makes no random choice.

        Raises
        ------
        DataError
            For a picture that is too narrow, and where the answer is no prediction.
        """
        import torch

        plans = [vggt_plan(p.shape[1], p.shape[0], pad=self._fit == "pad") for p in pictures]
        plans = of_one_size(plans)
        maps = [
            plan.apply(picture, Image.Resampling.BICUBIC) for plan, picture in zip(plans, pictures, strict=True)
        ]
        images = torch.from_numpy(np.stack(maps)).to(self._device).permute(0, 3, 1, 2).float() / 255
        with torch.inference_mode(), _precision(self._device):
            answer = self._model(images)
        # cam_from_world, and a principal point in the middle (W/2, H/2): edges of pixels count, as here.
        extrinsics, intrinsics = self._decode(answer["pose_enc"].float(), images.shape[-2:])
        head = self._points == "head"
        confidence = to_array(answer["world_points_conf" if head else "depth_conf"])[0]
        return assemble(
            self.name,
            names,
            plans,
            maps,
            intrinsics=to_array(intrinsics)[0],
            cam_from_world=list(to_array(extrinsics)[0]),
            depth=list(to_array(answer["depth"])[0, ..., 0]),
            confidence=list(confidence),
            points=list(to_array(answer["world_points"])[0]) if head else None,
        )


def _make(kind: Any, path: Path) -> Any:
    model = kind(**(read_config(path) if path.is_dir() else {}))
    # Strictly: what a file lacks would stay random.
    model.load_state_dict(read_state(path, _FILES))
    return model


def _precision(device: str) -> Any:
    """Return what makes a GPU compute in half precision, as the authors do; a processor computes in single."""
    import torch

    half = torch.bfloat16 if device == "cuda" and torch.cuda.is_bf16_supported() else torch.float16
    return torch.autocast(device_type=device, dtype=half, enabled=device == "cuda")
