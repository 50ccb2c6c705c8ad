"""Which photos of a capture the runs so far have matched, from what their stages reported.

Stages in the workspace are whole or not there, and the report says what is in the database: that need not be
opened, which would be dangerous while COLMAP works on it (see :mod:`toolkit.matching.database`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.files import read_json
from toolkit.runs.launch import WORKSPACE

_STAGE, _REPORT = "stage.json", "report.json"


@dataclass(frozen=True, slots=True, eq=False)
class MatchGraph:
    """Verified pairs of one matching.

    Attributes
    ----------
    key:
        Of the stage.
    made:
        When it was finished, ISO 8601 in UTC, to the second.
    method:
        How pairs were chosen.
    tried:
        Pairs that were matched.
    pairs:
        (P, 2) indices of frames, i < j, of the verified ones.
    inliers:
        (P,) their verified matches.
    groups:
        Sizes of the groups that verified pairs connect, the largest first.
    """

    key: str
    made: str
    method: str
    tried: int
    pairs: NDArray[np.int64]
    inliers: NDArray[np.int64]
    groups: tuple[int, ...]

    @property
    def label(self) -> str:
        """What tells it from others."""
        return f"{self.method} pairs, {len(self.pairs):,} of {self.tried:,} verified, {self.made[:16]}"


def has_match_graphs(runs_dir: Path) -> bool:
    """Whether any capture was matched yet."""
    return next(_stages(runs_dir, "matches"), None) is not None


def match_graphs(runs_dir: Path, fingerprint: str, frames: int) -> tuple[MatchGraph, ...]:
    """Return the matchings of a capture, the newest first. Stages that are damaged or being deleted are left out.

    Parameters
    ----------
    runs_dir:
        Folder of the runs, with their workspace.
    fingerprint:
        Of the capture: :func:`toolkit.scene.dataset.capture_fingerprint`.
    frames:
        How many it has; a matching that names others is no one of it.
    """
    features = {
        folder.name.removeprefix("features-")
        for folder, record in _stages(runs_dir, "features")
        if record["inputs"].get("capture") == fingerprint
    }
    found = []
    for folder, record in _stages(runs_dir, "matches"):
        if record["inputs"].get("features") not in features:
            continue
        try:
            graph = _read(folder, record)
        except (DataError, OSError):
            continue
        if not len(graph.pairs) or graph.pairs.max() < frames:
            found.append(graph)
    return tuple(sorted(found, key=lambda graph: graph.made, reverse=True))


def _stages(runs_dir: Path, name: str) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield folder and record of the whole stages of a name."""
    for folder in sorted((runs_dir / WORKSPACE).glob(f"{name}-*")):
        try:
            record = read_json(folder / _STAGE)
        except DataError:
            continue
        if isinstance(record, dict) and isinstance(record.get("inputs"), dict):
            yield folder, record


def _read(folder: Path, record: dict[str, Any]) -> MatchGraph:
    report, path = read_json(folder / _REPORT), folder / _REPORT
    try:
        table = np.array(report["verified_pairs"], dtype=np.int64).reshape(-1, 4)
        made = datetime.fromtimestamp(path.stat().st_mtime, UTC)
        graph = MatchGraph(
            key=folder.name,
            made=f"{made:%Y-%m-%d %H:%M:%S}",
            method=str(record["inputs"]["pairs"]["method"]),
            tried=int(report["pairs_tried"]),
            pairs=table[:, :2],
            inliers=table[:, 3],
            groups=tuple(int(size) for size in report["group_sizes"]),
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{path} tells no matches", expected="verified_pairs", found=repr(error)[:80]) from error
    if len(graph.pairs) and graph.pairs.min() < 0:
        raise DataError(f"{path} tells no matches", expected="indices of frames", found="one below 0")
    return graph
