"""From everything that a SLAM backend found to a scene: one segment, or all of them joined by GPS."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from toolkit.poses.slam.merge import MergeSettings, merge_segments
from toolkit.poses.slam.merged import merged_scene
from toolkit.poses.slam.result import SlamResult
from toolkit.poses.slam.segments import By, choose_segment, scene_with_segment
from toolkit.progress import Progress, silent
from toolkit.scene import Scene

Placing = Literal["largest", "last", "merge"]


@dataclass(frozen=True, slots=True)
class Placed:
    """A scene with poses of what was tracked.

    Attributes
    ----------
    scene:
        See :func:`place_segments`.
    segments:
        Numbers of the segments whose poses it has.
    merged:
        What became of each segment, where they were merged: ready for JSON.
    """

    scene: Scene
    segments: tuple[int, ...]
    merged: dict[str, Any] = field(default_factory=dict)


def place_segments(
    scene: Scene,
    result: SlamResult,
    how: Placing,
    *,
    settings: MergeSettings,
    by: By = "number",
    keyframes_only: bool = True,
    seed: int = 0,
    progress: Progress = silent,
) -> Placed:
    """Give the frames of a scene the poses of what was tracked.

    Parameters
    ----------
    scene:
        With the frames of the video, and for ``"merge"`` priors and a georeference.
    result:
        As a backend gave it.
    how:
        ``"largest"`` or ``"last"``: the poses of this segment, in its own world frame and scale
        (:func:`~toolkit.poses.slam.segments.scene_with_segment`); ``"merge"``: those of all segments that GPS can
        place, in metres in the scene's own frame (:func:`~toolkit.poses.slam.merge.merge_segments`).
    settings:
        Of ``"merge"``.
    by, keyframes_only:
        As :func:`~toolkit.poses.slam.segments.scene_with_segment` takes them.
    seed, progress:
        Of ``"merge"``.

    Raises
    ------
    StageError
        Where nothing was tracked, or no segment can be placed.
    DataError
        Where frames and poses do not belong together.
    """
    if how == "merge":
        merged = merge_segments(
            result,
            scene,
            settings,
            by=by,
            keyframes_only=keyframes_only,
            seed=seed,
            progress=progress,
        )
        taken = tuple(segment.number for segment in merged.segments if not segment.reason)
        return Placed(merged_scene(scene, merged), taken, merged.to_dict())
    chosen = choose_segment(result, how)
    number = next(i for i, segment in enumerate(result.segments) if segment is chosen)
    return Placed(scene_with_segment(scene, chosen, by=by, keyframes_only=keyframes_only), (number,))
