"""Which pictures are matched with which."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import StageError
from toolkit.scene import PosePrior, Scene
from toolkit.settings import Boolean, Choice, Integer, Number, Settings

Pairs = NDArray[np.int64]


class PairSettings(Settings):
    """Which pairs of pictures are matched."""

    method = Choice(
        "exhaustive",
        choices=("exhaustive", "sequential", "spatial", "sensor"),
        doc="Every pair; neighbours in the order of capture; neighbours by the positions that sensors gave; or by "
        "positions and views that sensors gave.",
    )
    overlap = Integer(
        10, bounds=(1, 1000), unit="frames", doc="Sequential: how many following frames each frame is matched with."
    )
    quadratic = Boolean(
        True, doc="Sequential: also match frames 1, 2, 4, 8, ... apart, for as many powers as the overlap says."
    )
    closed = Boolean(
        False, doc="Sequential: the last frame is followed by the first, as on a circle of exactly one turn."
    )
    ends = Integer(
        0,
        bounds=(0, 1000),
        unit="frames",
        doc="Sequential: match each of so many first frames with each of so many last ones: footage that ends "
        "where it began, or a little before or after; 0: do not.",
    )
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
        doc="Spatial and sensor: how many near frames each frame is matched with; one without position is "
        "matched with as many before and after it.",
    )
    reach = Number(
        2.5,
        bounds=(1.0, 100.0),
        doc="Sensor: half of the neighbours are the nearest ones, the others lie ever farther apart up to this "
        "many times their number, since chains of nearest neighbours bend; 1: the nearest only.",
    )
    max_distance = Number(
        0.0,
        bounds=(0.0, None),
        unit="m",
        doc="Spatial and sensor: frames farther apart are not matched; 0: no limit.",
    )
    max_view_angle = Number(
        45.0,
        bounds=(1.0, 180.0),
        unit="degrees",
        doc="Sensor: frames whose optical axes differ by more are not matched, where attitudes are known.",
    )
    in_order = Integer(
        2,
        bounds=(0, 100),
        unit="frames",
        doc="Sensor: each frame is also matched with so many that follow it, because single readings may be wrong.",
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
    count: int,
    overlap: int,
    *,
    quadratic: bool = False,
    closed: bool = False,
    ends: int = 0,
    loop_stride: int = 0,
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
        Frames are counted around: after the last comes the first. Right for exactly one turn; the number of pairs
        stays linear in the number of frames.
    ends:
        Each of the first so many frames is paired with each of the last so many. That closes a loop also where the
        footage covers somewhat less or more than a turn, at most as much as so many frames show.
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
    # More would pair frames in the middle with each other.
    each = min(ends, count // 2)
    if each > 0:
        found.append(np.stack(np.meshgrid(first[:each], first[-each:], indexing="ij"), axis=-1).reshape(-1, 2))
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


def view_pairs(
    positions: ArrayLike,
    views: ArrayLike,
    neighbours: int,
    max_distance: float | None,
    max_angle: float,
    reach: float = 1.0,
) -> Pairs:
    """Return pairs (P, 2) of each frame with ``neighbours`` that are near to it in position and view.

    Distances count in units of the median distance to the farthest wanted neighbour by position alone, which grows
    with the height of a flight as its overlap does; angles between optical axes in units of half the largest one.

    Parameters
    ----------
    positions:
        (n, 3) finite camera centres in metres.
    views:
        (n, 3) unit vectors along the optical axes; NaN where not known: such frames are compared by position alone.
    neighbours:
        How many others each frame is paired with.
    max_distance:
        Frames farther apart, in metres, are not paired; None: no limit.
    max_angle:
        Frames whose axes differ by more, in radians, are not paired.
    reach:
        The nearer half of the neighbours are the nearest ones; the others are farther and farther, up to the one of
        rank ``reach * neighbours``.

    Raises
    ------
    ValueError
        For positions or views of another shape, and positions that are NaN or infinite.
    """
    points, axes = np.asarray(positions, dtype=np.float64), np.asarray(views, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all() or axes.shape != points.shape:
        raise ValueError(
            f"expected finite positions (n, 3) and views of their shape, got {points.shape}, {axes.shape}"
        )
    count = len(points)
    wanted = min(neighbours, count - 1)
    if wanted < 1:
        return np.zeros((0, 2), dtype=np.int64)
    found = []
    farthest = np.array([np.partition(np.linalg.norm(points - point, axis=1), wanted)[wanted] for point in points])
    unit = max(float(np.median(farthest)), 1e-9)
    for i in range(count):
        distance = np.linalg.norm(points - points[i], axis=1)
        cosine = axes @ axes[i]
        angle = np.where(np.isfinite(cosine), np.arccos(np.clip(cosine, -1.0, 1.0)), 0.0)
        cost = np.hypot(distance / unit, 2.0 * angle / max_angle)
        allowed = angle <= max_angle
        if max_distance is not None:
            allowed &= distance <= max_distance
        allowed[i] = False
        nearest = np.argsort(np.where(allowed, cost, np.inf), kind="stable")[: allowed.sum()]
        nearest = nearest[_ranks(wanted, reach, len(nearest))]
        found.append(np.stack([np.full(len(nearest), i), nearest], axis=1))
    return _unique(np.concatenate(found))


def _ranks(wanted: int, reach: float, count: int) -> NDArray[np.int64]:
    """Return which of ``count`` frames, the nearest first, are paired: ``wanted``, or all where there are fewer."""
    consecutive = (wanted + 1) // 2
    far = np.geomspace(consecutive, reach * wanted, wanted - consecutive + 1)[1:]
    ranks = np.arange(wanted)
    # Counted from 1 to here; where rounding lets two meet, the second moves on.
    for i, rank in enumerate(far, start=consecutive):
        ranks[i] = max(round(rank) - 1, ranks[i - 1] + 1)
    # Fewer frames than that: the farthest ones.
    return np.minimum(ranks, count - wanted + np.arange(wanted)) if count > wanted else np.arange(count)


def choose_pairs(scene: Scene, settings: PairSettings) -> ChosenPairs:
    """Return the pairs of the scene's frames that the settings ask for.

    Raises
    ------
    StageError
        For fewer than two frames, for the spatial and sensor methods where half of the frames or more have no
        position, and where no frame is within ``max_distance`` of another.
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
            ends=settings.ends,
            loop_stride=settings.loop_stride,
        )
    else:
        index = _spatial(scene, settings)
        if settings.method == "sensor":
            index = _unique(np.concatenate([index, sequential_pairs(count, settings.in_order)]))
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
            f"{settings.method.capitalize()} pairs need a position of most frames",
            expected="positions from EXIF GPS or scene.json",
            found=f"{len(missing)} of {len(scene)} frames without one: "
            + ", ".join(names[:5])
            + (", ..." if len(names) > 5 else ""),
            todo="Choose the exhaustive or the sequential method instead",
        )
    placed = np.array(list(positions))
    limit = settings.max_distance or None
    if settings.method == "spatial":
        near = spatial_pairs(list(positions.values()), settings.neighbours, limit)
    else:
        views = np.array([_view(priors[i]) for i in positions])
        near = view_pairs(
            list(positions.values()),
            views,
            settings.neighbours,
            limit,
            np.radians(settings.max_view_angle),
            settings.reach,
        )
    in_order = sequential_pairs(len(scene), settings.neighbours)
    return _unique(np.concatenate([placed[near], in_order[np.isin(in_order, missing).any(axis=1)]]))


def _view(prior: PosePrior | None) -> NDArray[np.float64]:
    """Return the optical axis (3,) that sensors gave, NaN where they gave none."""
    if prior is None or prior.rotation is None:
        return np.full(3, np.nan)
    return prior.rotation[2]


def _unique(pairs: NDArray[np.int64]) -> Pairs:
    """Return pairs (P, 2) with the smaller index first, sorted, each once, none of a frame with itself."""
    ordered = np.sort(pairs, axis=1)
    return np.unique(ordered[ordered[:, 0] < ordered[:, 1]], axis=0)
