"""The observations that close a circle: joined across the seam, of fine features, followed for long."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from toolkit.poses.circular_length import LongTracks, long_tracks
from toolkit.poses.circular_scale import FineTracks, fine_tracks
from toolkit.poses.circular_seam import SeamTracks, seam_matches, seam_tracks
from toolkit.poses.circular_settings import CircularSettings
from toolkit.scene import Scene


@dataclass(frozen=True, slots=True, eq=False)
class CircleTracks:
    """A scene for :func:`toolkit.poses.circular.close_circle`, and how its observations were chosen."""

    seam: SeamTracks
    fine: FineTracks
    long: LongTracks

    @property
    def scene(self) -> Scene:
        """The scene with what is left; poses and cameras as they were."""
        return self.long.scene

    def to_dict(self) -> dict[str, Any]:
        """Return the counts of each step, ready for JSON."""
        return {"seam": self.seam.to_dict(), "fine": self.fine.to_dict(), "long": self.long.to_dict()}


def circle_tracks(scene: Scene, database_path: Path, settings: CircularSettings) -> CircleTracks:
    """Choose the observations by which all cameras are adjusted on one circle.

    Parameters
    ----------
    scene:
        With poses and tracks of structure from motion.
    database_path:
        With its features and verified matches, also those across the seam.
    settings:
        ``max_scale`` and ``min_track`` say what is left out.

    Raises
    ------
    DataError, StageError
        As :func:`seam_matches`, :func:`seam_tracks`, :func:`fine_tracks` and :func:`long_tracks`.
    """
    seam = seam_tracks(scene, seam_matches(scene, database_path))
    fine = fine_tracks(seam.scene, database_path, settings.max_scale)
    return CircleTracks(seam, fine, long_tracks(fine.scene, settings.min_track))
