"""Matches between two pictures that are in no database: a photo and what a map shows from a guessed place.

SIFT is COLMAP's (pycolmap), ALIKED, DISK and their LightGlue are those of :mod:`toolkit.matching.learned`,
SuperPoint with LightGlue is a model of ``transformers`` (:mod:`toolkit.matching.superpoint`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.matching.colmap_job import quiet_colmap
from toolkit.matching.learned import CORNER, feature_network, glue_network, limit_features
from toolkit.matching.learned_settings import AlikedSettings, DiskSettings, LightGlueSettings
from toolkit.matching.picture_settings import PictureMatchSettings
from toolkit.scene.pictures import area_resize

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

# Rows of descriptors that are compared at once: memory stays below 100 MB.
_BLOCK = 2048
# Columns of COLMAP's keypoints (place, scale and orientation) and of SIFT's descriptors.
_NUMBERS, _DESCRIBED = 4, 128


@dataclass(frozen=True, slots=True, eq=False)
class PictureFeatures:
    """What a matcher keeps of a picture.

    Attributes
    ----------
    pixels:
        (K, 2) keypoints in the picture as it was given, pixel centres at +0.5. Of matchers that find them only
        when they match: (0, 2).
    content:
        Descriptors or the picture, as the matcher wants it.
    size:
        Width and height in pixels.
    """

    pixels: Array
    content: Any
    size: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class PictureMatches:
    """Pixels (M, 2) of the one picture and of the other that show the same."""

    first: Array
    second: Array

    def __len__(self) -> int:
        return len(self.first)


class PictureMatcher(Protocol):
    """Finds features of a picture once, and matches them with those of many others."""

    @property
    def method(self) -> str:
        """One of :data:`toolkit.matching.picture_settings.METHODS`."""

    def features(self, picture: Picture) -> PictureFeatures:
        """Return what is needed of a picture (H, W, 3) uint8."""

    def match(self, one: PictureFeatures, other: PictureFeatures) -> PictureMatches:
        """Return the matches of two pictures; their order is that of the first one's features."""


def picture_matcher(settings: PictureMatchSettings, *, device: str = "cpu") -> PictureMatcher:
    """Return the matcher that the settings name.

    Raises
    ------
    MissingDependencyError
        Where a package that it needs is not installed.
    WeightsMissingError
        For SuperPoint without weights.
    """
    if settings.method == "sift":
        return _SiftMatcher(settings)
    if settings.method == "superpoint-lightglue":
        from toolkit.matching.superpoint import SuperPointMatcher

        return SuperPointMatcher(settings, device=device)
    return _LearnedMatcher(settings, device)


def shrunk(picture: Picture, max_side: int) -> tuple[Picture, Array]:
    """Return a picture with no side above ``max_side``, and the factors (2,) from its pixels to the old ones."""
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        raise DataError("This is no picture", expected="(H, W, 3) uint8", found=f"{picture.shape} {picture.dtype}")
    height, width = picture.shape[:2]
    scale = min(1.0, max_side / max(width, height))
    if scale == 1.0:
        return picture, np.ones(2)
    small = area_resize(picture, max(1, round(scale * width)), max(1, round(scale * height)))
    return small, np.array([width / small.shape[1], height / small.shape[0]])


class _SiftMatcher:
    """COLMAP's SIFT, mutual nearest neighbours that pass the ratio test (Lowe 2004, section 7.1)."""

    method = "sift"

    def __init__(self, settings: PictureMatchSettings) -> None:
        self._settings = settings
        options = pycolmap.FeatureExtractionOptions(use_gpu=False)
        options.sift.max_num_features = settings.max_features
        options.sift.first_octave = -1 if settings.upsample else 0
        options.sift.peak_threshold = settings.peak_threshold
        with quiet_colmap():
            self._sift = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)

    def features(self, picture: Picture) -> PictureFeatures:
        small, factors = shrunk(picture, self._settings.max_image_side)
        # The weights of Rec. 601, as for every grey picture of COLMAP's.
        grey = np.rint(small @ np.array([0.299, 0.587, 0.114])).astype(np.uint8)
        found, described = self._sift.extract_from_uint8_array(np.ascontiguousarray(grey))
        keypoints = np.asarray(pycolmap.keypoints_to_matrix(found)).reshape(len(found), _NUMBERS)
        descriptors = np.asarray(described.data, dtype=np.float32).reshape(len(found), _DESCRIBED)
        lengths = np.linalg.norm(descriptors, axis=1, keepdims=True)
        return PictureFeatures(
            keypoints[:, :2].astype(np.float64) * factors,
            (descriptors / np.maximum(lengths, 1e-12)).astype(np.float32),
            (picture.shape[1], picture.shape[0]),
        )

    def match(self, one: PictureFeatures, other: PictureFeatures) -> PictureMatches:
        if len(one.pixels) < 2 or len(other.pixels) < 2:
            return PictureMatches(np.zeros((0, 2)), np.zeros((0, 2)))
        nearest, distance, second = _two_nearest(one.content, other.content)
        back, _, _ = _two_nearest(other.content, one.content)
        rows = np.arange(len(nearest))
        good = (back[nearest] == rows) & (distance < self._settings.max_ratio * second)
        return PictureMatches(one.pixels[good], other.pixels[nearest[good]])


def _two_nearest(one: NDArray[np.float32], other: NDArray[np.float32]) -> tuple[NDArray[np.intp], Array, Array]:
    """Return for each unit row of ``one`` (N, D) the nearest in ``other`` and the two smallest distances (N,)."""
    index, nearest, second = [], [], []
    for begin in range(0, len(one), _BLOCK):
        alike = one[begin : begin + _BLOCK] @ other.T
        rows = np.arange(len(alike))
        best = alike.argmax(axis=1)
        top = alike[rows, best].copy()
        alike[rows, best] = -1.0
        index.append(best)
        nearest.append(top)
        second.append(alike.max(axis=1))
    near, far = (
        np.sqrt(np.maximum(0.0, 2 - 2 * np.concatenate(part).astype(np.float64))) for part in (nearest, second)
    )
    return np.concatenate(index), near, far


class _LearnedMatcher:
    """ALIKED or DISK features, matched by LightGlue."""

    def __init__(self, settings: PictureMatchSettings, device: str) -> None:
        self.method = settings.method
        self._max_side, self._device = settings.max_image_side, device
        self._features: DiskSettings | AlikedSettings
        if settings.method == "disk-lightglue":
            self._features = DiskSettings(max_features=settings.max_features)
        else:
            self._features = AlikedSettings(max_features=settings.max_features, model=settings.aliked_model)
        self._extractor = feature_network(self._features, device)
        limit_features(self._extractor, self._features, settings.max_features)
        self._glue = glue_network(
            self._features.kind, LightGlueSettings(min_confidence=settings.min_confidence), device
        )

    def features(self, picture: Picture) -> PictureFeatures:
        import torch

        small, factors = shrunk(picture, self._max_side)
        tensor = torch.from_numpy(small.copy()).to(self._device).permute(2, 0, 1).float() / 255
        with torch.inference_mode():
            found = self._extractor.extract(tensor, resize=None)
        pixels = found["keypoints"][0].cpu().numpy().astype(np.float64)
        # ALIKED takes its mean score for the threshold where nothing reaches the one that it was given.
        kept = found["keypoint_scores"][0] >= self._features.detection_threshold
        content = (found["keypoints"][0][kept], found["descriptors"][0][kept], (small.shape[1], small.shape[0]))
        where = (pixels[kept.cpu().numpy()] + CORNER) * factors
        return PictureFeatures(where, content, (picture.shape[1], picture.shape[0]))

    def match(self, one: PictureFeatures, other: PictureFeatures) -> PictureMatches:
        import torch

        if not (len(one.pixels) and len(other.pixels)):
            return PictureMatches(np.zeros((0, 2)), np.zeros((0, 2)))
        with torch.inference_mode():
            found = self._glue({"image0": self._described(one), "image1": self._described(other)})
        index = found["matches"][0].cpu().numpy()
        return PictureMatches(one.pixels[index[:, 0]], other.pixels[index[:, 1]])

    def _described(self, features: PictureFeatures) -> dict[str, Any]:
        import torch

        keypoints, descriptors, size = features.content
        return {
            "keypoints": keypoints[None],
            "descriptors": descriptors[None],
            "image_size": torch.tensor([size], dtype=torch.float32, device=self._device),
        }
