"""What recipes with feed-forward networks share first: the network, views, and their prediction."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from toolkit.errors import DataError, SettingsError
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses import feedforward
from toolkit.poses.feedforward import providers
from toolkit.poses.feedforward.network import FeedForwardNetwork
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.prediction_pictures import with_picture_colours, without_masked
from toolkit.poses.feedforward.predictions_file import read_predictions, write_predictions
from toolkit.poses.feedforward.settings import FeedForwardSettings
from toolkit.poses.satellite import require_rpc_cameras
from toolkit.progress import ProgressEvent
from toolkit.recipes.base import RecipeContext
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.satellite_steps import SatelliteStages
from toolkit.recipes.steps import SCENE
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene
from toolkit.scene.pictures import load_picture
from toolkit.views.scene_views import SceneSelection, select_from_scene
from toolkit.views.settings import ViewSelectionSettings
from toolkit.workspace import file_fingerprint

#: In the folder of a stage that predicts or adjusts.
PREDICTIONS = "predictions.npz"


def load_network(settings: FeedForwardSettings) -> FeedForwardNetwork | None:
    """Return the network, loaded, so that what is missing is told before any work; None for the provider ``file``.

    Raises
    ------
    SettingsError
        Where the provider is ``file`` and no file is named.
    MissingDependencyError, CapabilityError, DataError
        As :func:`toolkit.poses.feedforward.providers.network`.
    """
    if settings.provider != "file":
        return providers.network(settings)
    if not settings.file:
        raise SettingsError("The provider 'file' needs a file", expected="network.file=<where predictions lie>")
    return None


def choose_views(scene: Scene, settings: ViewSelectionSettings, seed: int) -> SceneSelection:
    """Return views chosen by the exact directions of their RPCs, as delivered: pixels of bias do not turn them.

    Raises
    ------
    StageError
        Where a picture has no RPC, and as :func:`toolkit.views.scene_views.select_from_scene`.
    """
    require_rpc_cameras(scene)
    still = RigidTransform.identity()
    posed = tuple(dataclasses.replace(frame, cam_from_world=still) for frame in scene.frames)
    return select_from_scene(scene.replace(frames=posed, points=None), settings, seed=seed)


def require_predicted(path: Path, names: Sequence[str]) -> None:
    """Refuse, before any work, a file that is no prediction of just these pictures.

    A prediction of more pictures is another one: a network that sees them all says other things of each.

    Raises
    ------
    DataError
        Where the file is missing, damaged, or of other pictures; the message names those that it should be of.
    """
    _of_pictures(read_predictions(path), names, path)


def prediction_stage(
    found: SatelliteStages,
    names: Sequence[str],
    settings: FeedForwardSettings,
    network: FeedForwardNetwork | None,
    context: RecipeContext,
    *,
    file: Path | None = None,
) -> CachedStage:
    """Return the stage prediction of some pictures together, in ``PREDICTIONS``; its report has the time it took.

    Parameters
    ----------
    names:
        Of the frames as they were delivered. The network sees them in the scene's order.
    network:
        That of :func:`load_network`; without one ``file`` is taken.

    Raises
    ------
    DataError, StageError
        As the network says, as :func:`require_predicted`, and where masks leave nothing.
    """
    scene = chosen_pictures(found, names)
    if file is not None and not file.is_file():
        raise DataError(
            f"There is no prediction {file}",
            expected="one of " + ", ".join(sorted(names)) + " together",
            todo="Compute it, and copy it here",
        )

    def predicted_into(folder: Path) -> dict[str, Any]:
        own = [frame.name for frame in scene.frames]
        seconds: float | None = None
        if network is None:
            # In what time a file is read says nothing of the network.
            assert file is not None
            said = providers.of_scene(_of_pictures(read_predictions(file), own, file), scene)
        else:
            pictures = [load_picture(scene.image_path(frame)) for frame in scene.frames]
            context.progress(ProgressEvent("prediction", 0, 1, f"{network.name}, {len(own)} pictures"))
            start = time.perf_counter()
            said = network.predict(pictures, own, seed=context.seed)
            seconds = time.perf_counter() - start
        said = with_picture_colours(without_masked(said, scene), scene)
        write_predictions(folder / PREDICTIONS, said)
        context.progress(ProgressEvent("prediction", 1, 1))
        return {"seconds": seconds, **said.to_dict()}

    return cached_stage(
        context,
        "prediction",
        inputs={
            "pictures": found.stages[0].output.key,
            "frames": [frame.name for frame in scene.frames],
            "file": None if file is None else file_fingerprint(file),
        },
        settings=settings,
        code=(feedforward,),
        build=predicted_into,
    )


def chosen_pictures(found: SatelliteStages, names: Sequence[str]) -> Scene:
    """Return the eight-bit pictures of the frames that were delivered under these names, in the scene's order."""
    delivered = read_scene(found.refined.folder / SCENE).frames
    local = read_scene(found.local.folder / SCENE)
    wanted = set(names)
    frames = tuple(frame for frame, own in zip(local.frames, delivered, strict=True) if own.name in wanted)
    return local.replace(frames=frames, points=None)


def _of_pictures(prediction: Prediction, names: Sequence[str], path: Path) -> Prediction:
    """Return a prediction with the names of the pictures, whose endings may differ: TIFFs are predicted as PNGs."""
    own = {str(Path(name).with_suffix("")): name for name in names}
    theirs = [str(Path(name).with_suffix("")) for name in prediction.names]
    if sorted(own) != sorted(theirs):
        raise DataError(
            f"{path} is of other pictures than the chosen ones",
            expected=", ".join(sorted(names)),
            found=", ".join(sorted(prediction.names)),
            todo="Predict these pictures together, and no others",
        )
    return dataclasses.replace(prediction, names=tuple(own[name] for name in theirs))
