"""Predicted depth of single photos, to which a splat's depth is held while it is trained."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from toolkit import depth
from toolkit.depth.monocular import DepthPrediction, MonocularDepth
from toolkit.depth.providers import depth_provider, source_files
from toolkit.depth.settings import DepthSettings
from toolkit.files import atomic_path
from toolkit.progress import track
from toolkit.recipes.base import RecipeContext
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene
from toolkit.splat.depth_settings import DepthLossSettings

if TYPE_CHECKING:  # Whoever reads settings does without PyTorch.
    from toolkit.splat.depth_loss import PredictedDepth

STAGE = "depth-maps"
#: Longer side at which predictions are kept: networks see less, and splats are mostly trained at no more.
_MOST = 800


@dataclass(frozen=True, slots=True)
class HeldDepth:
    """What a splat's depth is held to: a source that was loaded, and how much.

    Attributes
    ----------
    provider:
        Loaded.
    source, loss:
        The settings.
    """

    provider: MonocularDepth
    source: DepthSettings
    loss: DepthLossSettings

    def stage(self, flat: CachedStage, scene_folder: str, context: RecipeContext) -> CachedStage:
        """Return the stage ``STAGE``: predictions for the training photos of an earlier stage's scene.

        Raises
        ------
        DataError
            Where the source has nothing for a photo, or something of another size.
        """

        def maps_into(folder: Path) -> dict[str, Any]:
            scene = read_scene(flat.folder / scene_folder)
            kinds = set()
            for number, frame in enumerate(track(scene.of_split("train"), STAGE, context.progress)):
                prediction = self.provider.predict(scene, frame)
                kinds.add(prediction.kind)
                with atomic_path(folder / f"{number:05d}.npy") as temporary, temporary.open("wb") as handle:
                    np.save(handle, _kept(prediction, self.source.min_confidence))
            return {"images": len(scene.of_split("train")), "source": self.provider.name, "kinds": sorted(kinds)}

        return cached_stage(
            context,
            STAGE,
            inputs={flat.time.name: flat.output.key, "files": source_files(self.source)},
            settings=self.source,
            code=(depth,),
            build=maps_into,
        )

    def predicted(self, maps: CachedStage, scene: Scene) -> PredictedDepth:
        """Return what that stage holds for a scene's training photos."""
        from toolkit.splat.depth_loss import PredictedDepth

        values = {
            frame.name: np.load(maps.folder / f"{number:05d}.npy", allow_pickle=False)
            for number, frame in enumerate(scene.of_split("train"))
        }
        kinds = maps.report["kinds"]
        return PredictedDepth(values, "disparity" if kinds == ["affine-disparity"] else "depth", self.loss)


def held_depth(source: DepthSettings, loss: DepthLossSettings) -> HeldDepth | None:
    """Return the source of depth that a splat is held to, loaded; None where the loss has no weight.

    Raises
    ------
    MissingDependencyError
        Where a package is missing; :class:`~toolkit.errors.WeightsMissingError` where weights are.
    SettingsError, DataError
        As :func:`toolkit.depth.providers.depth_provider`.
    """
    return None if loss.weight == 0 else HeldDepth(depth_provider(source), source, loss)


def _kept(prediction: DepthPrediction, least: float) -> NDArray[np.float32]:
    """Return what is believed of a prediction, no larger than is kept: NaN elsewhere."""
    # Imported only now: whoever reads settings does without PyTorch.
    from toolkit.splat.depth_loss import resampled

    values = prediction.values
    if prediction.confidence is not None:
        values = np.where(prediction.confidence >= least, values, np.float32(np.nan))
    height, width = values.shape
    scale = min(1.0, _MOST / max(height, width))
    size = max(1, round(scale * width)), max(1, round(scale * height))
    return values if scale == 1.0 else resampled(values, *size).numpy()
