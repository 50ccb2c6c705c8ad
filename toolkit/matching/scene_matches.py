"""Features and verified matches of a scene in one call, for work outside of recipes, which keep each step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from toolkit.matching.features import SiftSettings, extract_sift
from toolkit.matching.match import MatchReport, MatchSettings, match_pairs
from toolkit.matching.pairs import PairSettings, choose_pairs
from toolkit.progress import Progress, silent
from toolkit.scene import Scene


@dataclass(frozen=True, slots=True, eq=False)
class SceneMatches:
    """A database with features and matches.

    Attributes
    ----------
    database:
        COLMAP's database.
    report:
        What was matched.
    seconds:
        Wall time of features and matches.
    """

    database: Path
    report: MatchReport
    seconds: Mapping[str, float]


def match_scene(
    scene: Scene,
    database: Path,
    sift: SiftSettings,
    pairs: PairSettings,
    match: MatchSettings | None = None,
    *,
    seed: int = 0,
    progress: Progress = silent,
) -> SceneMatches:
    """Extract features, choose pairs and match them, into a new database.

    A database that is there is written anew. Raises as :func:`~toolkit.matching.pairs.choose_pairs`,
    :func:`~toolkit.matching.features.extract_sift` and :func:`~toolkit.matching.match.match_pairs`.
    """
    chosen = choose_pairs(scene, pairs)  # what the pairs lack is told before features are extracted
    features = extract_sift(scene, database, sift, seed=seed, progress=progress)
    report = match_pairs(database, scene, chosen, match or MatchSettings(), seed=seed, progress=progress)
    return SceneMatches(database, report, {"features": features.seconds, "matches": report.seconds})
