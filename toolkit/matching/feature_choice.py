"""One setting for which features are found and how they are matched."""

from __future__ import annotations

from pathlib import Path

from toolkit.errors import SettingsError
from toolkit.matching.added import AddedMatcherSettings, added_matchers, extract_added, match_added
from toolkit.matching.descriptors import descriptor_path
from toolkit.matching.features import FeatureReport, SiftSettings, extract_sift
from toolkit.matching.learned import extract_learned, match_learned
from toolkit.matching.learned_settings import (
    AlikedSettings,
    DiskSettings,
    LearnedFeatureSettings,
    LightGlueSettings,
)
from toolkit.matching.match import MatchReport, MatchSettings, match_pairs
from toolkit.matching.pairs import ChosenPairs
from toolkit.progress import Progress, silent
from toolkit.scene import Scene
from toolkit.settings import Choice, Group, Settings
from toolkit.workspace import code_version


class FeatureSettings(Settings):
    """Features and their matching; the settings of what was not chosen do not count.

    Matchers of other packages (:mod:`toolkit.matching.added`) are further choices, each with a group of its own.
    """

    method = Choice(
        "sift",
        choices=("sift", "disk-lightglue", "aliked-lightglue", *added_matchers()),
        doc="SIFT with nearest neighbours, or learned features matched by LightGlue (make features installs them).",
    )
    sift = Group(SiftSettings(), doc="SIFT features")
    disk = Group(DiskSettings(), doc="DISK features")
    aliked = Group(AlikedSettings(), doc="ALIKED features")
    match = Group(MatchSettings(), doc="Matching of SIFT features and geometric verification")
    lightglue = Group(LightGlueSettings(), doc="Matching of learned features and geometric verification")

    @property
    def version(self) -> str:
        """The method's name, of an added one with the version of its code, which the toolkit's does not tell."""
        added = added_matchers().get(self.method)
        return self.method if added is None else f"{self.method} {code_version(added.module)}"

    @property
    def chosen_features(self) -> SiftSettings | LearnedFeatureSettings | AddedMatcherSettings:
        """The settings of the features that were chosen."""
        if self.method in added_matchers():
            return self._added
        chosen: dict[str, SiftSettings | LearnedFeatureSettings] = {
            "sift": self.sift,
            "disk-lightglue": self.disk,
            "aliked-lightglue": self.aliked,
        }
        return chosen[self.method]

    @property
    def chosen_matching(self) -> MatchSettings | LightGlueSettings | AddedMatcherSettings:
        """The settings of their matching."""
        if self.method in added_matchers():
            return self._added
        matching: MatchSettings | LightGlueSettings = self.match if self.method == "sift" else self.lightglue
        return matching

    @property
    def _added(self) -> AddedMatcherSettings:
        settings: AddedMatcherSettings = getattr(self, added_matchers()[self.method].group)
        return settings


for _matcher in added_matchers().values():
    FeatureSettings.param.add_parameter(_matcher.group, Group(_matcher.settings_type(), doc=_matcher.doc))


def as_feature_settings(
    features: SiftSettings | FeatureSettings, match: MatchSettings | None = None
) -> FeatureSettings:
    """Return settings of SIFT and of its matching as one, or those that are one already.

    Raises
    ------
    SettingsError
        Where ``match`` is given beside settings that say already how their features are matched.
    """
    if not isinstance(features, FeatureSettings):
        return FeatureSettings(sift=features, match=match or MatchSettings())
    if match is not None:
        raise SettingsError(
            "Two settings of how features are matched",
            expected="FeatureSettings alone, which have their own",
            todo="Set them there",
        )
    return features


def extract_features(
    scene: Scene,
    database_path: Path,
    settings: SiftSettings | LearnedFeatureSettings | AddedMatcherSettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
    device: str = "cpu",
) -> FeatureReport:
    """Write a new database with the features that the settings are of.

    See :func:`~toolkit.matching.features.extract_sift`, :func:`~toolkit.matching.learned.extract_learned` and
    :func:`~toolkit.matching.added.extract_added`, also for what they raise. SIFT's are found on the processor
    whatever the device.
    """
    if isinstance(settings, AddedMatcherSettings):
        return extract_added(scene, database_path, settings, progress=progress)
    if isinstance(settings, SiftSettings):
        return extract_sift(scene, database_path, settings, seed=seed, progress=progress)
    return extract_learned(scene, database_path, settings, seed=seed, progress=progress, device=device)


def match_features(
    database_path: Path,
    scene: Scene,
    pairs: ChosenPairs,
    settings: MatchSettings | LightGlueSettings | AddedMatcherSettings,
    *,
    features_from: Path | None = None,
    seed: int = 0,
    progress: Progress = silent,
    device: str = "cpu",
) -> MatchReport:
    """Match and verify the features of a database by the method that the settings are of.

    See :func:`~toolkit.matching.match.match_pairs`, :func:`~toolkit.matching.learned.match_learned` and
    :func:`~toolkit.matching.added.match_added`, also for what they raise.

    Parameters
    ----------
    features_from:
        The database that ``database_path`` is a copy of; None where it is none. Descriptors of learned features are
        beside that one.
    """
    described = descriptor_path(features_from or database_path)
    if isinstance(settings, AddedMatcherSettings):
        return match_added(
            database_path, scene, pairs, settings, descriptors=described, seed=seed, progress=progress
        )
    if isinstance(settings, MatchSettings):
        return match_pairs(database_path, scene, pairs, settings, seed=seed, progress=progress)
    return match_learned(
        database_path,
        scene,
        pairs,
        settings,
        descriptors=described,
        seed=seed,
        progress=progress,
        device=device,
    )
