"""MASt3R (Leroy et al. 2024, "Grounding image matching in 3D with MASt3R"), with its sparse global alignment.

The package is its authors' own checkout, which brings DUSt3R along. ``sparse_global_alignment`` matches the pairs
and fits cameras and depth to the matches (Duisterhof et al. 2025, "MASt3R-SfM").
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence

import numpy as np

from toolkit.poses.feedforward.dust3r import PIXEL_CENTRE, prepare, read_model
from toolkit.poses.feedforward.map_plan import Picture
from toolkit.poses.feedforward.network import (
    assemble,
    checked_device,
    import_package,
    inverse_of_rigid,
    seeded,
    to_array,
)
from toolkit.poses.feedforward.prediction import Prediction

DEFAULT_WEIGHTS = "naver/MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric"


class Mast3rNetwork:
    """MASt3R with sparse global alignment.

    Parameters
    ----------
    weights, download, device, pairs:
        As of :class:`~toolkit.poses.feedforward.dust3r.Dust3rNetwork`. Empty weights: :data:`DEFAULT_WEIGHTS`.
    steps, rate:
        Of the second, fine alignment; the first, coarse one has as many steps at seven times the rate, as the
        authors have.

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
        # It puts the DUSt3R that it brings along on the path, and so comes first.
        module = import_package("mast3r.model")
        self._align = import_package("mast3r.cloud_opt.sparse_ga").sparse_global_alignment
        self._make_pairs = import_package("dust3r.image_pairs").make_pairs
        self._device, self._pairs = checked_device(device), pairs
        self._steps, self._rate = steps, rate
        self._weights = weights or DEFAULT_WEIGHTS
        self._model = read_model(
            module.AsymmetricMASt3R, "MASt3R", weights, DEFAULT_WEIGHTS, download, self._device
        )

    @property
    def name(self) -> str:
        """Network and weights."""
        return f"MASt3R {self._weights}"

    def predict(self, pictures: Sequence[Picture], names: Sequence[str], *, seed: int = 0) -> Prediction:
        """Return what MASt3R says of the pictures. Parameters and errors as those of DUSt3R."""
        plans, maps, views = prepare(pictures, "MASt3R")
        with (
            # What it keeps between its steps; it reads back only what it wrote itself.
            tempfile.TemporaryDirectory(prefix="mast3r.") as cache,
            seeded(seed, self._device),
        ):
            pairs = self._make_pairs(views, scene_graph=self._pairs, prefilter=None, symmetrize=True)
            scene = self._align(
                [f"picture {i}" for i in range(len(views))],
                pairs,
                cache,
                self._model,
                lr1=7 * self._rate,
                niter1=self._steps,
                lr2=self._rate,
                niter2=self._steps,
                device=self._device,
                opt_depth=True,
                verbose=False,
            )
            _, depth, confidence = scene.get_dense_pts3d(clean_depth=True)
        intrinsics = np.stack([to_array(matrix) for matrix in scene.intrinsics])
        intrinsics[:, :2, 2] += PIXEL_CENTRE
        shapes = [(plan.size[1], plan.size[0]) for plan in plans]
        return assemble(
            self.name,
            names,
            plans,
            maps,
            intrinsics=intrinsics,
            cam_from_world=[inverse_of_rigid(pose) for pose in to_array(scene.get_im_poses())],
            depth=[to_array(values).reshape(shape) for values, shape in zip(depth, shapes, strict=True)],
            confidence=[to_array(values) for values in confidence],
        )
