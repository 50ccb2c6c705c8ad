"""Which pictures are matched with which."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import StageError
from toolkit.scene import Scene
from toolkit.settings import Boolean, Choice, Integer, Number, Settings

Pairs = NDArray[np.int64]


class PairSettings(Settings):
    """Which pairs of pictures are matched."""

    method = Choice(
        "exhaustive",
        choices=("exhaustive", "sequential", "spatial"),
        doc="Every pair; neighbours in the order of capture; or neighbours by the positions that sensors gave.",
    )
    overlap = Integer(
        10, bounds=(1, 1000), unit="frames", doc="Sequential: how many following frames each frame is matched with."
    )
    quadratic = Boolean(
        True, doc="Sequential: also match frames 1, 2, 4, 8, ... apart, for as many powers as the overlap says."
    )
    closed = Boolean(False, doc="Sequential: the last frame is followed by the first, as on a full circle.")
    loop_stride = Integer(
        0,
        bounds=(0, 1000),
        unit="frames",
        doc="Sequential: match every so many frames with each other, to close loops; 0: do not.",
    )
    neighbours = Integer(
        8,
        bounds=(1, 1000),
        unit="frames",
        doc="Spatial: how many nearest frames each frame is matched with; one without position is matched with as "
        "many before and after it.",
    )
    max_distance = Number(
        0.0, bounds=(0.0, None), unit="m", doc="Spatial: frames farther apart are not matched; 0: no limit."
    )


@dataclass(frozen=True, slots=True, eq=False)
class ChosenPairs:
    """Pairs of frames to match.

    Attributes
    ----------
    method:
        How they were chosen.
    frames:
        How many frames the scene has.
    index:
        (P, 2) indices of frames, the smaller one first, sorted, each pair once.
    """

    method: str
    frames: int
    index: Pairs

    def __len__(self) -> int:
        return len(self.index)

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Frames that pairs connect, directly or through others, the largest group first."""
        return connected_groups(self.frames, self.index)

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "method": self.method,
            "frames": self.frames,
            "pairs": len(self),
            "pairs_per_frame": 2 * len(self) / self.frames,
            "group_sizes": [len(group) for group in self.groups],
        }


def exhaustive_pairs(count: int) -> Pairs:
    """Return all pairs (P, 2) of ``count`` frames: i < j, sorted."""
    return _unique(np.stack(np.triu_indices(count, k=1), axis=1))


def sequential_pairs(
    count: int, overlap: int, *, quadratic: bool = False, closed: bool = False, loop_stride: int = 0
) -> Pairs:
    """Return pairs (P, 2) of frames that are close in the order of capture: i < j, sorted, each once.

    Parameters
    ----------
    count:
        Number of frames.
    overlap:
        Frame i is paired with i + 1, ..., i + ``overlap``.
    quadratic:
        Frame i is also paired with i + 1, i + 2, i + 4, ..., i + 2 ** (``overlap`` - 1), as in COLMAP's
        sequential matcher.
    closed:
        Frames are counted around: after the last comes the first.
    loop_stride:
        All pairs among frames 0, s, 2 s, ... are added; 0 adds none.
    """
    steps = set(range(1, overlap + 1))
    if quadratic:
        # Steps beyond the last frame pair nothing; the bound keeps the powers small.
        steps |= {2**power for power in range(min(overlap, max(count, 1).bit_length()))}
    first = np.arange(count)
    found = [np.zeros((0, 2), dtype=np.int64)]
    for step in sorted(steps):
        second = first + step
        inside = (second < count) | closed
        # Around a circle a step of a full turn or more would only repeat smaller ones.
        if step < count:
            found.append(np.stack([first, second % count], axis=1)[inside])
    if loop_stride > 0:
        found.append(exhaustive_pairs(len(first[::loop_stride])) * loop_stride)
    return _unique(np.concatenate(found))


def spatial_pairs(positions: ArrayLike, neighbours: int, max_distance: float | None = None) -> Pairs:
    """Return pairs (P, 2) of each frame with its nearest ``neighbours``: i < j, sorted, each once.

    Parameters
    ----------
    positions:
        (n, 3) finite camera centres in metres.
    neighbours:
        How many nearest others each frame is paired with; a frame can be in more pairs where it is near to many.
    max_distance:
        Frames farther apart, in metres, are not paired; None: no limit.

    Raises
    ------
    ValueError
        For positions of another shape, NaN or infinity.
    """
    from scipy.spatial import cKDTree

    points = np.asarray(positions, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise ValueError(f"expected finite positions (n, 3), got {points.shape}")
    if len(points) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    # One more than asked, because a frame is its own nearest neighbour.
    wanted = min(neighbours + 1, len(points))
    distance, other = cKDTree(points).query(points, k=np.arange(1, wanted + 1))
    first = np.repeat(np.arange(len(points)), wanted).reshape(other.shape)
    itself = other == first
    # With coincident positions a frame may be missing among its own neighbours: then the last one goes.
    itself[~itself.any(axis=1), -1] = True
    near = ~itself if max_distance is None else ~itself & (distance <= max_distance)
    return _unique(np.stack([first[near], other[near]], axis=1))


def choose_pairs(scene: Scene, settings: PairSettings) -> ChosenPairs:
    """Return the pairs of the scene's frames that the settings ask for.

    Raises
    ------
    StageError
        For fewer than two frames, for the spatial method where half of the frames or more have no position, and
        where no frame is within ``max_distance`` of another.
    """
    count = len(scene)
    if count < 2:
        raise StageError("Matching needs pairs of pictures", expected="at least 2 frames", found=str(count))
    if settings.method == "exhaustive":
        index = exhaustive_pairs(count)
    elif settings.method == "sequential":
        index = sequential_pairs(
            count,
            settings.overlap,
            quadratic=settings.quadratic,
            closed=settings.closed,
            loop_stride=settings.loop_stride,
        )
    else:
        index = _spatial(scene, settings)
        if not len(index):
            raise StageError(
                "No two frames are near enough to each other to be matched",
                expected=f"positions within max_distance = {settings.max_distance:g} m",
                todo="Raise max_distance, or set it to 0",
            )
    return ChosenPairs(settings.method, count, index)


def connected_groups(count: int, pairs: Pairs) -> tuple[tuple[int, ...], ...]:
    """Return the groups of ``count`` frames that pairs (P, 2) connect, the largest first, each sorted."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    number, label = connected_components(links, directed=False)
    groups = (tuple(np.flatnonzero(label == i).tolist()) for i in range(number))
    return tuple(sorted(groups, key=lambda group: (-len(group), group)))


def _spatial(scene: Scene, settings: PairSettings) -> Pairs:
    """Pair frames by the sensors' camera centres; the few that have none, with those before and after them."""
    priors = [frame.prior for frame in scene.frames]
    positions = {i: p.position for i, p in enumerate(priors) if p is not None and p.position is not None}
    missing = [i for i in range(len(scene)) if i not in positions]
    if 2 * len(missing) >= len(scene):
        names = [scene.frames[i].name for i in missing]
        raise StageError(
            "Spatial pairs need a position of most frames",
            expected="positions from EXIF GPS or scene.json",
            found=f"{len(missing)} of {len(scene)} frames without one: "
            + ", ".join(names[:5])
            + (", ..." if len(names) > 5 else ""),
            todo="Choose the exhaustive or the sequential method instead",
        )
    placed = np.array(list(positions))
    near = spatial_pairs(list(positions.values()), settings.neighbours, settings.max_distance or None)
    in_order = sequential_pairs(len(scene), settings.neighbours)
    return _unique(np.concatenate([placed[near], in_order[np.isin(in_order, missing).any(axis=1)]]))


def _unique(pairs: NDArray[np.int64]) -> Pairs:
    """Return pairs (P, 2) with the smaller index first, sorted, each once, none of a frame with itself."""
    ordered = np.sort(pairs, axis=1)
    return np.unique(ordered[ordered[:, 0] < ordered[:, 1]], axis=0)
