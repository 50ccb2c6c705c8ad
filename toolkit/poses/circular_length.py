"""Long tracks only: of what slides along the surface less is followed for long.

On outlines and where edges cross in the picture, features are found that belong to no place. They move against the
surface from frame to frame, and agree with points that do not exist. On the rendered engine, a degree a frame, the
closed circle's cameras were turned by 0.67 degrees; without the tracks whose places on the true surface were more
than 0.1 mm apart by 0.28; and with those that eight frames saw, which needs no truth, by 0.27.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from toolkit.errors import StageError
from toolkit.scene import Scene

#: Observations that nine frames of ten must keep.
LEAST_SEEN: Final = 12


@dataclass(frozen=True, slots=True, eq=False)
class LongTracks:
    """A scene with the points that many frames see.

    Attributes
    ----------
    scene:
        With fewer points; poses and cameras as they were.
    length:
        Frames that see each point at least; less than asked for where frames would have had too few points.
    points, kept:
        How many there were, and are left.
    """

    scene: Scene
    length: int
    points: int
    kept: int

    def to_dict(self) -> dict[str, Any]:
        """Return the counts, ready for JSON."""
        return {"length": self.length, "points": self.points, "kept": self.kept}


def long_tracks(scene: Scene, length: int) -> LongTracks:
    """Leave out points that fewer than ``length`` frames see.

    Shorter tracks stay, down to two frames, as long as a tenth of the placed frames would have fewer than
    ``LEAST_SEEN`` observations.

    Raises
    ------
    StageError
        Where the scene has no tracks.
    """
    points = scene.points
    tracks = None if points is None else points.tracks
    if points is None or tracks is None:
        raise StageError(
            "The scene has no tracks to choose from",
            expected="points with observations",
            todo="Run structure from motion first",
        )
    count = np.bincount(tracks.point, minlength=len(points))
    placed = np.array([frame.cam_from_world is not None for frame in scene.frames])
    chosen = length
    while chosen > 2:
        seen = np.bincount(tracks.frame[count[tracks.point] >= chosen], minlength=len(scene))[placed]
        if len(seen) and np.quantile(seen, 0.1) >= LEAST_SEEN:
            break
        chosen -= 1
    kept = points.observed(count[tracks.point] >= chosen)
    return LongTracks(scene.replace(points=kept), chosen, len(points), len(kept))
