"""Depth Anything 3 (Lin et al. 2025, "Depth Anything 3: Recovering the visual space from any views").

The package is its authors' own: ``DepthAnything3.from_pretrained`` and ``inference``, as its documentation calls
them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image

from toolkit.errors import CapabilityError
from toolkit.poses.feedforward.map_plan import Picture, cropped_to_smallest, depth_anything_plan
from toolkit.poses.feedforward.network import assemble, checked_device, import_package, to_array
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.weights import check_complete, find_weights, loaded, require_safetensors

DEFAULT_WEIGHTS = "depth-anything/DA3-LARGE"


class DepthAnything3Network:
    """A network of Depth Anything 3 for any number of views.

    Parameters
    ----------
    weights:
        Folder with ``config.json`` and ``model.safetensors``, or a name on the hub. Empty:
        :data:`DEFAULT_WEIGHTS`.
    download, device:
        As of :class:`~toolkit.poses.feedforward.vggt.VggtNetwork`.
    side:
        Pixels that the longer side of a picture is scaled to.

    Raises
    ------
    MissingDependencyError, WeightsMissingError, CapabilityError, DataError
        As :class:`~toolkit.poses.feedforward.vggt.VggtNetwork`.
    """

    def __init__(self, weights: str = "", *, download: bool = False, device: str = "cpu", side: int = 504) -> None:
        module = import_package("depth_anything_3.api")
        self._device, self._side = checked_device(device), side
        self._weights = weights or DEFAULT_WEIGHTS
        path = find_weights(weights, DEFAULT_WEIGHTS, download=download, files=("model.safetensors",))
        folder = require_safetensors(path, "Depth Anything 3")
        model = loaded(lambda: module.DepthAnything3.from_pretrained(str(folder)), folder)
        check_complete(model, folder)
        self._model = model.to(self._device).eval()

    @property
    def name(self) -> str:
        """Network and weights."""
        return f"Depth Anything 3 {self._weights}"

    def predict(self, pictures: Sequence[Picture], names: Sequence[str], *, seed: int = 0) -> Prediction:
        """Return what the network says of the pictures. It makes no random choice.

        Sky, where the network tells it, has confidence 0.

        Raises
        ------
        CapabilityError
            For a network that gives depth only.
        DataError
            For a picture that is too narrow, and where the answer is no prediction.
        """
        plans = [depth_anything_plan(p.shape[1], p.shape[0], side=self._side) for p in pictures]
        plans = cropped_to_smallest(plans)
        answer = self._model.inference(
            list(pictures), process_res=self._side, process_res_method="upper_bound_resize"
        )
        if answer.extrinsics is None or answer.intrinsics is None or answer.conf is None:
            raise CapabilityError(
                f"{self.name} gives no cameras",
                expected="a network for any views (DA3-SMALL, DA3-BASE, DA3-LARGE, DA3-GIANT)",
                found="depth of single pictures",
                todo="Choose other weights",
            )
        confidence = to_array(answer.conf)
        if answer.sky is not None:
            confidence = np.where(np.asarray(answer.sky, dtype=bool), 0, confidence)
        return assemble(
            self.name,
            names,
            plans,
            [plan.apply(p, Image.Resampling.BICUBIC) for plan, p in zip(plans, pictures, strict=True)],
            intrinsics=to_array(answer.intrinsics),
            cam_from_world=list(to_array(answer.extrinsics)),
            depth=list(to_array(answer.depth)),
            confidence=list(confidence),
        )
