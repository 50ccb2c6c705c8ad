"""Many photos, each from a start of its own, and what came of them as one record."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.localizer import Localizer
from toolkit.localize.one_shot import OneShot
from toolkit.localize.query import query_of
from toolkit.localize.result import Localization
from toolkit.localize.starts import Start
from toolkit.metrics.localization import LocalizationErrors, localization_errors
from toolkit.progress import Progress, silent, track
from toolkit.scene import Scene


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Localised photos.

    Attributes
    ----------
    method:
        Name of the one that localised them.
    starts, found:
        In the same order.
    """

    method: str
    starts: tuple[Start, ...]
    found: tuple[Localization, ...]

    @property
    def median_seconds(self) -> float:
        """Median wall time of a photo."""
        return float(np.median([sum(done.seconds.values()) for done in self.found]))

    def errors(self, truth: Mapping[str, RigidTransform]) -> LocalizationErrors:
        """Return the errors against true poses by name."""
        return localization_errors({done.name: done.cam_from_world for done in self.found}, truth)

    def start_errors(self, truth: Mapping[str, RigidTransform]) -> LocalizationErrors:
        """Return the errors of the starts themselves."""
        return localization_errors({start.name: start.cam_from_world for start in self.starts}, truth)

    def to_dict(self) -> dict[str, Any]:
        """Return everything, ready for JSON."""
        return {
            "method": self.method,
            "queries": [
                {
                    **done.to_dict(),
                    "start": start.cam_from_world.matrix[:3].tolist(),
                    "start_position_sigma": start.position_sigma,
                    "start_rotation_sigma_deg": start.rotation_sigma_deg,
                }
                for start, done in zip(self.starts, self.found, strict=True)
            ],
        }


def localize_batch(
    method: OneShot | Localizer,
    scene: Scene,
    starts: Sequence[Start],
    *,
    seed: int = 0,
    progress: Progress = silent,
    watch: Callable[[Localization], None] | None = None,
) -> Batch:
    """Localise the frames of a scene that have a start; their poses play no part.

    Parameters
    ----------
    scene:
        Photos and cameras.
    starts:
        One for each photo that is asked for.
    progress:
        Told of every photo; raises to cancel.
    watch:
        Called with each result as it comes.

    Raises
    ------
    DataError
        Where there is no start, and as :func:`toolkit.localize.query.query_of`.
    """
    if not starts:
        raise DataError("Nothing to localise", expected="at least one start pose", found="none")
    found = []
    for start in track(starts, f"localize.{method.name}", progress):
        done = method.localize(query_of(scene, scene.frame(start.name)), start, seed=seed)
        found.append(done)
        if watch is not None:
            watch(done)
    return Batch(method.name, tuple(starts), tuple(found))
