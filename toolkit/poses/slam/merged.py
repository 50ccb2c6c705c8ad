"""What joining all segments of a video gave, and the scene with it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Scene


@dataclass(frozen=True, slots=True)
class MergedSegment:
    """What became of a segment.

    Attributes
    ----------
    number:
        Its place among the segments, from 0.
    frames:
        How many frames of the scene it tracked.
    positions:
        How many of these have a GPS position.
    reason:
        Why it was left out; empty where it was placed.
    straight:
        Whether attitudes had to settle the turn about its path.
    scale:
        Metres in its unit, None where it was left out.
    rejected:
        Positions that hardly counted (a quarter of their weight, or less).
    position_residual:
        Root mean square distance, in metres, of the other positions from the path; None where it was left out, or
        no other position is left.
    """

    number: int
    frames: int
    positions: int
    reason: str = ""
    straight: bool = False
    scale: float | None = None
    rejected: int = 0
    position_residual: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MergedTrajectory:
    """Metric poses of everything that could be placed.

    Attributes
    ----------
    poses:
        ``cam_from_world`` in the scene's georeferenced frame, by the place of the frame in the scene.
    segment_of:
        Number of the segment that tracked it, by the same.
    segments:
        What became of each.
    steps, converged:
        Of the adjustment.
    seconds:
        Wall time.
    """

    poses: Mapping[int, RigidTransform]
    segment_of: Mapping[int, int]
    segments: tuple[MergedSegment, ...]
    steps: int
    converged: bool
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "placed": len(self.poses),
            "segments": [dataclasses.asdict(segment) for segment in self.segments],
            "steps": self.steps,
            "converged": self.converged,
            "seconds": self.seconds,
        }


def merged_scene(scene: Scene, merged: MergedTrajectory) -> Scene:
    """Return the scene with merged poses; other frames have none. Priors and the georeference stay, points go."""
    frames = tuple(
        dataclasses.replace(frame, cam_from_world=merged.poses.get(i)) for i, frame in enumerate(scene.frames)
    )
    return scene.replace(frames=frames, points=None)
