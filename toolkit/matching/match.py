"""Matching features between pairs of pictures, and verifying each pair's geometry."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.matching.colmap_job import run_colmap
from toolkit.matching.database import match_counts, names_without_spaces, require_same_frames, settle, watch
from toolkit.matching.pairs import ChosenPairs, connected_groups
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene import Scene
from toolkit.settings import Boolean, Integer, Number, Settings

# A cancelled call stops after the block that it is in. Much smaller blocks make COLMAP build the search index of a
# picture again and again: 153 pairs took 10.1 s of processor time in one block, 9.9 s in blocks of 32, 11.5 s in
# blocks of 16.
_PAIRS_A_BLOCK = 32


class VerificationSettings(Settings):
    """Geometric verification of matches by RANSAC."""

    min_inliers = Integer(15, bounds=(6, 1000), unit="matches", doc="Least inliers of a pair that is verified.")
    max_error = Number(
        4.0, bounds=(0.1, 100.0), unit="px", doc="Largest distance of an inlier from its epipolar line."
    )
    confidence = Number(0.999, bounds=(0.5, 0.999999), doc="RANSAC stops when it is this sure of the best model.")
    max_trials = Integer(10000, bounds=(100, 1000000), unit="trials", doc="RANSAC stops here at the latest.")


class MatchSettings(VerificationSettings):
    """Nearest-neighbour matching of SIFT descriptors and geometric verification."""

    max_ratio = Number(
        0.8,
        bounds=(0.0, 1.0),
        doc="A match must be this much nearer than the second nearest descriptor (Lowe's test).",
    )
    max_distance = Number(0.7, bounds=(0.0, 2.0), doc="Largest angle between matched descriptors, in radians.")
    cross_check = Boolean(True, doc="Keep only matches that are nearest in both directions.")
    guided = Boolean(
        False, doc="Match again along the epipolar lines that were found: more matches, and many times the time."
    )
    # pycolmap 4.2.1 lost matches of some pair in 5 of 60 runs over 55 pairs with two threads, in two calls of one
    # thread at once as well, and in none of 60 with one.
    threads = Integer(
        1,
        bounds=(0, 256),
        doc="Pairs worked on at once; 0: as many as there are cores. With more than one COLMAP now and then loses "
        "matches of a pair, so that runs do not repeat.",
    )


@dataclass(frozen=True, slots=True, eq=False)
class MatchReport:
    """What the matching found.

    Attributes
    ----------
    names:
        Of the frames, in the order of the scene.
    pairs:
        (P, 2) indices of frames that were tried, i < j.
    matches:
        (P,) matches by descriptor.
    inliers:
        (P,) matches that agree with one geometry; 0 where the pair was not verified.
    seconds:
        Wall time.
    """

    names: tuple[str, ...]
    pairs: NDArray[np.int64]
    matches: NDArray[np.int64]
    inliers: NDArray[np.int64]
    seconds: float

    @property
    def verified(self) -> NDArray[np.bool_]:
        """(P,) whether the pair's geometry was found."""
        return self.inliers > 0

    @property
    def seconds_per_pair(self) -> float:
        """Wall time by pair that was tried, verification included; 0 without pairs."""
        return self.seconds / len(self.pairs) if len(self.pairs) else 0.0

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Frames that verified pairs connect, the largest group first. More than one: no single model."""
        return connected_groups(len(self.names), self.pairs[self.verified])

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers and the verified pairs, ``[i, j, matches, inliers]`` each, ready for JSON."""
        good = self.verified
        table = np.column_stack([self.pairs, self.matches, self.inliers])[good]
        return {
            "pairs_tried": len(self.pairs),
            "pairs_verified": int(good.sum()),
            "matches": int(self.matches.sum()),
            "inliers": int(self.inliers.sum()),
            "inliers_per_verified_pair": float(self.inliers[good].mean()) if good.any() else 0.0,
            "group_sizes": [len(group) for group in self.groups],
            "unmatched": [self.names[group[0]] for group in self.groups if len(group) == 1],
            "verified_pairs": table.tolist(),
            "seconds": self.seconds,
            "seconds_per_pair": self.seconds_per_pair,
        }


def match_pairs(
    database_path: Path,
    scene: Scene,
    pairs: ChosenPairs,
    settings: MatchSettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
) -> MatchReport:
    """Match the features in a database between pairs of frames and verify each pair, writing both into it.

    The same seed gives the same matches and inliers, as long as there is one thread.

    Parameters
    ----------
    database_path:
        A database with the scene's features and no matches; it is changed. Give a copy to keep the features for
        other settings (:func:`toolkit.matching.database.copy_database`).
    scene:
        The scene that the features were extracted from.
    pairs:
        From :func:`toolkit.matching.pairs.choose_pairs`.
    settings:
        As declared.
    seed:
        Of RANSAC.
    progress:
        Told how many pairs are done; raises to cancel.

    Raises
    ------
    DataError
        For a database that is missing, damaged or of another scene.
    StageError
        For a database that has matches already: COLMAP would skip those pairs and keep what other settings gave.
    """
    start = time.perf_counter()
    require_no_matches(database_path, scene)
    matching = _matching_options(settings)
    verification = verification_options(settings, seed)
    with pair_list(database_path, pairs) as path, watch(database_path) as database:

        def match(token: pycolmap.CancellationToken) -> None:
            pycolmap.match_image_pairs(
                database_path,
                matching_options=matching,
                pairing_options=pycolmap.ImportedPairingOptions(block_size=_PAIRS_A_BLOCK, match_list_path=path),
                verification_options=verification,
                device=pycolmap.Device.cpu,
                cancellation_token=token,
            )

        def event() -> ProgressEvent:
            return ProgressEvent("match", database.num_matched_image_pairs(), len(pairs))

        run_colmap(match, event, progress, database_path)
    settle(database_path)
    return match_report(database_path, scene, time.perf_counter() - start)


def require_no_matches(database_path: Path, scene: Scene) -> None:
    """Check that a database has the frames of a scene and no matches.

    Raises
    ------
    DataError
        For a database that is missing, damaged or of another scene.
    StageError
        For a database that has matches already.
    """
    require_same_frames(database_path, scene)
    if len(match_counts(database_path)[0]):
        raise StageError(
            f"{database_path} has matches already",
            expected="a database with features only",
            todo="Match in a fresh copy of it (copy_database)",
        )


def verify_pairs(
    database_path: Path, pairs: ChosenPairs, settings: VerificationSettings, *, seed: int, progress: Progress
) -> None:
    """Verify the matches that a database has between pairs of frames, as :func:`match_pairs` does its own.

    Parameters
    ----------
    database_path:
        With features and matches; the pairs' geometry is written into it.
    pairs:
        Of which matches were written.
    settings, seed, progress:
        As in :func:`match_pairs`.
    """
    verification = verification_options(settings, seed)
    with pair_list(database_path, pairs) as path, watch(database_path) as database:

        def verify(token: pycolmap.CancellationToken) -> None:
            pycolmap.verify_matches(database_path, path, options=verification, cancellation_token=token)

        def event() -> ProgressEvent:
            return ProgressEvent("match.verify", database.num_verified_image_pairs(), len(pairs))

        run_colmap(verify, event, progress, database_path)
    settle(database_path)


def match_report(database_path: Path, scene: Scene, seconds: float) -> MatchReport:
    """Return what a database says of the matches of a scene."""
    return MatchReport(tuple(frame.name for frame in scene.frames), *match_counts(database_path), seconds=seconds)


def verification_options(settings: VerificationSettings, seed: int) -> pycolmap.TwoViewGeometryOptions:
    """Return the settings as COLMAP takes them."""
    options = pycolmap.TwoViewGeometryOptions(min_num_inliers=settings.min_inliers)
    options.ransac.max_error = settings.max_error
    options.ransac.confidence = settings.confidence
    options.ransac.max_num_trials = settings.max_trials
    options.ransac.random_seed = seed
    return options


@contextmanager
def pair_list(database_path: Path, pairs: ChosenPairs) -> Iterator[Path]:
    """Yield a file that names the pairs as COLMAP reads them, beside the database."""
    with (
        names_without_spaces(database_path) as listed,
        tempfile.TemporaryDirectory(dir=database_path.parent, prefix=".pairs.", suffix=".tmp") as folder,
    ):
        path = Path(folder) / "pairs.txt"
        lines = (f"{listed[i]} {listed[j]}\n" for i, j in pairs.index.tolist())
        path.write_text("".join(lines), encoding="utf-8")
        yield path


def _matching_options(settings: MatchSettings) -> pycolmap.FeatureMatchingOptions:
    matching = pycolmap.FeatureMatchingOptions(
        type=pycolmap.FeatureMatcherType.SIFT_BRUTEFORCE,
        num_threads=settings.threads or -1,
        use_gpu=False,
        guided_matching=settings.guided,
    )
    matching.sift.max_ratio = settings.max_ratio
    matching.sift.max_distance = settings.max_distance
    matching.sift.cross_check = settings.cross_check
    return matching
