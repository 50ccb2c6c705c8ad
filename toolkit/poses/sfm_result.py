"""What structure from motion found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import pycolmap

from toolkit.poses.adjust import AdjustmentReport
from toolkit.scene import Scene

_SIZES_TOLD = 4


@dataclass(frozen=True, slots=True)
class CameraChange:
    """A camera before and after; ``names`` are COLMAP's of the parameters, lengths in pixels."""

    camera_id: int
    model: str
    names: str
    before: tuple[float, ...]
    after: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class SfmResult:
    """Poses and points of the largest model.

    Attributes
    ----------
    scene:
        The scene with poses, cameras, points and tracks. Its world frame is its own (no georeference, no priors)
        unless positions were used. Frames that were not registered have no pose.
    models:
        Number of registered pictures of each model that was found, the largest first. The scene is the first.
    observations:
        Number of observations by the name of each registered picture.
    mean_track_length:
        Observations per point.
    mean_reprojection_error:
        In pixels, mean over the points.
    cameras:
        Those of registered pictures.
    adjustment:
        What the last adjustment did.
    seconds:
        Wall time by part.
    wanted:
        Names of the frames that were to be placed.
    """

    scene: Scene
    models: tuple[int, ...]
    observations: Mapping[str, int]
    mean_track_length: float
    mean_reprojection_error: float
    cameras: tuple[CameraChange, ...]
    adjustment: AdjustmentReport
    seconds: Mapping[str, float]
    wanted: tuple[str, ...]

    @property
    def not_registered(self) -> tuple[str, ...]:
        """Names of the frames that were to be placed and have no pose."""
        return tuple(name for name in self.wanted if self.scene.frame(name).cam_from_world is None)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is missing in the result, and what may mend it."""
        left = len(self.not_registered)
        if not left:
            return ()
        if len(self.models) > 1:
            sizes = ", ".join(str(size) for size in self.models[:_SIZES_TOLD])
            more = ", ..." if len(self.models) > _SIZES_TOLD else ""
            return (
                f"The pictures fall into {len(self.models)} pieces ({sizes}{more} pictures) that no matches join. "
                f"The largest is the result; {left} of {len(self.wanted)} pictures are not in it. More features, "
                "more pairs (where not every pair is matched already) or a lower min_matches may join them; else "
                "reconstruct each by itself.",
            )
        return (
            f"{left} of {len(self.wanted)} pictures could not be placed. More features, more pairs (where not "
            "every pair is matched already) or a lower min_inliers may place them.",
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "warnings": list(self.warnings),
            "images": len(self.wanted),
            "registered": len(self.scene.registered),
            "registered_names": [frame.name for frame in self.scene.registered],
            "not_registered": list(self.not_registered),
            "models": list(self.models),
            "points": 0 if self.scene.points is None else len(self.scene.points),
            "observations": sum(self.observations.values()),
            "observations_per_image": dict(self.observations),
            "mean_track_length": self.mean_track_length,
            "mean_reprojection_error": self.mean_reprojection_error,
            "cameras": [asdict(camera) for camera in self.cameras],
            "adjustment": self.adjustment.to_dict(),
            "seconds": dict(self.seconds),
        }


def sfm_result(
    model: pycolmap.Reconstruction,
    scene: Scene,
    *,
    models: tuple[int, ...],
    before: Mapping[int, pycolmap.Camera],
    adjustment: AdjustmentReport,
    seconds: Mapping[str, float],
    wanted: tuple[str, ...] | None = None,
) -> SfmResult:
    """Return the result whose numbers are those of COLMAP's model.

    ``before`` are the cameras at the start, ``wanted`` the names of the frames that were to be placed; None: all.
    """
    images = (model.image(image_id) for image_id in model.reg_image_ids())
    return SfmResult(
        scene=scene,
        models=models,
        observations={image.name: int(image.num_points3D) for image in images},
        mean_track_length=float(model.compute_mean_track_length()),
        mean_reprojection_error=float(model.compute_mean_reprojection_error()),
        cameras=_changes(before, model),
        adjustment=adjustment,
        seconds=seconds,
        wanted=tuple(frame.name for frame in scene.frames) if wanted is None else wanted,
    )


def _changes(before: Mapping[int, pycolmap.Camera], model: pycolmap.Reconstruction) -> tuple[CameraChange, ...]:
    used = sorted({model.image(image_id).camera_id for image_id in model.reg_image_ids()})
    return tuple(
        CameraChange(
            number,
            model.camera(number).model.name,
            model.camera(number).params_info,
            tuple(float(value) for value in before[number].params),
            tuple(float(value) for value in model.camera(number).params),
        )
        for number in used
    )
