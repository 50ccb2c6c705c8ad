"""Pairs of pictures that look alike and show different things: found by what the sequence says, and dropped.

On a ring of near-identical blades, frames that are a blade's pitch apart agree as well as frames that show the
same blade (Blade inspection, section 4.2). The frames between them tell: followed from each to the next one, the
blades have moved on by the pitch, where the pair says that nothing moved.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError, StageError
from toolkit.matching.database import copy_database, match_counts, pair_numbers, require_same_frames
from toolkit.matching.feature_tracks import TrackSupport, track_support
from toolkit.matching.pair_rotations import VerifiedPairs, read_verified_pairs, rotation_vectors
from toolkit.matching.sequence_chain import (
    LEAST_CYCLES,
    Ways,
    chain_along,
    differences,
    rotation_noise,
    turn_along,
)
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene import Scene
from toolkit.settings import Boolean, Integer, Number, Settings

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Verdict = Literal["near", "right", "uncertain", "wrong"]
_VERDICTS: tuple[Verdict, ...] = ("near", "right", "uncertain", "wrong")
_NEAR, _RIGHT, _UNCERTAIN, _WRONG = range(4)


class WrongPairSettings(Settings):
    """Which pairs contradict the sequence."""

    near = Integer(
        3,
        bounds=(2, 100),
        unit="frames",
        doc="Frames at most so far apart are taken to be matched rightly and make the chain; keep it well below "
        "half of the frames in which one blade takes the place of the next.",
    )
    closed = Boolean(
        False,
        doc="The last frame is followed by the first: exactly one turn. Pairs are judged the shorter way round.",
    )
    ends = Integer(
        0,
        bounds=(0, 1000),
        unit="frames",
        doc="Pairs of one of so many first with one of so many last frames are judged by each other instead: "
        "footage that comes back to its start, but not exactly.",
    )
    right_share = Number(
        0.15,
        bounds=(0.0, 1.0),
        doc="A pair is right where it differs from the chain by no more than this share of the chain's turn and "
        "three sigmas.",
    )
    wrong_share = Number(
        0.35,
        bounds=(0.0, 1.0),
        doc="A pair is wrong where it differs by more than this share and five sigmas; between the two shares it "
        "is uncertain.",
    )
    min_tracks = Integer(
        8,
        bounds=(3, 1000),
        unit="features",
        doc="So many features followed through the frames between decide for or against a pair, whatever its turn.",
    )


@dataclass(frozen=True, slots=True, eq=False)
class WrongPairs:
    """What the sequence says of the verified pairs.

    Attributes
    ----------
    names:
        Of the frames, in their order.
    pairs:
        (P, 2) verified pairs, indices of frames, i < j.
    inliers:
        (P,) verified matches.
    verdict:
        (P,) 0: near, taken for right; 1: right; 2: uncertain; 3: wrong.
    claimed_deg, chained_deg, difference_deg:
        (P,) how far the pair says that the view turned, how far the chain says, and how far the two lie apart; NaN
        where there is no chain between the two frames.
    tracks:
        Features that were followed from the one frame to the other, for and against each pair.
    sigma_deg:
        Noise of one pair's rotation, from cycles of three near pairs.
    """

    names: tuple[str, ...]
    pairs: Integers
    inliers: Integers
    verdict: NDArray[np.int8]
    claimed_deg: Array
    chained_deg: Array
    difference_deg: Array
    tracks: TrackSupport
    sigma_deg: float

    def of(self, verdict: Verdict) -> Integers:
        """Return the pairs (K, 2) with a verdict."""
        return self.pairs[self.verdict == _VERDICTS.index(verdict)]

    @property
    def wrong(self) -> Integers:
        """(K, 2) pairs that contradict the sequence."""
        return self.of("wrong")

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers and the wrong pairs, ``[i, j, inliers]`` each, ready for JSON."""
        bad = self.verdict == _WRONG
        return {
            "frames": len(self.names),
            "pairs": len(self.pairs),
            **{name: int((self.verdict == place).sum()) for place, name in enumerate(_VERDICTS)},
            "sigma_deg": self.sigma_deg,
            "wrong_pairs": np.column_stack([self.pairs, self.inliers])[bad].tolist(),
        }


def find_wrong_pairs(
    database_path: Path,
    scene: Scene,
    settings: WrongPairSettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
) -> WrongPairs:
    """Judge the verified pairs of distant frames by the chain of near ones between them.

    Two witnesses. Features that are followed through near pairs: do they arrive where the pair matches them? And
    the turn of the view: rotations that carry the rays of one frame onto those of the other are averaged along the
    chain of near pairs, and compared with that of the pair itself (cycle consistency, Zach et al. 2010,
    "Disambiguating visual relations using loop constraints"). A pair is wrong, right or, where neither is sure,
    uncertain. Rotations are by the cameras in the database: a wrong focal length scales both sides alike.

    What it cannot see: pairs confused by a full turn, unless ``closed`` or ``ends`` say that the footage comes
    back; ends of which all pairs are off by the same blade; a camera that only moves forward, where the view does
    not turn.

    Parameters
    ----------
    database_path:
        With verified matches. Nothing else may be writing it.
    scene:
        Whose frames they are, in the order of capture.
    settings:
        As declared.
    seed:
        No random choice is made; taken because every stage takes it.
    progress:
        Told how many pairs were looked at; raises to cancel.

    Raises
    ------
    DataError
        For a database that is missing, damaged or of another scene.
    StageError
        Where too few near pairs are verified to make a chain.
    """
    require_same_frames(database_path, scene)
    verified = read_verified_pairs(database_path, progress)
    count = len(scene)
    ways = Ways(count, verified.index, settings.near, closed=settings.closed, ends=settings.ends)
    chain = chain_along(ways, verified)
    sigma = rotation_noise(ways, verified)
    _require_chain(chain[:count], len(ways.first), sigma)
    progress(ProgressEvent("pairs.judge", 0, len(verified.index)))
    claimed = rotation_vectors(verified.turned)
    chained = turn_along(chain, ways)
    support = track_support(verified, ways.near)
    difference = differences(chain, chained, verified.turned, ways)
    verdict = _judge(difference, np.linalg.norm(chained, axis=1), support, ways, float(sigma), settings)
    if settings.ends:
        _judge_seam(verdict, chain, verified, ways, float(sigma), settings)
    progress(ProgressEvent("pairs.judge", len(verified.index), len(verified.index)))
    return WrongPairs(
        tuple(frame.name for frame in scene.frames),
        verified.index,
        verified.inliers,
        verdict,
        np.degrees(np.linalg.norm(claimed, axis=1)),
        np.degrees(np.linalg.norm(chained, axis=1)),
        np.degrees(difference),
        support,
        float(np.degrees(sigma)),
    )


def drop_pairs(database_path: Path, pairs: ArrayLike, target: Path) -> int:
    """Write a copy of a database without the matches of some pairs; returns how many of them it had.

    Parameters
    ----------
    database_path:
        It stays as it is.
    pairs:
        (K, 2) indices of frames.
    target:
        Where to write; a database that was there is replaced.

    Raises
    ------
    DataError
        Where ``database_path`` is missing or no database, and where ``target`` is the same file.
    RunError
        Where ``target`` may not be written or the disk is full.
    """
    if target.absolute() == database_path.absolute():
        raise DataError(f"{target} is the database itself", expected="another file to write to")
    numbers = pair_numbers(np.asarray(pairs, dtype=np.int64).reshape(-1, 2))
    there = set(pair_numbers(match_counts(database_path)[0]))
    copy_database(database_path, target)
    with closing(sqlite3.connect(target)) as connection, connection:
        for table in ("matches", "two_view_geometries"):
            connection.executemany(f"DELETE FROM {table} WHERE pair_id = ?", [(number,) for number in numbers])
    return len(there.intersection(numbers))


def _require_chain(chain: Array, pairs: int, sigma: float) -> None:
    reached = int(np.isfinite(chain[:, 0, 0]).sum())
    if not np.isfinite(sigma) or 2 * reached < len(chain):
        raise StageError(
            "Too few near pairs are verified to tell which distant ones are wrong",
            expected=f"a chain through at least half of the {len(chain)} frames and {LEAST_CYCLES} cycles of three",
            found=f"{reached if pairs else 0} frames in the longest chain of {pairs} verified pairs"
            + ("" if np.isfinite(sigma) else ", too few cycles"),
            todo="Match neighbours too (sequential with an overlap of 3 or more), or raise 'near'",
        )


def _judge(
    difference: Array,
    turn: Array,
    support: TrackSupport,
    ways: Ways,
    sigma: float,
    settings: WrongPairSettings,
) -> NDArray[np.int8]:
    """Return the verdict (P,) on each pair."""
    # The chain's longest links make the way with the least noise; the pair has its own.
    noise = sigma * np.sqrt(ways.length / settings.near + 1.0)
    right = difference <= 3.0 * noise + settings.right_share * turn
    wrong = difference > 5.0 * noise + settings.wrong_share * turn
    verdict = np.where(right, _RIGHT, np.where(wrong, _WRONG, _UNCERTAIN))
    # Features that were followed all the way are the better witness: they know of single blades.
    for_it, against = support.agreeing, support.contradicting
    verdict[(for_it >= settings.min_tracks) & (for_it > 2 * against)] = _RIGHT
    verdict[(against >= settings.min_tracks) & (against > 2 * for_it)] = _WRONG
    verdict[ways.seam] = _UNCERTAIN
    verdict[ways.near] = _NEAR
    return verdict.astype(np.int8)


def _judge_seam(
    verdict: NDArray[np.int8],
    chain: Array,
    verified: VerifiedPairs,
    ways: Ways,
    sigma: float,
    settings: WrongPairSettings,
) -> None:
    """Judge the pairs between the ends by each other: all must say that the footage turned equally far in all.

    The turn that has most inliers is believed where no other has more than half as many; else all stay uncertain.
    """
    seam = np.flatnonzero(ways.seam & np.isfinite(chain[ways.first, 0, 0]) & np.isfinite(chain[ways.last, 0, 0]))
    if len(seam) < 2:
        return
    first, last = chain[ways.first[seam]], chain[ways.last[seam]]
    turns = np.swapaxes(last, 1, 2) @ verified.turned[seam] @ first
    apart = np.linalg.norm(rotation_vectors(np.swapaxes(turns, 1, 2)[:, None] @ turns[None]), axis=2)
    limit = 5.0 * sigma * np.sqrt(2.0 * settings.ends + 1.0)
    inliers = verified.inliers[seam].astype(np.float64)
    weight = (apart <= limit) @ inliers
    best = int(np.argmax(weight))
    others = apart[best] > 2.0 * limit
    if others.any() and weight[others].max() > 0.5 * weight[best]:
        return
    verdict[seam] = np.where(apart[best] <= limit, _RIGHT, np.where(others, _WRONG, _UNCERTAIN))
