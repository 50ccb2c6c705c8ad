"""How far poses found against a map are from true ones: MTE, RMSE-T, MRE, RMSE-R and recall.

The paper (uav-splat-localization, section 4.3 and Table 3) gives means and root mean squares over its queries and
does not say what became of queries that were not found. Here these measures are over the queries that were found,
and how many were found stands beside them; recall is over all queries, so that giving up never improves it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, SettingsError
from toolkit.geometry.rigid import RigidTransform, rotation_angle

Array = NDArray[np.float64]

#: Metres and degrees within which recall is told, by its name in a run's measures.
RECALLS: Final[Mapping[str, tuple[float, float]]] = {
    "recall_01": (0.1, 0.1),
    "recall_05": (0.5, 1.0),
    "recall_5": (5.0, 5.0),
}


@dataclass(frozen=True, slots=True, eq=False)
class LocalizationErrors:
    """Errors of the poses of queries.

    Attributes
    ----------
    names:
        (N,) names of the queries.
    position:
        (N,) distances between found and true camera centres in metres, NaN where no pose was found.
    rotation_deg:
        (N,) angles between found and true camera axes in degrees, NaN where no pose was found.

    Raises
    ------
    DataError
        For no query at all, for lists of different lengths, and for a position without rotation or the reverse.
    """

    names: tuple[str, ...]
    position: Array
    rotation_deg: Array

    def __post_init__(self) -> None:
        count = len(self.names)
        if self.position.shape != (count,) or self.rotation_deg.shape != (count,):
            raise DataError(
                "Names and errors of queries do not correspond",
                expected=f"({count},) and ({count},)",
                found=f"{self.position.shape} and {self.rotation_deg.shape}",
            )
        if not count:
            raise DataError("No query to measure", expected="at least 1", found="0")
        if not np.array_equal(np.isfinite(self.position), np.isfinite(self.rotation_deg)):
            raise DataError(
                "A query has an error of one kind alone", expected="a position and a rotation, or NaN twice"
            )

    @property
    def found(self) -> int:
        """How many queries have a pose."""
        return int(np.isfinite(self.position).sum())

    @property
    def share_found(self) -> float:
        """Which share of the queries, 0 to 1, has a pose."""
        return self.found / len(self.names)

    @property
    def mte(self) -> float:
        """Mean distance of the centres that were found, in metres (Table 3: MTE); NaN where none was."""
        return _mean(self.position)

    @property
    def rmse_t(self) -> float:
        """Root mean square distance of the centres that were found, in metres (Table 3: RMSE-T)."""
        return math.sqrt(_mean(self.position**2))

    @property
    def mre_deg(self) -> float:
        """Mean angle of the orientations that were found, in degrees (Table 3: MRE)."""
        return _mean(self.rotation_deg)

    @property
    def rmse_r_deg(self) -> float:
        """Root mean square angle of the orientations that were found, in degrees (Table 3: RMSE-R)."""
        return math.sqrt(_mean(self.rotation_deg**2))

    def recall(self, metres: float, degrees: float) -> float:
        """Return the share of all queries, 0 to 1, whose pose is right within both bounds, these included.

        A query that was not found counts as wrong.

        Raises
        ------
        SettingsError
            For bounds that are not positive.
        """
        if not (metres > 0 and degrees > 0):
            raise SettingsError(
                "Recall needs positive bounds", expected="metres and degrees above 0", found=f"{metres}, {degrees}"
            )
        # NaN is within no bound.
        return float(np.mean((self.position <= metres) & (self.rotation_deg <= degrees)))

    def measures(self) -> dict[str, float]:
        """Return what a run tells: ``mte_m``, ``rmse_t_m``, ``mre_deg``, ``rmse_r_deg``, ``found`` and recalls.

        Where nothing was found the errors are NaN, ``found`` (a share) and the recalls 0.
        """
        return {
            "mte_m": self.mte,
            "rmse_t_m": self.rmse_t,
            "mre_deg": self.mre_deg,
            "rmse_r_deg": self.rmse_r_deg,
            "found": self.share_found,
            **{name: self.recall(*bounds) for name, bounds in RECALLS.items()},
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the measures and the errors of each query, ready for JSON: None where there is no number."""
        return {
            "queries": len(self.names),
            "found_queries": self.found,
            **{name: _plain(value) for name, value in self.measures().items()},
            "per_query": {
                "name": list(self.names),
                "position_m": [_plain(value) for value in self.position.tolist()],
                "rotation_deg": [_plain(value) for value in self.rotation_deg.tolist()],
            },
        }


def pose_errors(found: RigidTransform, true: RigidTransform) -> tuple[float, float]:
    """Return the distance between two camera centres, in the scene's units, and the angle between their axes.

    Parameters
    ----------
    found, true:
        ``cam_from_world`` of the same camera in the same world frame.

    Returns
    -------
    tuple
        Metres, and degrees from 0 to 180.

    Raises
    ------
    DataError
        For a pose that is not finite.
    """
    for name, pose in (("found", found), ("true", true)):
        if not np.isfinite(pose.matrix).all():
            raise DataError(f"A {name} pose is not finite", expected="numbers", found="NaN or infinity")
    turn = found.rotation @ true.rotation.T
    return float(np.linalg.norm(found.centre - true.centre)), math.degrees(rotation_angle(turn))


def localization_errors(
    found: Mapping[str, RigidTransform | None], truth: Mapping[str, RigidTransform]
) -> LocalizationErrors:
    """Return the errors of found poses.

    Parameters
    ----------
    found:
        ``cam_from_world`` by the name of the query, None where it was not found. A start pose that is handed in
        here gives the start's own errors.
    truth:
        True ``cam_from_world``; it may have more names than were asked for.

    Raises
    ------
    DataError
        For no query, for one without a true pose and for poses that are not finite.
    """
    unknown = [name for name in found if name not in truth]
    if unknown:
        raise DataError(
            f"Query '{unknown[0]}' has no true pose",
            expected="one for each query",
            found=f"{len(unknown)} of {len(found)} without",
        )
    errors = [
        (math.nan, math.nan) if pose is None else pose_errors(pose, truth[name]) for name, pose in found.items()
    ]
    columns = np.array(errors, dtype=np.float64).reshape(-1, 2)
    return LocalizationErrors(tuple(found), columns[:, 0].copy(), columns[:, 1].copy())


def _mean(values: Array) -> float:
    """Return the mean of the finite values, NaN where there is none."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else math.nan


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None
