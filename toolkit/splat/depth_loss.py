"""Drawn depth held to predicted depth that is known up to scale and shift, as that of monocular networks is.

Kerbl et al. (A Hierarchical 3D Gaussian Representation, 2024) add such a term with a weight that falls
exponentially; they fit scale and shift once, to the points of structure from motion. Here they are fitted anew for
each photo and step, to what is drawn, in closed form and with gradients through the fit, as in the scale- and
shift-invariant losses of Ranftl et al. (Towards Robust Monocular Depth Estimation, 2020) and in MonoSDF (Yu et al.,
2022): no points are needed, and nothing pulls the scene towards a wrong scale.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.errors import DataError, StageError
from toolkit.scene.pictures import area_resize
from toolkit.splat.depth_settings import DepthLossSettings
from toolkit.splat.images import Photo
from toolkit.splat.rasterize import RenderOutput
from toolkit.splat.train_settings import decayed

DepthKind = Literal["scale-shift", "pearson", "absolute"]
DepthPredicts = Literal["disparity", "depth"]
#: A pixel of another size has a prediction where this share of what it covers has one.
_LEAST_KNOWN: Final = 0.5
#: Fewer pixels than this fit any scale and shift.
_MIN_PIXELS: Final = 3


def depth_loss(
    drawn: Tensor, prediction: Tensor, weights: Tensor, *, kind: DepthKind = "scale-shift"
) -> Tensor | None:
    """Return how much a drawn image differs from a prediction, mostly whatever the prediction's scale and shift.

    With m the weighted means, S the standard deviation of the prediction p, and the scale s = |cov(x, p)| / var(x)
    that brings the drawn x nearest to p:

    - ``"scale-shift"``: the mean of \\|s (x - m_x) - (p - m_p)\\| / S;
    - ``"pearson"``: one minus the correlation of x and p;
    - ``"absolute"``: the mean of \\|x - p\\| / S, for predictions in the scene's own unit, as stereo's.

    The scale is taken as positive: a fit that turns near into far would be none. The first two are 0 where x is p
    in another unit, and about 1 where they have nothing in common; the unit of neither matters.

    Parameters
    ----------
    drawn:
        (H, W), with gradient.
    prediction:
        (H, W), NaN where there is none.
    weights:
        (H, W) how much each pixel counts, 0 or more.

    Returns
    -------
    Tensor | None
        Scalar; None where there is nothing to compare: fewer than three pixels, or one of the images is flat.
    """
    known = torch.isfinite(prediction) & (weights > 0)
    if int(known.sum()) < _MIN_PIXELS:
        return None
    x, p, w = drawn[known], prediction[known].to(drawn), weights[known].to(drawn)
    w = w / w.sum()
    apart = (w * (x - p).abs()).sum()
    x, p = x - (w * x).sum(), p - (w * p).sum()
    variance_x, variance_p, covariance = (w * x * x).sum(), (w * p * p).sum(), (w * x * p).sum()
    if not (float(variance_x.detach()) > 0 and float(variance_p) > 0):
        return None
    if kind == "absolute":
        return apart / variance_p.sqrt()
    if kind == "pearson":
        return 1 - covariance / (variance_x * variance_p).sqrt()
    scale = covariance.abs() / variance_x
    return (w * (scale * x - p).abs()).sum() / variance_p.sqrt()


def compared_depth(output: RenderOutput, *, predicts: DepthPredicts, affine: bool) -> Tensor:
    """Return what of the first view grows in proportion to a prediction, (H, W): depth, or disparity.

    Disparity is one over the depth. From an affine camera, infinitely far away, it falls linearly with depth
    (1 / (D + z) = 1 / D - z / D^2 + ...), so there it is minus the depth.
    """
    depth = output.expected_depth[0]
    if predicts == "depth":
        return depth
    if affine:
        return -depth
    return 1 / torch.where(output.alpha[0].detach() > 0, depth, torch.ones_like(depth))


@dataclass(frozen=True, slots=True, eq=False)
class PredictedDepth:
    """What a training is held to, and how much.

    Attributes
    ----------
    values:
        (H, W) by a frame's name, of the frame's whole picture at any size and in any unit; NaN where there is none.
    predicts:
        What the values are up to scale and shift; most monocular networks give disparity, 1 / depth.
    settings:
        As declared.
    """

    values: Mapping[str, NDArray[np.floating]]
    predicts: DepthPredicts
    settings: DepthLossSettings

    def weight_at(self, step: int, steps: int) -> float:
        """Return the weight of the loss in a step, 1 to ``steps``: exponential from first to last."""
        return decayed(self.settings.weight, self.settings.final_weight, step, steps)


class DepthPredictions:
    """Predictions of training photos, at the sizes at which they are asked for.

    Parameters
    ----------
    predicted:
        Of the frames.
    names:
        Of the training photos. Predictions of other frames are not looked at.

    Raises
    ------
    StageError
        Where no training photo has a prediction.
    """

    def __init__(self, predicted: PredictedDepth, names: Sequence[str]) -> None:
        self.of, self._predictions = predicted, predicted.values
        self._resampled = dict[tuple[str, int, int], Tensor]()
        self.missing = tuple(name for name in names if name not in predicted.values)
        self.names = tuple(name for name in names if name in predicted.values)
        if not self.names:
            raise StageError(
                "There is no predicted depth to hold the Gaussians to",
                expected="predictions of training photos, by the frames' names",
                found=f"none for the {len(names)} training photos",
                todo="Hand in predictions, or none at all",
            )

    def of_photo(self, photo: Photo) -> Tensor | None:
        """Return the prediction (h, w) float32 at the photo's size, None where it has none.

        Raises
        ------
        DataError
            Where it is no picture of the photo's shape.
        """
        if photo.name not in self._predictions:
            return None
        width, height = photo.camera.width, photo.camera.height
        key = photo.name, width, height
        if key not in self._resampled:
            prediction = np.asarray(self._predictions[photo.name])
            _require_shape(prediction, photo)
            self._resampled[key] = resampled(prediction, width, height)
        return self._resampled[key]

    def fingerprint(self) -> str:
        """Return a hash of the training photos' predictions and of what they are."""
        digest = hashlib.sha256(self.of.predicts.encode())
        for name in self.names:
            values = np.ascontiguousarray(self._predictions[name])
            digest.update(repr((name, values.shape, values.dtype.str)).encode())
            digest.update(values.tobytes())
        return digest.hexdigest()[:16]


def _require_shape(prediction: NDArray[np.floating], photo: Photo) -> None:
    width, height = photo.camera.width, photo.camera.height
    # Both sides are whole numbers, which may differ by a pixel from the other's ratio.
    fits = prediction.ndim == 2 and min(prediction.shape) > 0
    fits = (
        fits
        and abs(prediction.shape[0] * width / prediction.shape[1] - height) <= 1.0 + height / prediction.shape[1]
    )
    if not fits:
        raise DataError(
            f"The predicted depth of frame '{photo.name}' does not fit its picture",
            expected=f"(H, W) with the sides' ratio of {width}x{height}",
            found=str(prediction.shape),
            todo="Give the prediction of the same picture, not cut and not turned",
        )


def resampled(prediction: NDArray[np.floating], width: int, height: int) -> Tensor:
    """Return a prediction (H, W) at another size, float32: by area where it shrinks, bilinear where it grows.

    What is not finite takes no part; a pixel that is mostly covered by it is NaN.
    """
    values = prediction.astype(np.float32)
    known = np.isfinite(values)
    values = np.where(known, values, np.float32(0))
    share, total = (_resize(image, width, height) for image in (known.astype(np.float32), values))
    enough = share >= _LEAST_KNOWN
    return torch.where(enough, total / torch.where(enough, share, torch.ones_like(share)), float("nan"))


def _resize(image: NDArray[np.float32], width: int, height: int) -> Tensor:
    down = np.minimum(image.shape, (height, width))
    smaller = torch.from_numpy(area_resize(image, int(down[1]), int(down[0])))
    if smaller.shape == (height, width):
        return smaller
    larger = torch.nn.functional.interpolate(smaller[None, None], (height, width), mode="bilinear")
    return larger[0, 0]


def prediction_notes(predictions: DepthPredictions | None, photos: int) -> tuple[str, ...]:
    """Return what a person should know about photos without a prediction."""
    if predictions is None or not predictions.missing:
        return ()
    return (f"{len(predictions.missing)} of {photos} training photos have no predicted depth.",)
