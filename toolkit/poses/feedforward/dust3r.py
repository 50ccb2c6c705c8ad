"""DUSt3R (Wang et al. 2024, "DUSt3R: Geometric 3D vision made easy"): pairs of pictures, aligned to one world.

The package is its authors' own checkout, called as its README does: ``inference`` on pairs, then
``global_aligner``. Two pictures need no optimisation (``PairViewer``); more are aligned by gradient descent
(``PointCloudOptimizer``), whose time grows with the number of pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from PIL import Image

from toolkit.errors import StageError
from toolkit.poses.feedforward.map_plan import MapPlan, Picture, dust3r_plan
from toolkit.poses.feedforward.network import (
    assemble,
    checked_device,
    import_package,
    inverse_of_rigid,
    seeded,
    to_array,
)
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.weights import check_complete, find_weights, loaded, require_safetensors

DEFAULT_WEIGHTS = "naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt"
#: Its pixel (i, j) has its centre at (i, j), here at (i + 0.5, j + 0.5).
PIXEL_CENTRE = 0.5


def read_model(kind: Any, name: str, weights: str, default: str, download: bool, device: str) -> Any:
    """Return a network of one of the authors' classes with its weights, ready to be asked.

    Raises
    ------
    WeightsMissingError, CapabilityError, DataError
        As :class:`Dust3rNetwork`.
    """
    path = find_weights(weights, default, download=download, files=("model.safetensors",))
    folder = require_safetensors(path, name)
    model = loaded(lambda: kind.from_pretrained(str(folder)), folder)
    check_complete(model, folder)
    return model.to(device).eval()


class Dust3rNetwork:
    """DUSt3R with global alignment.

    Parameters
    ----------
    weights:
        Folder with ``config.json`` and ``model.safetensors``, or a name on the hub. Empty:
        :data:`DEFAULT_WEIGHTS`. Its ``.pth`` files name code to run and are refused.
    download:
        Fetch missing weights from the hub. Never done unasked.
    device:
        Where to compute.
    pairs:
        Which pairs it sees, in its own words: ``complete``, ``swin-3``, ``logwin-3``, ``oneref-0``.
    steps, rate:
        Of the alignment of more than two pictures.

    Raises
    ------
    MissingDependencyError, WeightsMissingError, CapabilityError, DataError
        As :class:`~toolkit.poses.feedforward.vggt.VggtNetwork`.
    """

    def __init__(
        self,
        weights: str = "",
        *,
        download: bool = False,
        device: str = "cpu",
        pairs: str = "complete",
        steps: int = 300,
        rate: float = 0.01,
    ) -> None:
        module = import_package("dust3r.model")
        self._inference = import_package("dust3r.inference").inference
        self._make_pairs = import_package("dust3r.image_pairs").make_pairs
        self._aligner = import_package("dust3r.cloud_opt")
        self._device, self._pairs = checked_device(device), pairs
        self._steps, self._rate = steps, rate
        self._weights = weights or DEFAULT_WEIGHTS
        self._model = read_model(
            module.AsymmetricCroCo3DStereo, "DUSt3R", weights, DEFAULT_WEIGHTS, download, self._device
        )

    @property
    def name(self) -> str:
        """Network and weights."""
        return f"DUSt3R {self._weights}"

    def predict(self, pictures: Sequence[Picture], names: Sequence[str], *, seed: int = 0) -> Prediction:
        """Return what DUSt3R says of the pictures.

        Parameters
        ----------
        pictures, names:
            At least two.
        seed:
            Of the alignment's random start.

        Raises
        ------
        StageError
            For fewer than two pictures.
        DataError
            For a picture that is too narrow, and where the answer is no prediction.
        """
        plans, maps, views = prepare(pictures, "DUSt3R")
        with seeded(seed, self._device):
            pairs = self._make_pairs(views, scene_graph=self._pairs, prefilter=None, symmetrize=True)
            output = self._inference(pairs, self._model, self._device, batch_size=1, verbose=False)
            modes = self._aligner.GlobalAlignerMode
            mode = modes.PairViewer if len(pictures) == 2 else modes.PointCloudOptimizer
            aligned = self._aligner.global_aligner(output, device=self._device, mode=mode, verbose=False)
            if len(pictures) > 2:
                aligned.compute_global_alignment(init="mst", niter=self._steps, schedule="cosine", lr=self._rate)
        intrinsics = to_array(aligned.get_intrinsics()).copy()
        intrinsics[:, :2, 2] += PIXEL_CENTRE
        return assemble(
            self.name,
            names,
            plans,
            maps,
            intrinsics=intrinsics,
            cam_from_world=[inverse_of_rigid(pose) for pose in to_array(aligned.get_im_poses())],
            depth=[to_array(depth) for depth in aligned.get_depthmaps()],
            confidence=[to_array(confidence) for confidence in aligned.im_conf],
        )


def prepare(pictures: Sequence[Picture], network: str) -> tuple[list[MapPlan], list[Picture], list[dict[str, Any]]]:
    """Return plans, maps and what ``load_images`` of the package would return of the pictures.

    Raises
    ------
    StageError
        For fewer than two pictures.
    """
    import torch

    if len(pictures) < 2:
        raise StageError(f"{network} compares pictures", expected="at least 2", found=str(len(pictures)))
    plans = [dust3r_plan(picture.shape[1], picture.shape[0]) for picture in pictures]
    maps = []
    for plan, picture in zip(plans, pictures, strict=True):
        smaller = max(plan.picture) > max(plan.scaled)
        maps.append(plan.apply(picture, Image.Resampling.LANCZOS if smaller else Image.Resampling.BICUBIC))
    views = [
        {
            "img": torch.from_numpy(image).permute(2, 0, 1).float()[None] / 127.5 - 1,
            "true_shape": np.array([image.shape[:2]], dtype=np.int32),
            "idx": i,
            "instance": str(i),
        }
        for i, image in enumerate(maps)
    ]
    return plans, maps, views
