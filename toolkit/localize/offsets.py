"""How errors grow with how far off the start was: the same photos, from starts farther and farther away."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from toolkit.localize.batch import localize_batch
from toolkit.localize.localizer import Localizer
from toolkit.localize.one_shot import OneShot
from toolkit.localize.starts import offset_starts
from toolkit.metrics.localization import LocalizationErrors
from toolkit.progress import Progress, silent
from toolkit.scene import Scene


def errors_by_offset(
    methods: Sequence[OneShot | Localizer],
    scene: Scene,
    offsets: Sequence[float],
    unit: Literal["metres", "degrees"] = "metres",
    *,
    every: int = 1,
    seed: int = 0,
    progress: Progress = silent,
) -> Mapping[str, Mapping[float, LocalizationErrors]]:
    """Localise the queries of a scene from starts that are off by each of some offsets, by each method.

    With the same seed a larger offset leads farther on the same line
    (:func:`toolkit.localize.starts.offset_starts`).

    Parameters
    ----------
    scene:
        Its frames of split ``"test"`` are the queries; their poses are the truth.
    offsets:
        Metres, or degrees, from 0.
    every:
        Only every so many queries.
    seed:
        Of what is drawn, and of RANSAC.

    Returns
    -------
    errors:
        By the method's name and the offset.

    Raises
    ------
    SettingsError, StageError, DataError
        As :func:`~toolkit.localize.starts.offset_starts` and :func:`~toolkit.localize.batch.localize_batch`.
    """
    errors: dict[str, dict[float, LocalizationErrors]] = {method.name: {} for method in methods}
    for offset in offsets:
        metres, degrees = (offset, 0.0) if unit == "metres" else (0.0, offset)
        starts = offset_starts(scene, metres, degrees, seed=seed)[::every]
        for method in methods:
            batch = localize_batch(method, scene, starts, seed=seed, progress=progress)
            errors[method.name][float(offset)] = batch.errors(scene.poses)
    return errors
