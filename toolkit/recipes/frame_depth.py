"""The depth of single frames, before there are poses, for methods that find these by rendering."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.monocular import DepthPrediction, MonocularDepth
from toolkit.depth.providers import depth_provider
from toolkit.depth.settings import DepthSettings
from toolkit.errors import StageError
from toolkit.poses.sensors import SensorPoseSettings, sensor_poses
from toolkit.scene import Frame, Scene

#: Those that the papers mean; what else gives depth is reported as a substitute.
NETWORKS: Final = ("transformers", "moge", "video")


@dataclass(frozen=True)
class FrameDepth:
    """A source of depth, called with a frame.

    Attributes
    ----------
    provider:
        Loaded, so that missing weights are told before anything else is done.
    settings:
        Which one.
    scene:
        Whose pictures are looked at; with sensor poses where the provider needs them.
    """

    provider: MonocularDepth
    settings: DepthSettings
    scene: Scene

    def __call__(self, frame: Frame) -> NDArray[np.float32]:
        """Return the depths (H, W) of a frame, NaN where there is none.

        Raises
        ------
        DataError, StageError
            Where the provider cannot tell, or tells none.
        """
        prediction = self.provider.predict(self.scene, self.scene.frame(frame.name))
        depth = unscaled_depth(prediction)
        if prediction.confidence is not None:
            depth = np.where(prediction.confidence >= self.settings.min_confidence, depth, np.float32(np.nan))
        if not np.isfinite(depth).any():
            raise StageError(
                f"Frame '{frame.name}' has no depth ({self.provider.name})",
                expected="some pixels with a positive depth",
                todo="Choose another depth.provider, or leave the frame out",
            )
        return depth

    def to_dict(self) -> dict[str, Any]:
        """Return which source it is, and whether it stands in for a network."""
        return {
            "provider": self.settings.provider,
            "source": self.provider.name,
            "substitute": self.settings.provider not in NETWORKS,
        }

    def of(self, scene: Scene) -> FrameDepth:
        """Return the same source for the same frames with other pictures.

        Raises
        ------
        StageError
            Where the provider needs sensor poses, and there are none.
        """
        needs_poses = self.settings.provider == "ground"
        return replace(self, scene=sensor_poses(scene, SensorPoseSettings()).scene if needs_poses else scene)


def frame_depth(scene: Scene, settings: DepthSettings) -> FrameDepth:
    """Return the source of depth that the settings name, for a scene without poses.

    Raises
    ------
    MissingDependencyError
        Where a package is missing; :class:`~toolkit.errors.WeightsMissingError` where weights are.
    SettingsError, DataError
        As :func:`toolkit.depth.providers.depth_provider`.
    """
    return FrameDepth(depth_provider(settings), settings, scene).of(scene)


def unscaled_depth(prediction: DepthPrediction) -> NDArray[np.float32]:
    """Return depth (H, W) without anything to scale it by: there are no points and no poses yet.

    Metric depth stays. Of the others neither scale nor shift is known: the shift is taken for 0, and the scale such
    that the median depth is 1. Values that give no positive depth become NaN.
    """
    values = prediction.values.astype(np.float64)
    positive = np.where(np.isfinite(values) & (values > 0), values, np.nan)
    if not np.isfinite(positive).any():
        return np.full(values.shape, np.nan, dtype=np.float32)
    if prediction.kind == "affine-disparity":
        positive = 1 / positive
    if prediction.kind != "metric":
        positive = positive / np.nanmedian(positive)
    depth: NDArray[np.float32] = positive.astype(np.float32)
    return depth
