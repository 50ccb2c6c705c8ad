"""Structure from motion in one call: features, pairs, matches, poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from toolkit.matching.database import copy_database
from toolkit.matching.features import FeatureReport, SiftSettings, extract_sift
from toolkit.matching.match import MatchReport, MatchSettings, match_pairs
from toolkit.matching.pairs import ChosenPairs, PairSettings, choose_pairs
from toolkit.poses.sfm import SfmSettings, incremental_sfm
from toolkit.poses.sfm_result import SfmResult
from toolkit.progress import Progress, silent
from toolkit.scene import Scene
from toolkit.settings import Group, Settings


class SfmPipelineSettings(Settings):
    """Structure from motion from pictures to poses."""

    sift = Group(SiftSettings(), doc="Features")
    pairs = Group(PairSettings(), doc="Which pictures are matched with which")
    match = Group(MatchSettings(), doc="Matching and geometric verification")
    sfm = Group(SfmSettings(), doc="Incremental structure from motion")


@dataclass(frozen=True, slots=True)
class SfmPipelineResult:
    """What each part found."""

    features: FeatureReport
    pairs: ChosenPairs
    matches: MatchReport
    sfm: SfmResult

    @property
    def scene(self) -> Scene:
        """The scene with poses, cameras, points and tracks."""
        return self.sfm.scene

    def to_dict(self) -> dict[str, Any]:
        """Return the reports by part, ready for JSON."""
        return {
            "features": self.features.to_dict(),
            "pairs": self.pairs.to_dict(),
            "matches": self.matches.to_dict(),
            "sfm": self.sfm.to_dict(),
        }


def sfm(
    scene: Scene, settings: SfmPipelineSettings, *, work_dir: Path, seed: int = 0, progress: Progress = silent
) -> SfmPipelineResult:
    """Find poses, cameras and points from the scene's pictures.

    Leaves ``features.db`` and ``matches.db`` in ``work_dir``; those of an earlier call are replaced.

    Raises
    ------
    DataError, StageError, CapabilityError
        As the parts do: :func:`~toolkit.matching.features.extract_sift`,
        :func:`~toolkit.matching.pairs.choose_pairs`, :func:`~toolkit.matching.match.match_pairs` and
        :func:`~toolkit.poses.sfm.incremental_sfm`.
    """
    # What the pairs lack is told before the features are extracted.
    pairs = choose_pairs(scene, settings.pairs)
    features, matched = work_dir / "features.db", work_dir / "matches.db"
    found = extract_sift(scene, features, settings.sift, seed=seed, progress=progress)
    copy_database(features, matched)
    matches = match_pairs(matched, scene, pairs, settings.match, seed=seed, progress=progress)
    poses = incremental_sfm(scene, matched, settings.sfm, seed=seed, progress=progress, work_dir=work_dir)
    return SfmPipelineResult(found, pairs, matches, poses)
