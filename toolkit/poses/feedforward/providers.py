"""The network that the settings name, and its prediction of a scene's pictures."""

from __future__ import annotations

from pathlib import Path

from toolkit.errors import DataError, SettingsError
from toolkit.poses.feedforward.network import FeedForwardNetwork
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.predictions_file import read_predictions
from toolkit.poses.feedforward.settings import FeedForwardSettings
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene import Scene
from toolkit.scene.pictures import load_picture


def network(settings: FeedForwardSettings) -> FeedForwardNetwork:
    """Return the network of ``settings``, loaded and ready.

    Raises
    ------
    SettingsError
        For the provider ``file``, which is no network.
    MissingDependencyError
        Where the package is missing; :class:`~toolkit.errors.WeightsMissingError` where weights are.
    CapabilityError
        For a device that is not there, or weights that would run code.
    DataError
        For weights that are not what they should be.
    """
    common = {"download": settings.download, "device": settings.device}
    if settings.provider == "vggt":
        from toolkit.poses.feedforward.vggt import VggtNetwork

        return VggtNetwork(settings.weights, fit=settings.fit, points=settings.points, **common)
    if settings.provider == "depth-anything-3":
        from toolkit.poses.feedforward.depth_anything import DepthAnything3Network

        return DepthAnything3Network(settings.weights, side=settings.side, **common)
    alignment = {"pairs": settings.pairs, "steps": settings.steps, "rate": settings.rate}
    if settings.provider == "dust3r":
        from toolkit.poses.feedforward.dust3r import Dust3rNetwork

        return Dust3rNetwork(settings.weights, **alignment, **common)
    if settings.provider == "mast3r":
        from toolkit.poses.feedforward.mast3r import Mast3rNetwork

        return Mast3rNetwork(settings.weights, **alignment, **common)
    raise SettingsError(f"The provider '{settings.provider}' is no network", expected="a network's name")


def predict(
    scene: Scene, settings: FeedForwardSettings, *, seed: int = 0, progress: Progress = silent
) -> Prediction:
    """Return cameras, depth, confidence and points of a scene's pictures.

    Cameras and poses that the scene has are not used.

    Parameters
    ----------
    scene:
        Its pictures. All of its frames go into the network together: choose them first.
    settings:
        As declared.
    seed:
        Of the random start of DUSt3R's and MASt3R's alignments.
    progress:
        Told when the network is loaded and when it is done; raises to cancel, not while the network works.

    Raises
    ------
    DataError
        For a scene without frames, a picture that cannot be read, a file that holds no prediction, or one of other
        pictures.
    SettingsError, MissingDependencyError, WeightsMissingError, CapabilityError, StageError
        As the network says.
    """
    if not scene.frames:
        raise DataError("The scene has no pictures", expected="at least 1 frame")
    progress(ProgressEvent("feedforward", 0, 2, "loading"))
    if settings.provider == "file":
        if not settings.file:
            raise SettingsError("The provider 'file' needs a file", expected="file=<path of predictions.npz>")
        prediction = of_scene(read_predictions(Path(settings.file)), scene)
    else:
        chosen = network(settings)
        pictures = [load_picture(scene.image_path(frame)) for frame in scene.frames]
        progress(ProgressEvent("feedforward", 1, 2, chosen.name))
        prediction = chosen.predict(pictures, [frame.name for frame in scene.frames], seed=seed)
    progress(ProgressEvent("feedforward", 2, 2))
    return prediction


def of_scene(prediction: Prediction, scene: Scene) -> Prediction:
    """Return the prediction of those of its pictures that the scene has, in the scene's order.

    Raises
    ------
    DataError
        Where it has none of them, or of pictures of another size.
    """
    index = {name: i for i, name in enumerate(prediction.names)}
    frames = [frame for frame in scene.frames if frame.name in index]
    if not frames:
        raise DataError(
            "The prediction is of other pictures",
            expected="names of the scene's frames, such as " + ", ".join(f.name for f in scene.frames[:3]),
            found=", ".join(prediction.names[:3]),
            todo="Write the names of the frames into the file",
        )
    for frame in frames:
        ours, theirs = scene.camera_of(frame), prediction.cameras[index[frame.name]]
        if (ours.width, ours.height) != (theirs.width, theirs.height):
            raise DataError(
                f"The prediction of '{frame.name}' is of a picture of another size",
                expected=f"{ours.width}x{ours.height}",
                found=f"{theirs.width}x{theirs.height}",
                todo="Write the sizes of the original pictures into the file",
            )
    return prediction.chosen([index[frame.name] for frame in frames])
