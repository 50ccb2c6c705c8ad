"""What a prediction takes from its pictures afterwards: their masks and their colours."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.scene import Scene
from toolkit.scene.pictures import load_mask, load_picture


def without_masked(prediction: Prediction, scene: Scene) -> Prediction:
    """Return a prediction whose pixels have no confidence where the scene's masks leave the picture out.

    Raises
    ------
    DataError
        Where a picture is not in the scene, or its mask is damaged.
    StageError
        Where nothing is left.
    """
    confidence = prediction.confidence.copy()
    for number, name in enumerate(prediction.names):
        mask = load_mask(scene, scene.frame(name))
        if mask is not None:
            confidence[number][~_at_maps_pixels(prediction, number, mask)] = 0
    if not confidence.any():
        raise StageError(
            "The masks leave nothing of the prediction",
            expected="confident pixels that are not masked",
            found="none in any picture",
        )
    return dataclasses.replace(prediction, confidence=confidence)


def with_picture_colours(prediction: Prediction, scene: Scene) -> Prediction:
    """Return a prediction in the colours of its pictures; one that has colours stays as it is.

    Pixels of a map that lie beyond a picture get the nearest one's colour.

    Raises
    ------
    DataError
        Where a picture is missing, damaged or not in the scene.
    """
    if prediction.colours is not None:
        return prediction
    colours = [
        _at_maps_pixels(prediction, number, load_picture(scene.image_path(scene.frame(name))))
        for number, name in enumerate(prediction.names)
    ]
    return dataclasses.replace(prediction, colours=np.stack(colours))


def _at_maps_pixels(prediction: Prediction, number: int, picture: NDArray[Any]) -> NDArray[Any]:
    """Return what a picture (h, w, ...) has at the middles of its map's pixels: (H, W, ...)."""
    rows, columns = np.indices(prediction.depth.shape[1:])
    middles = np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5
    at = np.floor(prediction.to_picture(number, middles)).astype(np.int64)
    column, row = np.clip(at, 0, np.array(picture.shape[1::-1]) - 1).T
    found: NDArray[Any] = picture[row, column].reshape(*rows.shape, *picture.shape[2:])
    return found
