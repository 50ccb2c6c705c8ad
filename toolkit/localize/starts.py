"""Where a search for a pose begins: the paper's four scenarios, and starts off by so many metres and degrees.

The scenarios are those of section 4.3 of the paper (uav-splat-localization); the true poses are SfM's, as there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, SettingsError, StageError
from toolkit.geometry.rigid import RigidTransform, rotation_angle
from toolkit.scene import Frame, Scene

Array = NDArray[np.float64]
Scenario = Literal["sfm-train", "sfm-test", "calc-test", "sfm-test-pos10"]

SCENARIOS: Final[tuple[Scenario, ...]] = get_args(Scenario)
#: Metres by which each coordinate of a start of ``sfm-test-pos10`` is off at most.
REACH: Final = 10.0
#: Standard deviations of a start that is SfM's own pose: the surface of a map is no more exact than this, and a
#: start that claims to be perfect would outvote every observation.
EXACT_POSITION_SIGMA: Final = 0.1
EXACT_ROTATION_SIGMA_DEG: Final = 0.1
#: Largest part of an offset of :func:`offset_starts` that goes up or down.
_STEEPEST = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """A pose from which a query is looked for.

    Attributes
    ----------
    name:
        Of the frame that is the query.
    cam_from_world:
        The pose.
    position_sigma:
        Standard deviation of the camera centre in metres, on each axis.
    rotation_sigma_deg:
        Standard deviation of the rotation in degrees, about each axis.
    """

    name: str
    cam_from_world: RigidTransform
    position_sigma: float
    rotation_sigma_deg: float


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeOffset:
    """The constant turn between what sensors say of the camera's axes and SfM's poses, and what it leaves.

    Attributes
    ----------
    camera_from_sensors:
        (3, 3) turns the camera axes that the sensors report into the camera's own.
    names:
        (N,) frames that have both a pose and an attitude by sensors.
    left_deg:
        (N,) angle in degrees between pose and attitude of each of them once the turn is taken out.
    of_map:
        (N,) whether it is a map frame: from these the turn was found.
    """

    camera_from_sensors: Array
    names: tuple[str, ...]
    left_deg: Array
    of_map: NDArray[np.bool_]

    @property
    def angle_deg(self) -> float:
        """How large the turn is, in degrees."""
        return math.degrees(rotation_angle(self.camera_from_sensors))

    @property
    def median_deg(self) -> float:
        """Median of the angles that are left over all frames (the paper's: 6.75 degrees)."""
        return float(np.median(self.left_deg))

    @property
    def largest_deg(self) -> float:
        """Largest angle that is left (the paper's: 11.47 degrees)."""
        return float(self.left_deg.max())

    @property
    def sigma_deg(self) -> float:
        """Standard deviation about each axis in degrees, of what is left on the map frames."""
        return float(np.sqrt(np.mean(self.left_deg[self.of_map] ** 2) / 3.0))

    def to_dict(self) -> dict[str, Any]:
        """Return the turn and the angles that are left, ready for JSON."""
        return {
            "camera_from_sensors": self.camera_from_sensors.tolist(),
            "angle_deg": self.angle_deg,
            "median_deg": self.median_deg,
            "largest_deg": self.largest_deg,
            "sigma_deg": self.sigma_deg,
            "per_frame": {
                "name": list(self.names),
                "left_deg": self.left_deg.tolist(),
                "of_map": self.of_map.tolist(),
            },
        }


def scenario_starts(scenario: str, scene: Scene, *, seed: int = 0) -> tuple[Start, ...]:
    """Return the starts of one of the paper's scenarios, one for each of its queries that has a true pose.

    - ``sfm-train``: map frames at their own poses, the best that a map allows;
    - ``sfm-test``: queries at their own poses;
    - ``calc-test``: queries where sensors say that they are, the constant turn between sensors and camera taken
      out (:func:`attitude_offset`). Sigmas are the larger of what the sensors state and what the map frames show;
    - ``sfm-test-pos10``: queries at their own poses, each coordinate off by a draw from -10 to 10 m.

    Parameters
    ----------
    scenario:
        One of :data:`SCENARIOS`.
    scene:
        In metres. Poses are the truth; frames of split ``"train"`` made the map, those of ``"test"`` are queries.
    seed:
        Of what is drawn. A query's draw does not depend on which other queries have a pose.

    Raises
    ------
    SettingsError
        For an unknown scenario.
    StageError
        Where no frame of the scenario has a pose.
    DataError
        For ``calc-test``, where a query lacks position or attitude by sensors or no map frame has an attitude.
    """
    if scenario not in SCENARIOS:
        raise SettingsError(f"Unknown scenario '{scenario}'", expected="one of " + ", ".join(SCENARIOS))
    if scenario == "calc-test":
        return _by_sensors(scene)
    if scenario == "sfm-test-pos10":
        draws = np.random.default_rng(seed).uniform(-REACH, REACH, (len(_drawn(scene)), 3))
        sigma = REACH / math.sqrt(3.0)
        return tuple(
            Start(frame.name, _at(pose.rotation, pose.centre + draws[row]), sigma, EXACT_ROTATION_SIGMA_DEG)
            for row, frame, pose in _queries(scene)
        )
    split = scene.of_split("train") if scenario == "sfm-train" else [frame for _, frame, _ in _queries(scene)]
    if not split:
        raise StageError(
            "No map frame has a pose", expected="at least 1 registered frame of split 'train'", found="0"
        )
    return tuple(
        Start(frame.name, frame.cam_from_world, EXACT_POSITION_SIGMA, EXACT_ROTATION_SIGMA_DEG)
        for frame in split
        if frame.cam_from_world is not None
    )


def offset_starts(scene: Scene, metres: float, degrees: float, *, seed: int) -> tuple[Start, ...]:
    """Return starts that are off by exactly so much, in directions and about axes that are drawn.

    A query is moved along a direction that is level to within 15 degrees, its heading drawn evenly, and turned
    about its own centre, the axis drawn evenly from the sphere. The draws depend on the seed alone: with the same
    seed a larger offset leads farther on the same line.

    Parameters
    ----------
    scene:
        In metres, with true poses of queries (split ``"test"``).
    metres, degrees:
        How far each start is off; 0 leaves position or rotation as it is. At most 180 degrees.
    seed:
        Of what is drawn.

    Raises
    ------
    SettingsError
        For an offset that is negative, not finite or of more than 180 degrees.
    StageError
        Where no query has a pose.
    """
    if not (0 <= metres < math.inf and 0 <= degrees <= 180):
        raise SettingsError(
            "A start cannot be off by so much",
            expected="metres from 0, degrees from 0 to 180",
            found=f"{metres} m, {degrees} degrees",
        )
    from scipy.spatial.transform import Rotation

    generator = np.random.default_rng(seed)
    count = len(_drawn(scene))
    heading, rise = generator.uniform(0.0, 2 * np.pi, count), generator.uniform(-_STEEPEST, _STEEPEST, count)
    level = np.sqrt(1.0 - rise**2)
    directions = np.stack([level * np.cos(heading), level * np.sin(heading), rise], axis=1)
    axes = generator.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turns = Rotation.from_rotvec(np.radians(degrees) * axes).as_matrix().reshape(-1, 3, 3)
    position_sigma = max(metres / math.sqrt(3.0), EXACT_POSITION_SIGMA)
    rotation_sigma = max(degrees / math.sqrt(3.0), EXACT_ROTATION_SIGMA_DEG)
    return tuple(
        Start(
            frame.name,
            _at(turns[row] @ pose.rotation, pose.centre + metres * directions[row]),
            position_sigma,
            rotation_sigma,
        )
        for row, frame, pose in _queries(scene)
    )


def attitude_offset(scene: Scene) -> AttitudeOffset:
    """Return the constant turn between sensors and camera, found on the map frames, and what it leaves on all.

    Kabsch's rotation as in section 4.1 of the paper: it turns the camera axes that the sensors report into those
    of SfM with the least sum of squared differences of all axes. It stands for a mounting that is not known; an
    error of the heading that all frames share in the world is another thing and stays.

    Raises
    ------
    DataError
        Where no map frame has both a pose and an attitude by sensors.
    """
    from scipy.spatial.transform import Rotation

    known = [frame for frame in scene.registered if frame.prior is not None and frame.prior.rotation is not None]
    of_map = np.array([frame.split == "train" for frame in known], dtype=np.bool_)
    if not of_map.any():
        raise DataError(
            "No map frame has an attitude by sensors",
            expected="priors with a rotation, to find the turn between sensors and camera",
            found=f"{len(scene.of_split('train'))} map frames with a pose",
        )
    turns = np.array([_turn(frame) for frame in known])
    # The mean that is nearest in the sense of matrices is Kabsch's solution.
    offset: Array = Rotation.from_matrix(turns[of_map]).mean().as_matrix()
    left = np.degrees([rotation_angle(turn @ offset.T) for turn in turns])
    return AttitudeOffset(offset, tuple(frame.name for frame in known), left, of_map)


def _by_sensors(scene: Scene) -> tuple[Start, ...]:
    queries = _queries(scene)
    without = [
        frame.name
        for _, frame, _ in queries
        if frame.prior is None or frame.prior.position is None or frame.prior.rotation is None
    ]
    if without:
        raise DataError(
            f"Query '{without[0]}' has no start by sensors",
            expected="position and attitude of every query",
            found=f"{len(without)} of {len(queries)} without",
            todo="Take another scenario than calc-test",
        )
    offset = attitude_offset(scene)
    shown = _position_spread(scene.of_split("train"))
    starts = []
    for _, frame, _ in queries:
        prior = frame.prior
        assert prior is not None
        assert prior.position is not None
        assert prior.rotation is not None
        stated = _rms(prior.position_sigma)
        stated_deg = math.degrees(_rms(prior.rotation_sigma))
        starts.append(
            Start(
                frame.name,
                _at(offset.camera_from_sensors @ prior.rotation, prior.position),
                max(stated, shown, EXACT_POSITION_SIGMA),
                max(stated_deg, offset.sigma_deg, EXACT_ROTATION_SIGMA_DEG),
            )
        )
    return tuple(starts)


def _position_spread(frames: Sequence[Frame]) -> float:
    """Return the root mean square difference a coordinate between sensors and SfM, 0 where no frame has both."""
    off = [
        frame.prior.position - frame.cam_from_world.centre
        for frame in frames
        if frame.cam_from_world is not None and frame.prior is not None and frame.prior.position is not None
    ]
    return _rms(np.array(off)) if off else 0.0


def _rms(values: Array | None) -> float:
    return 0.0 if values is None else float(np.sqrt(np.mean(np.asarray(values) ** 2)))


def _turn(frame: Frame) -> Array:
    """Return the turn (3, 3) from the camera axes that the sensors report to those of the pose."""
    assert frame.cam_from_world is not None
    assert frame.prior is not None
    assert frame.prior.rotation is not None
    turn: Array = frame.cam_from_world.rotation @ frame.prior.rotation.T
    return turn


def _drawn(scene: Scene) -> list[Frame]:
    """Return all queries, with a pose or not: each has its own draw."""
    return [frame for frame in scene.frames if frame.split == "test"]


def _queries(scene: Scene) -> list[tuple[int, Frame, RigidTransform]]:
    """Return row among all queries, frame and pose of those that have one."""
    found = [
        (row, frame, frame.cam_from_world)
        for row, frame in enumerate(_drawn(scene))
        if frame.cam_from_world is not None
    ]
    if not found:
        raise StageError(
            "No query has a true pose",
            expected="at least 1 registered frame of split 'test'",
            found=f"{len(_drawn(scene))} queries without",
        )
    return found


def _at(rotation: Array, centre: Array) -> RigidTransform:
    return RigidTransform(rotation, -rotation @ centre)
