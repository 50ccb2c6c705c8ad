"""SuperPoint (DeTone et al. 2018) with LightGlue (Lindenberger et al. 2023): the paper's matcher.

Both networks are one model of the ``transformers`` package (``LightGlueForKeypointMatching``). Its weights are in
no package: they come from a folder or from the hub.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import CapabilityError
from toolkit.matching.learned import CORNER
from toolkit.matching.picture_features import PictureFeatures, PictureMatches, shrunk
from toolkit.matching.picture_settings import PictureMatchSettings
from toolkit.optional import require
from toolkit.pretrained import load_pretrained, require_complete

Picture = NDArray[np.uint8]


class SuperPointMatcher:
    """Finds and matches the features of two pictures at once; both networks run for every pair.

    Raises
    ------
    MissingDependencyError
        Without transformers.
    WeightsMissingError
        Where there are no weights.
    CapabilityError
        For a network that is not SuperPoint with LightGlue.
    DataError
        For damaged or incomplete files.
    """

    method = "superpoint-lightglue"

    def __init__(self, settings: PictureMatchSettings, *, device: str = "cpu") -> None:
        transformers = require("transformers")
        self._max_side, self._device = settings.max_image_side, device
        about = {
            "what": "network",
            "files": "the files of SuperPoint with LightGlue for transformers",
            "download": settings.download,
        }
        config = load_pretrained(transformers.AutoConfig, settings.weights, **about)
        if config.model_type != "lightglue" or config.keypoint_detector_config.model_type != "superpoint":
            raise CapabilityError(
                f"The network '{settings.weights}' is not SuperPoint with LightGlue",
                expected="a model of type 'lightglue' whose keypoints are SuperPoint's",
                found=f"a model of type '{config.model_type}'",
            )
        config.filter_threshold = settings.min_confidence
        config.keypoint_detector_config.max_keypoints = settings.max_features
        model, info = load_pretrained(
            transformers.LightGlueForKeypointMatching,
            settings.weights,
            config=config,
            use_safetensors=True,
            output_loading_info=True,
            **about,
        )
        require_complete(settings.weights, info)
        self._model = model.to(device).eval()

    def features(self, picture: Picture) -> PictureFeatures:
        """Return the picture: features are found when it is matched."""
        return PictureFeatures(np.zeros((0, 2)), picture, (picture.shape[1], picture.shape[0]))

    def match(self, one: PictureFeatures, other: PictureFeatures) -> PictureMatches:
        """Return the matches of two pictures."""
        import torch

        pictures = [shrunk(each.content, self._max_side) for each in (one, other)]
        height, width = np.max([small.shape[:2] for small, _ in pictures], axis=0).tolist()
        greys = [_padded(small, height, width) for small, _ in pictures]
        # The network wants three channels and reads the first.
        pair = torch.from_numpy(np.stack(greys))[None, :, None].expand(1, 2, 3, height, width)
        with torch.inference_mode():
            found = self._model(pixel_values=pair.contiguous().to(self._device))
        keypoints, mask, matches = (
            values[0].cpu().numpy() for values in (found.keypoints, found.mask, found.matches)
        )
        index = matches[0]
        rows = np.flatnonzero((index >= 0) & (mask[0] > 0))
        size = np.array([width, height])
        first, second = (keypoints[0][rows] * size, keypoints[1][index[rows]] * size)
        return PictureMatches((first + CORNER) * pictures[0][1], (second + CORNER) * pictures[1][1])


def _padded(picture: Picture, height: int, width: int) -> NDArray[np.float32]:
    """Return grey values (H, W) from 0 to 1, black to the right and below where the picture is smaller."""
    grey = np.zeros((height, width), dtype=np.float32)
    grey[: picture.shape[0], : picture.shape[1]] = picture @ np.array([0.299, 0.587, 0.114], np.float32) / 255
    return grey
