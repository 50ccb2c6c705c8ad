"""The mask of what does not move in a scene, from its own frames."""

from __future__ import annotations

from pathlib import Path

from toolkit.capture.mask_files import with_mask
from toolkit.capture.static_mask import StaticMask, StaticMaskSettings, find_static_mask
from toolkit.capture.temporal import TemporalSettings, sampled_numbers, temporal_statistics
from toolkit.progress import Progress, silent, track
from toolkit.scene import Scene
from toolkit.scene.pictures import load_grey


def mask_what_stands_still(
    scene: Scene,
    mask_dir: Path,
    temporal: TemporalSettings,
    static: StaticMaskSettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
) -> tuple[Scene, StaticMask]:
    """Return the scene with masks of what does not move, and how they were found.

    Parameters
    ----------
    scene:
        Frames of one camera that stands still, or turns about what is looked at.
    mask_dir:
        Folder of the masks. Where nothing stands still none are written, and the scene has none.
    temporal, static:
        As declared.
    seed:
        Of the frames that are looked at, where there are many.
    progress:
        Told of every frame; raises to cancel.

    Raises
    ------
    DataError, StageError, RunError
        As :func:`temporal_statistics`, :func:`find_static_mask` and :func:`with_mask`.
    """
    chosen = sampled_numbers(len(scene), temporal.frames, seed)
    paths = [scene.image_path(scene.frames[number]) for number in chosen]
    seen = (load_grey(path) for path in track(paths, "masks.statistics", progress))
    found = find_static_mask(temporal_statistics(seen, temporal), static)
    return with_mask(scene, found.mask, mask_dir, progress=progress), found
