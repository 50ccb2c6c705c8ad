"""Do the pictures agree with their sensors? Two-view geometry of matched pairs against GPS and gimbal."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.geometry.rigid import RigidTransform, rotation_angle
from toolkit.matching.database import require_same_frames
from toolkit.poses.sensor_heading import find_heading, with_heading_taken
from toolkit.poses.sensor_turns import BASELINE_SIGMAS, QUARTERS, RelativePose, angle_between, find_quarters
from toolkit.poses.sensors import some, turned
from toolkit.progress import Progress, silent, track
from toolkit.scene import Scene

Array = NDArray[np.float64]

_LEAST_MATCHES = 30
_PAIRS_A_FRAME = 10
# Rotations and directions that disagree by more (in degrees) are worth a word, whatever the accuracy told.
_ODD_ROTATION, _ODD_DIRECTION = 12.0, 45.0
_ODD_SIGMAS = 5.0
# Directions that disagree by more in the middle of all pairs may come from a heading that is wrong in all photos,
# if taking it out brings them to this share.
_ODD_IN_ALL, _EXPLAINED = 10.0, 0.5


@dataclass(frozen=True, slots=True)
class PairCheck:
    """What two pictures say about the poses of their cameras, against the sensors.

    Attributes
    ----------
    first, second:
        Frame names.
    matches:
        Verified matches.
    rotation:
        Angle between the relative rotations by pixels and by sensors, in degrees, after turns are put in.
    direction:
        Angle between the directions from the second camera to the first, in degrees; None where the cameras are
        too near each other.
    """

    first: str
    second: str
    matches: int
    rotation: float
    direction: float | None


@dataclass(frozen=True, slots=True)
class PixelCheck:
    """Sensors against pictures.

    Attributes
    ----------
    turns:
        By frame name, degrees by which its picture is turned clockwise against its gimbal: 90, 180 or 270.
        Pictures that are not turned are left out.
    heading:
        Degrees by which the attitudes of all frames are turned clockwise, seen from above; 0 where it is not tens
        of degrees, as of a compass that was not calibrated or of flight yaw in place of gimbal yaw.
    anchored:
        Whether positions told turned pictures from upright ones; else the larger group counts as upright.
    pairs:
        The pairs that were looked at.
    frame_rotation, frame_direction:
        Median disagreement over the pairs of each frame, in degrees.
    contradicted:
        Frames whose readings the pictures contradict, with the reading (``"gimbal angles"``, ``"position"``).
    warnings:
        What does not fit, a sentence each.
    """

    turns: Mapping[str, float]
    heading: float
    anchored: bool
    pairs: tuple[PairCheck, ...]
    frame_rotation: Mapping[str, float]
    frame_direction: Mapping[str, float]
    contradicted: Mapping[str, str]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the findings, ready for JSON."""
        return asdict(self)


def check_pixels(scene: Scene, database_path: Path, *, progress: Progress = silent) -> PixelCheck:
    """Compare relative poses from verified matches with those from sensors, and find pictures that were turned.

    Programs and people turn photos after they were taken (by 90, 180 or 270 degrees); the gimbal's angles then
    fit no more. The turn of each picture is found from the relative rotations between neighbours and, since these
    only tell turned from unturned, from the directions between cameras, which GPS knows too.

    Parameters
    ----------
    scene:
        With poses and priors from :func:`toolkit.poses.sensors.sensor_poses`.
    database_path:
        Verified matches of its frames. COLMAP opens it, which may change the file though not what it holds.
    progress:
        Told after each pair.

    Raises
    ------
    DataError
        For a database that is missing or of another scene.
    """
    names = tuple(frame.name for frame in scene.frames)
    require_same_frames(database_path, scene)
    pairs = _relative_poses(scene, database_path, progress)
    poses = [frame.cam_from_world for frame in scene.frames]
    sigmas = _sigmas(scene)
    found = _compare(pairs, poses, sigmas, names)
    heading = 0.0
    if found.disagreement > _ODD_IN_ALL:
        wrong = find_heading(pairs, poses, sigmas)
        if wrong is not None:
            better = [None if pose is None else with_heading_taken(pose, wrong) for pose in poses]
            again = _compare(pairs, better, sigmas, names)
            if again.disagreement < _EXPLAINED * found.disagreement:
                found, heading = again, wrong
    turns = {names[i]: QUARTERS[quarter] for i, quarter in found.quarters.items() if quarter}
    rotation = _by_frame(found.checks, lambda check: check.rotation)
    direction = _by_frame(found.checks, lambda check: check.direction)
    reached = {i for pair in pairs for i in (pair.first, pair.second)}
    odd = _contradicted(scene, rotation, direction)
    warnings = (
        *_heading_warning(heading),
        *_turn_warnings(scene, turns, found.anchored),
        *_odd_warnings(scene, odd, rotation, direction, reached),
    )
    return PixelCheck(turns, heading, found.anchored, found.checks, rotation, direction, odd, warnings)


@dataclass(frozen=True, slots=True)
class _Comparison:
    """Pairs against poses: quarter turns of frames, whether positions told them, and what is left."""

    quarters: Mapping[int, int]
    anchored: bool
    checks: tuple[PairCheck, ...]

    @property
    def disagreement(self) -> float:
        """Median angle between directions, in degrees; 0 where there are none."""
        angles = [check.direction for check in self.checks if check.direction is not None]
        return float(np.median(angles)) if angles else 0.0


def _compare(
    pairs: Sequence[RelativePose], poses: Sequence[RigidTransform | None], sigmas: Array, names: Sequence[str]
) -> _Comparison:
    quarters, anchored = find_quarters(pairs, poses, sigmas)
    upright = [
        None if pose is None else _turned_pose(pose, QUARTERS[quarters.get(i, 0)]) for i, pose in enumerate(poses)
    ]
    return _Comparison(quarters, anchored, tuple(_check(pair, upright, names, sigmas) for pair in pairs))


def _relative_poses(scene: Scene, database_path: Path, progress: Progress) -> list[RelativePose]:
    """Return the relative pose of the strongest pairs of each frame with sensor poses."""
    with closing(pycolmap.Database.open(database_path)) as database:
        numbers, geometries = database.read_two_view_geometries()
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        strongest = sorted(
            ((len(geometry.inlier_matches), i) for i, geometry in enumerate(geometries)), reverse=True
        )
        seen: dict[int, int] = {}
        chosen = []
        for matches, i in strongest:
            first, second = (number - 1 for number in pycolmap.pair_id_to_image_pair(numbers[i]))
            both = scene.frames[first].cam_from_world, scene.frames[second].cam_from_world
            if matches < _LEAST_MATCHES or None in both:
                continue
            if min(seen.get(first, 0), seen.get(second, 0)) >= _PAIRS_A_FRAME:
                continue
            seen[first], seen[second] = seen.get(first, 0) + 1, seen.get(second, 0) + 1
            chosen.append((first, second, geometries[i]))
        keypoints = {i: database.read_keypoints(i + 1)[:, :2].astype(np.float64) for i in seen}
    found = []
    for first, second, geometry in track(chosen, "sensors.pixels", progress):
        camera1, camera2 = (cameras[scene.frames[i].camera_id] for i in (first, second))
        usable = pycolmap.estimate_two_view_geometry_pose(
            camera1, keypoints[first], camera2, keypoints[second], geometry
        )
        motion = geometry.cam2_from_cam1
        if not usable or motion is None or not np.linalg.norm(motion.translation) > 0:
            continue
        direction = np.asarray(motion.translation) / np.linalg.norm(motion.translation)
        found.append(
            RelativePose(
                first, second, len(geometry.inlier_matches), np.asarray(motion.rotation.matrix()), direction
            )
        )
    return found


def _sigmas(scene: Scene) -> Array:
    """Return the largest standard deviation of each frame's position (F,), 0 where none is known."""
    return np.array(
        [
            0.0 if f.prior is None or f.prior.position_sigma is None else float(np.max(f.prior.position_sigma))
            for f in scene.frames
        ]
    )


def _turned_pose(pose: RigidTransform, degrees: float) -> RigidTransform:
    rotation = turned(pose.rotation, degrees)
    return RigidTransform(rotation, -rotation @ pose.centre)


def _check(
    pair: RelativePose, poses: Sequence[RigidTransform | None], names: Sequence[str], sigmas: Array
) -> PairCheck:
    first, second = poses[pair.first], poses[pair.second]
    assert first is not None
    assert second is not None
    baseline = first.centre - second.centre
    far = np.linalg.norm(baseline) > BASELINE_SIGMAS * max(sigmas[pair.first], sigmas[pair.second])
    return PairCheck(
        names[pair.first],
        names[pair.second],
        pair.matches,
        math.degrees(rotation_angle(pair.rotation @ (second.rotation @ first.rotation.T).T)),
        math.degrees(angle_between(second.rotation @ baseline, pair.direction)) if far else None,
    )


def _by_frame(checks: Sequence[PairCheck], value: Callable[[PairCheck], float | None]) -> dict[str, float]:
    values: dict[str, list[float]] = {}
    for check in checks:
        angle = value(check)
        if angle is not None:
            values.setdefault(check.first, []).append(angle)
            values.setdefault(check.second, []).append(angle)
    return {name: float(np.median(several)) for name, several in values.items()}


def _contradicted(scene: Scene, rotation: Mapping[str, float], direction: Mapping[str, float]) -> dict[str, str]:
    sigmas = [frame.prior.rotation_sigma for frame in scene.frames if frame.prior is not None]
    told = max((math.degrees(float(np.max(sigma))) for sigma in sigmas if sigma is not None), default=0.0)
    limit = max(_ODD_ROTATION, _ODD_SIGMAS * told)
    return {name: "gimbal angles" for name, angle in rotation.items() if angle > limit} | {
        name: "position" for name, angle in direction.items() if angle > _ODD_DIRECTION
    }


def _heading_warning(heading: float) -> list[str]:
    if heading == 0:
        return []
    return [
        f"the heading of all photos is wrong by {heading:.0f} degrees: a compass that was not calibrated, or the "
        "yaw of the drone in place of the camera's"
    ]


def _turn_warnings(scene: Scene, turns: Mapping[str, float], anchored: bool) -> list[str]:
    warnings = []
    for degrees in QUARTERS[1:]:
        names = [name for name, turn in turns.items() if turn == degrees]
        if names:
            how = "" if anchored else " (or all others are: positions do not tell)"
            warnings.append(
                f"{len(names)} of {len(scene)} photos are turned by {degrees:g} degrees against their gimbal "
                f"angles{how}: {some(sorted(names))}"
            )
    return warnings


def _odd_warnings(
    scene: Scene,
    contradicted: Mapping[str, str],
    rotation: Mapping[str, float],
    direction: Mapping[str, float],
    reached: set[int],
) -> list[str]:
    warnings = []
    placed = [i for i, frame in enumerate(scene.frames) if frame.cam_from_world is not None]
    missing = [scene.frames[i].name for i in placed if i not in reached]
    if missing:
        warnings.append(f"{len(missing)} photos match no other well enough to be checked: {some(missing)}")
    for what, angles in (("gimbal angles", rotation), ("position", direction)):
        odd = [f"{name} ({angles[name]:.0f} degrees)" for name, reading in contradicted.items() if reading == what]
        if odd:
            warnings.append(f"the pictures contradict the {what} of {len(odd)} photos: {some(odd)}")
    return warnings
