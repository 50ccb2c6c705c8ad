"""Features with their matcher that another package adds, by an entry point of the group ``toolkit.matchers``.

What it adds finds features of one picture and matches those of two. Reading pictures, masks, COLMAP's database,
verification and reports are the toolkit's.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import CapabilityError, DataError, StageError
from toolkit.matching.database import create_database
from toolkit.matching.descriptors import Descriptors, descriptor_path, open_descriptors
from toolkit.matching.feature_store import store_features, store_matches
from toolkit.matching.features import FeatureReport, camera_model_choice, check_pictures, start_cameras
from toolkit.matching.match import MatchReport, VerificationSettings, match_report, require_no_matches, verify_pairs
from toolkit.matching.pairs import ChosenPairs
from toolkit.optional import MATCHERS, added_by_packages
from toolkit.progress import Progress, silent, track
from toolkit.scene import Frame, Scene
from toolkit.scene.pictures import load_mask, load_picture


class AddedMatcherSettings(VerificationSettings):
    """What the settings of an added matcher have; its own are declared in a class derived from this one."""

    camera_model = camera_model_choice()


@dataclass(frozen=True, slots=True, eq=False)
class Detected:
    """The features of a picture.

    Attributes
    ----------
    pixels:
        (K, 2) float32, pixel centres at +0.5.
    descriptors:
        (K, D) float32. They are kept in half precision.
    size:
        Width and height of the picture in pixels.
    """

    pixels: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    size: tuple[int, int]


class Detect(Protocol):
    """Finds the features of a picture."""

    def __call__(self, picture: NDArray[np.uint8], settings: Any, /) -> tuple[ArrayLike, ArrayLike]:
        """Return pixels (K, 2), centres at +0.5, and descriptors (K, D) of a picture (H, W, 3)."""


class Match(Protocol):
    """Matches the features of two pictures."""

    def __call__(self, one: Detected, other: Detected, settings: Any, /) -> ArrayLike:
        """Return (M, 2) places of matching features in the one and in the other picture, each at most once."""


@dataclass(frozen=True, slots=True)
class Matcher:
    """Features and how they are matched, by a name.

    Attributes
    ----------
    name:
        As it is given for ``features.method``; also that of the entry point.
    doc:
        A line on what it is.
    settings_type:
        Derived from :class:`AddedMatcherSettings`, of this matcher alone. In ``FeatureSettings`` they are the group
        that has the matcher's name, with ``_`` for ``-``.
    detect, match:
        Functions of a module, called with a frozen copy of the settings.
    """

    name: str
    doc: str
    settings_type: type[AddedMatcherSettings]
    detect: Detect
    match: Match

    @property
    def group(self) -> str:
        """Name of the group of its settings."""
        return self.name.replace("-", "_")

    @property
    def module(self) -> ModuleType:
        """Where it is declared: a change of that file makes features be found again."""
        return sys.modules[self.settings_type.__module__]


@cache
def added_matchers() -> dict[str, Matcher]:
    """Return the matchers that installed packages add, by name.

    Raises
    ------
    MissingDependencyError, CapabilityError
        Where one cannot be loaded, is none, or its name or its settings serve another one already.
    """
    found = added_by_packages(MATCHERS, Matcher)
    taken = {"method", "sift", "disk", "aliked", "match", "lightglue", "disk_lightglue", "aliked_lightglue"}
    kinds: list[type[AddedMatcherSettings]] = [AddedMatcherSettings]
    for matcher in found.values():
        if not matcher.group.isidentifier() or matcher.group in taken:
            raise CapabilityError(
                f"A matcher cannot be named '{matcher.name}'",
                expected="a new name of letters, digits and dashes that begins with a letter",
                todo="Rename it in the package that adds it",
            )
        if not issubclass(matcher.settings_type, AddedMatcherSettings) or matcher.settings_type in kinds:
            raise CapabilityError(
                f"The settings of the matcher '{matcher.name}' are not its own",
                expected="a class of its own, derived from AddedMatcherSettings",
                found=matcher.settings_type.__name__,
                todo="Declare one in the package that adds it",
            )
        taken.add(matcher.group)
        kinds.append(matcher.settings_type)
    return found


def matcher_of(settings: AddedMatcherSettings) -> Matcher:
    """Return the matcher that settings are of.

    Raises
    ------
    StageError
        Where no installed package adds one with settings of this class.
    """
    for matcher in added_matchers().values():
        if type(settings) is matcher.settings_type:
            return matcher
    raise StageError(
        f"No matcher has settings of the class {type(settings).__name__}",
        expected="one of " + ", ".join(m.settings_type.__name__ for m in added_matchers().values()),
        todo=f"Install the package that adds it by an entry point of the group {MATCHERS}",
    )


def extract_added(
    scene: Scene,
    database_path: Path,
    settings: AddedMatcherSettings,
    *,
    matcher: Matcher | None = None,
    progress: Progress = silent,
) -> FeatureReport:
    """Write a new COLMAP database with the scene's frames and the features that an added matcher finds.

    Features under a mask's zeros are left out. Keypoints are in the database, descriptors in a file beside it.

    Parameters
    ----------
    scene, database_path, progress:
        As in :func:`toolkit.matching.learned.extract_learned`.
    settings:
        Of the matcher.
    matcher:
        The matcher itself; None: the installed one whose settings these are.

    Raises
    ------
    StageError
        Where no installed matcher has such settings, or what it found is no keypoints and descriptors.
    DataError, CapabilityError
        As :func:`toolkit.matching.learned.extract_learned`.
    """
    import torch

    using, frozen, start = matcher or matcher_of(settings), settings.frozen(), time.perf_counter()
    check_pictures(scene, progress)
    create_database(database_path, scene, start_cameras(scene, settings.camera_model))
    found = [_detected(using, scene, frame, frozen) for frame in track(scene.frames, "features", progress)]
    keypoints = {number: each.pixels for number, each in enumerate(found, start=1)}
    descriptors = {number: torch.from_numpy(each.descriptors) for number, each in enumerate(found, start=1)}
    store_features(database_path, keypoints, descriptors, using.name)
    counts = {frame.name: len(each.pixels) for frame, each in zip(scene.frames, found, strict=True)}
    return FeatureReport(counts, time.perf_counter() - start)


def match_added(
    database_path: Path,
    scene: Scene,
    pairs: ChosenPairs,
    settings: AddedMatcherSettings,
    *,
    matcher: Matcher | None = None,
    descriptors: Path | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> MatchReport:
    """Match the features of an added matcher between pairs of frames, and verify each pair.

    Parameters
    ----------
    database_path, scene, pairs, descriptors, seed, progress:
        As in :func:`toolkit.matching.learned.match_learned`.
    settings, matcher:
        As in :func:`extract_added`.

    Raises
    ------
    StageError
        For a database that has matches already; where what the matcher returned are no places of features.
    DataError
        For a database or descriptors that are missing, damaged, of another scene or of another matcher.
    """
    using, frozen, start = matcher or matcher_of(settings), settings.frozen(), time.perf_counter()
    require_no_matches(database_path, scene)
    path = descriptors or descriptor_path(database_path)
    with open_descriptors(path, database_path) as known:
        if known.kind != using.name:
            raise DataError(f"{path} is not of '{using.name}'", expected=using.name, found=f"'{known.kind}'")
        found = [
            _matched(using, _stored(known, scene, i), _stored(known, scene, j), frozen)
            for i, j in track(pairs.index.tolist(), "match", progress, total=len(pairs))
        ]
    store_matches(database_path, pairs, found)
    verify_pairs(database_path, pairs, settings, seed=seed, progress=progress)
    return match_report(database_path, scene, time.perf_counter() - start)


def _detected(matcher: Matcher, scene: Scene, frame: Frame, settings: AddedMatcherSettings) -> Detected:
    picture = load_picture(scene.image_path(frame))
    height, width = picture.shape[:2]
    pixels, descriptors = (np.asarray(part, dtype=np.float32) for part in matcher.detect(picture, settings))
    right = pixels.ndim == descriptors.ndim == 2 and len(pixels) == len(descriptors) and pixels.shape[1] == 2
    if not (right and np.isfinite(pixels).all() and np.isfinite(descriptors.astype(np.float16)).all()):
        raise StageError(
            f"The matcher '{matcher.name}' gave no features of {frame.name}",
            expected="finite pixels (K, 2) and descriptors (K, D) that half precision holds",
            found=f"arrays of the shapes {pixels.shape} and {descriptors.shape}",
        )
    mask = load_mask(scene, frame)
    if mask is not None:
        column, row = (np.clip(pixels[:, axis].astype(int), 0, (width, height)[axis] - 1) for axis in (0, 1))
        pixels, descriptors = pixels[mask[row, column]], descriptors[mask[row, column]]
    return Detected(np.ascontiguousarray(pixels), np.ascontiguousarray(descriptors), (width, height))


def _stored(known: Descriptors, scene: Scene, index: int) -> Detected:
    camera = scene.camera_of(scene.frames[index])
    return Detected(known.keypoints[index + 1], known.of(index + 1).numpy(), (camera.width, camera.height))


def _matched(
    matcher: Matcher, one: Detected, other: Detected, settings: AddedMatcherSettings
) -> NDArray[np.uint32]:
    if not (len(one.pixels) and len(other.pixels)):
        return np.zeros((0, 2), dtype=np.uint32)
    index = np.asarray(matcher.match(one, other, settings))
    right = index.ndim == 2 and index.shape[1] == 2 and (index.size == 0 or np.issubdtype(index.dtype, np.integer))
    ends = (len(one.pixels), len(other.pixels))
    if not (right and (index >= 0).all() and (index < ends).all()):
        raise StageError(
            f"The matcher '{matcher.name}' gave no matches",
            expected=f"(M, 2) places among {ends[0]} and {ends[1]} features",
            found=f"an array of the shape {index.shape} and the type {index.dtype}",
        )
    return np.ascontiguousarray(index, dtype=np.uint32)
