"""Features and verified matches of a scene in one call, for work outside of recipes, which keep each step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from toolkit.matching.feature_choice import FeatureSettings, as_feature_settings, extract_features, match_features
from toolkit.matching.features import SiftSettings
from toolkit.matching.match import MatchReport, MatchSettings
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
    features: SiftSettings | FeatureSettings,
    pairs: PairSettings,
    match: MatchSettings | None = None,
    *,
    seed: int = 0,
    progress: Progress = silent,
    device: str = "cpu",
) -> SceneMatches:
    """Extract features, choose pairs and match them, into a new database.

    A database that is there is written anew. Raises as :func:`~toolkit.matching.pairs.choose_pairs`,
    :func:`~toolkit.matching.feature_choice.extract_features` and
    :func:`~toolkit.matching.feature_choice.match_features`.

    Parameters
    ----------
    features:
        :class:`~toolkit.matching.feature_choice.FeatureSettings`, which also say how they are matched, or those of
        SIFT.
    match:
        How SIFT features are matched where ``features`` are SIFT's settings; None: by default.
    """
    chosen = choose_pairs(scene, pairs)  # what the pairs lack is told before features are extracted
    settings = as_feature_settings(features, match)
    found = extract_features(scene, database, settings.chosen_features, seed=seed, progress=progress, device=device)
    report = match_features(
        database, scene, chosen, settings.chosen_matching, seed=seed, progress=progress, device=device
    )
    return SceneMatches(database, report, {"features": found.seconds, "matches": report.seconds})
