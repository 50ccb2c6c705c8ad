"""Why structure from motion found no model, with counts and what to do."""

from __future__ import annotations

from pathlib import Path

from toolkit.errors import StageError
from toolkit.matching.database import keypoint_counts, match_counts
from toolkit.matching.features import FEW_FEATURES


def check_matches(database_path: Path, min_matches: int) -> None:
    """Refuse a database that no model can come from.

    Raises
    ------
    StageError
        Where fewer than two pictures have features, no pairs were tried, or none has ``min_matches`` inliers.
    """
    counts = keypoint_counts(database_path)
    usable = [name for name, count in counts.items() if (count or 0) >= FEW_FEATURES]
    if len(usable) < 2:
        raise StageError(
            "Structure from motion needs pictures with features",
            expected=f"at least 2 pictures with {FEW_FEATURES} features",
            found=f"{len(usable)} of {len(counts)}",
            todo="Check that the pictures are sharp and textured and that masks leave something to see; lower "
            "peak_threshold or raise max_image_side",
        )
    pairs, matches, inliers = match_counts(database_path)
    if not len(pairs):
        raise StageError(
            "Structure from motion needs matched pictures", found="no matches", todo="Match the features first"
        )
    if not (inliers >= min_matches).any():
        raise StageError(
            "No two pictures show the same thing: their features have no common geometry",
            expected=f"pairs with at least {min_matches} matches that agree",
            found=f"none among {len(pairs)} pairs of {len(usable)} pictures (at most {matches.max()} matches by "
            f"descriptor and {inliers.max()} inliers)",
            todo="Check that neighbouring pictures overlap by more than half and are among the pairs to match",
        )


def no_initial_pair(database_path: Path, min_inliers: int, min_angle: float) -> StageError:
    """Return the error for matches from which no first pair of cameras could be placed."""
    pairs, _, inliers = match_counts(database_path)
    verified = int((inliers > 0).sum())
    return StageError(
        "No pair of pictures is a sound start for structure from motion",
        expected=f"a pair with {min_inliers} inliers and an angle of {min_angle:g} degrees between its rays "
        "(half of both was tried, too)",
        found=f"{verified} verified of {len(pairs)} pairs, the best with {inliers.max()} inliers",
        todo="Take pictures from different places, not only in different directions; or lower init_min_inliers or "
        "init_min_angle, or give cameras with a better start focal length",
    )
