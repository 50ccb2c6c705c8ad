"""All segments that SLAM tracked, joined in the world by GPS.

Where tracking was lost, SLAM begins again in another frame and scale, and the paper (A-3DGS, section 5.4) goes on
with the last part only; its outlook (section 7) asks for sensors and SLAM together. Here each segment is laid on
its GPS positions by a robust similarity, and then everything is adjusted at once: motions within the segments, with
a scale for each, and the sensors' readings. Across a gap only the sensors speak.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, StageError
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.slam.georeferenced import Placement, georeference_segment
from toolkit.poses.slam.merged import MergedSegment, MergedTrajectory
from toolkit.poses.slam.pose_graph import GraphSolution, GraphState, PoseGraph, solve
from toolkit.poses.slam.result import SlamResult, SlamSegment
from toolkit.poses.slam.segments import By, segment_poses
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene import PosePrior, Scene
from toolkit.settings import Boolean, Integer, Number, Settings

Array = NDArray[np.float64]

# Positions that keep less than this part of their weight count as rejected.
_REJECTED = 0.25


class MergeSettings(Settings):
    """Segments of a video joined by GPS."""

    horizontal_sigma = Number(
        1.0,
        bounds=(0.001, 100.0),
        unit="m",
        doc="Standard deviation of GPS east and north, for frames that do not tell it.",
    )
    vertical_sigma = Number(
        1.5,
        bounds=(0.001, 1000.0),
        unit="m",
        doc="Standard deviation of the GPS height, for frames that do not tell it.",
    )
    angle_sigma = Number(
        2.0,
        bounds=(0.01, 90.0),
        unit="degrees",
        doc="Standard deviation of the gimbal's attitude about each axis, for frames that do not tell it.",
    )
    always_attitude = Boolean(
        False,
        doc="Take attitudes for measurements on all segments; no: only where a straight path leaves the turn about "
        "it open. A gimbal's errors are much the same in all frames and do not average out.",
    )
    drift = Number(
        0.5,
        bounds=(0.001, 50.0),
        unit="%",
        doc="How far the end of a segment has drifted from its start, as a part of the path between.",
    )
    turn_drift = Number(
        0.5, bounds=(0.001, 45.0), unit="degrees", doc="By how much a segment has turned from start to end."
    )
    min_positions = Integer(6, bounds=(3, 10000), unit="frames", doc="Segments with fewer positions are left out.")
    max_misfit = Number(
        10.0,
        bounds=(1.0, 1000.0),
        unit="sigmas",
        doc="Segments whose middle position is farther from their path are left out.",
    )


def merge_segments(
    result: SlamResult,
    scene: Scene,
    settings: MergeSettings,
    *,
    by: By = "number",
    keyframes_only: bool = False,
    seed: int = 0,
    progress: Progress = silent,
) -> MergedTrajectory:
    """Join all segments that SLAM tracked in the world of the scene's GPS positions.

    Parameters
    ----------
    result:
        As a backend gave it.
    scene:
        With the frames of the video, their priors and a georeference. Poses that it has are not used.
    settings:
        As declared.
    by, keyframes_only:
        Which frames of the scene get which pose, as in
        :func:`~toolkit.poses.slam.segments.scene_with_segment`.
    seed:
        Of the random samples that lay a segment on its positions.
    progress:
        Told of each step; raises to cancel.

    Raises
    ------
    StageError
        Where the scene has no georeference, or no segment can be placed; the message says why for each.
    DataError
        Where frames and poses do not belong together.
    """
    start = time.perf_counter()
    if scene.georeference is None:
        raise StageError(
            "Segments cannot be merged without positions",
            expected="a georeferenced scene with GPS priors",
            found=f"{len(scene)} frames without georeference",
            todo="Give the telemetry of the flight, or take the largest segment alone",
        )
    parts = []
    for number, segment in enumerate(result.segments):
        progress(ProgressEvent("merge.segments", number, len(result.segments)))
        parts.append(
            _Part.of(number, segment, scene, settings, by, keyframes_only, np.random.default_rng([seed, number]))
        )
    placed = [part for part in parts if part.placement is not None]
    if not placed:
        reasons = "; ".join(f"segment {part.number}: {part.reason}" for part in parts)
        raise StageError(
            f"None of {len(parts)} segments can be placed by GPS",
            expected=f"at least {settings.min_positions} positions along a path longer than their noise",
            found=reasons or f"{result.backend} tracked nothing",
        )
    graph, first = _graph(placed, settings)
    solution = solve(
        graph, first, check=lambda step: progress(ProgressEvent("merge.adjust", step, None, "pose graph"))
    )
    poses, segment_of = {}, {}
    for node, (number, place) in enumerate((part.number, place) for part in placed for place in part.places):
        rotation = solution.state.rotations[node].T
        poses[place] = RigidTransform(rotation, -rotation @ solution.state.centres[node])
        segment_of[place] = number
    order = {part.number: i for i, part in enumerate(placed)}
    told = tuple(_told(part, order.get(part.number), graph, solution) for part in parts)
    seconds = time.perf_counter() - start
    return MergedTrajectory(poses, segment_of, told, solution.steps, solution.converged, seconds)


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """A segment with what sensors said of its frames; ``places`` are theirs in the scene, in order of tracking."""

    number: int
    places: tuple[int, ...]
    poses: tuple[RigidTransform, ...]
    priors: tuple[PosePrior | None, ...]
    placement: Placement | None
    reason: str

    @classmethod
    def of(
        cls,
        number: int,
        segment: SlamSegment,
        scene: Scene,
        settings: MergeSettings,
        by: By,
        keyframes_only: bool,
        rng: np.random.Generator,
    ) -> _Part:
        try:
            found = segment_poses(scene, segment, by=by, keyframes_only=keyframes_only)
        except DataError as error:
            # A scene of chosen frames may have none of a short segment; too few of all frames are a mistake.
            if by == "number" or any(frame.time is None for frame in scene.frames):
                raise
            return cls(number, (), (), (), None, str(error))
        priors = tuple(_complete(scene.frames[place].prior, settings) for place in found)
        places, poses = tuple(found), tuple(found.values())
        try:
            return cls(number, places, poses, priors, _placement(poses, priors, settings, rng), "")
        except StageError as error:
            return cls(number, places, poses, priors, None, str(error))

    @property
    def positions(self) -> int:
        """Frames with a position."""
        return sum(prior is not None and prior.position is not None for prior in self.priors)

    def needs_attitudes(self, settings: MergeSettings) -> bool:
        """Whether attitudes are among the measurements."""
        return settings.always_attitude or (self.placement is not None and self.placement.straight)


def _complete(prior: PosePrior | None, settings: MergeSettings) -> PosePrior | None:
    """Return a prior with standard deviations."""
    if prior is None:
        return None
    assumed = np.array([settings.horizontal_sigma, settings.horizontal_sigma, settings.vertical_sigma])
    angle = np.full(3, math.radians(settings.angle_sigma))
    return dataclasses.replace(
        prior,
        position_sigma=assumed if prior.position_sigma is None else prior.position_sigma,
        rotation_sigma=angle if prior.rotation_sigma is None else prior.rotation_sigma,
    )


def _placement(
    poses: Sequence[RigidTransform],
    priors: Sequence[PosePrior | None],
    settings: MergeSettings,
    rng: np.random.Generator,
) -> Placement:
    known, positions, sigmas, attitudes = [], [], [], []
    for pose, prior in zip(poses, priors, strict=True):
        if prior is not None and prior.position is not None and prior.position_sigma is not None:
            known.append(pose)
            positions.append(prior.position)
            sigmas.append(prior.position_sigma)
            attitudes.append(prior.rotation)
    if len(known) < settings.min_positions:
        raise StageError(
            "Too few frames have a GPS position",
            expected=f"at least {settings.min_positions}",
            found=str(len(known)),
        )
    return georeference_segment(
        known,
        np.array(positions),
        np.array(sigmas),
        attitudes,
        max_misfit=settings.max_misfit,
        drift=settings.drift / 100.0 + math.radians(settings.turn_drift) / 2.0,
        rng=rng,
    )


def _graph(parts: Sequence[_Part], settings: MergeSettings) -> tuple[PoseGraph, GraphState]:
    """Return all measurements of placed segments, and where the similarities put their cameras."""
    start: list[RigidTransform] = []
    log_scales: list[float] = []
    motions: list[tuple[Array, ...]] = []
    placed: list[tuple[int, PosePrior]] = []
    turned: list[tuple[int, PosePrior]] = []
    for number, part in enumerate(parts):
        assert part.placement is not None
        world = part.placement.world_from_segment
        motions.append(_motions(part.poses, number, len(start), world.scale, settings))
        log_scales.append(math.log(world.scale))
        for pose, prior in zip(part.poses, part.priors, strict=True):
            if prior is not None and prior.position is not None:
                placed.append((len(start), prior))
            if prior is not None and prior.rotation is not None and part.needs_attitudes(settings):
                turned.append((len(start), prior))
            start.append(world.apply_to_pose(pose))
    first, path, turn, shift, turn_sigma, shift_sigma = (
        np.concatenate(rows) for rows in zip(*motions, strict=True)
    )
    graph = PoseGraph(
        first=first.astype(np.int64),
        second=first.astype(np.int64) + 1,
        path=path.astype(np.int64),
        turn=turn,
        shift=shift,
        turn_sigma=turn_sigma,
        shift_sigma=shift_sigma,
        placed=np.array([node for node, _ in placed], dtype=np.int64),
        position=np.array([prior.position for _, prior in placed]),
        position_sigma=np.array([prior.position_sigma for _, prior in placed]),
        turned=np.array([node for node, _ in turned], dtype=np.int64),
        attitude=np.array([prior.rotation for _, prior in turned]).reshape(-1, 3, 3),
        attitude_sigma=np.array([prior.rotation_sigma for _, prior in turned]).reshape(-1, 3),
    )
    rotations, centres = (np.array(rows) for rows in zip(*((p.rotation.T, p.centre) for p in start), strict=True))
    return graph, GraphState(rotations, centres, np.array(log_scales))


def _motions(
    poses: Sequence[RigidTransform], path: int, node: int, scale: float, settings: MergeSettings
) -> tuple[Array, ...]:
    """Return first nodes, path numbers, turns, shifts and their sigmas of the steps between cameras of a segment.

    Drift is a random walk over the length of the path, so that it does not depend on how many frames there are.
    """
    steps = [a @ b.inverse() for a, b in pairwise(poses)]
    lengths = np.array([np.linalg.norm(step.translation) for step in steps])
    # Where the camera stands, SLAM drifts as on a small step.
    share = np.maximum(lengths, 1e-2 * lengths.mean())
    root = np.sqrt(share / share.sum())
    return (
        node + np.arange(len(steps), dtype=np.float64),
        np.full(len(steps), float(path)),
        np.array([step.rotation for step in steps]),
        np.array([step.translation for step in steps]),
        math.radians(settings.turn_drift) * root,
        settings.drift / 100.0 * scale * float(lengths.sum()) * root,
    )


def _told(part: _Part, number: int | None, graph: PoseGraph, solution: GraphSolution) -> MergedSegment:
    if part.placement is None or number is None:
        return MergedSegment(part.number, len(part.places), part.positions, part.reason)
    nodes = np.unique(np.concatenate([edge[graph.path == number] for edge in (graph.first, graph.second)]))
    mine = np.isin(graph.placed, nodes)
    off = np.linalg.norm(solution.state.centres[graph.placed] - graph.position, axis=1)
    believed = mine & (solution.position_weight > _REJECTED)
    return MergedSegment(
        number=part.number,
        frames=len(part.places),
        positions=part.positions,
        straight=part.placement.straight,
        scale=float(np.exp(solution.state.log_scales[number])),
        rejected=int((mine & ~believed).sum()),
        position_residual=float(np.sqrt(np.mean(np.square(off[believed])))) if believed.any() else None,
    )
