"""What sensors get wrong in the same way in every photo: found by comparing readings with refined poses.

Refined poses are fitted to all positions at once, and pictures hold them stiff. So a reading's constant errors show
as differences that all photos share: a turn about the vertical (heading), a turn of the camera in its mount
(boresight), positions that are early or late (time offset) or taken beside the camera (lever arm). What an error
has in common with a shift, turn or scale of the whole flight has gone into the fit and cannot be found; each
estimate is therefore made with these among the unknowns and says where the flight leaves it open.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.poses.sensors import turned
from toolkit.scene import Frame, Scene

Array = NDArray[np.float64]

_LEAST_FRAMES = 6
# Estimates this many times less certain than if nothing else were unknown are told from the rest by chance only.
_INFLATION = 4.0
# Corrections below this many standard deviations would add noise.
_SIGNIFICANT = 3.0
_HEADING_LIMIT = 5.0
_STANDING = 0.1  # metres a second
# Where the velocity changes by more than this part from one photo to the next, it is not known between them.
_EVEN = 0.5
_UP = np.array([0.0, 0.0, 1.0])
_STEPS, _CAUCHY = 20, 2.385

_CONSTANT = (
    "a constant error of all positions moves the reconstruction as a whole, which no picture shows: it needs "
    "ground control or a second receiver"
)
_ONE_WITH_WHOLE = "on this flight it moves positions as a shift, turn or scale of the whole flight would"
_ONE_WITH_HEADING = (
    "the part about the vertical is counted as heading: all photos look down by nearly the same angle, so the two "
    "cannot be told apart"
)


@dataclass(frozen=True, slots=True)
class Estimate:
    """A constant error of a sensor.

    Attributes
    ----------
    value, sigma:
        Reading minus truth and its standard deviation; None where it is not determined.
    reason:
        Why it is not determined, or what was assumed; empty otherwise.
    """

    value: float | None
    sigma: float | None
    reason: str = ""

    @property
    def significant(self) -> bool:
        """Whether it is three standard deviations or more from nothing."""
        return self.value is not None and self.sigma is not None and abs(self.value) >= _SIGNIFICANT * self.sigma

    @property
    def applied(self) -> float:
        """The value where it is significant, else 0."""
        return self.value if self.value is not None and self.significant else 0.0


@dataclass(frozen=True, slots=True)
class SensorBiases:
    """Constant errors of the sensors of one flight, each reading minus truth.

    Attributes
    ----------
    frames:
        How many frames were compared.
    heading:
        Turn about the vertical, degrees clockwise seen from above.
    boresight:
        Turns about the camera's x, y and z axes in degrees: the camera in its mount, and constant gimbal errors.
        A gimbal that tells a pitch too high by one degree has +1 about x.
    time_offset:
        Seconds by which positions are of a later moment than their photos.
    lever_ahead, lever_right:
        Metres from the camera to the measured position, level, ahead of and to the right of the picture.
    altitude:
        Metres; never determined from pictures and positions alone.
    rotation_noise, position_noise:
        Robust standard deviation an axis of what is left, in degrees and metres.
    """

    frames: int
    heading: Estimate
    boresight: tuple[Estimate, Estimate, Estimate]
    time_offset: Estimate
    lever_ahead: Estimate
    lever_right: Estimate
    altitude: Estimate
    rotation_noise: float | None
    position_noise: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return dataclasses.asdict(self)


def estimate_biases(scene: Scene, *, turns: Mapping[str, float] | None = None) -> SensorBiases:
    """Compare refined poses with the readings in the scene's priors.

    Parameters
    ----------
    scene:
        Refined poses in the sensors' east-north-up frame, with the readings as priors. Wrong readings of single
        photos are outweighed (Cauchy weights).
    turns:
        Degrees by which stored pictures are turned clockwise against the camera, by name, where they are.
    """
    frames = [frame for frame in scene.registered if frame.prior is not None]
    rotation = _rotation_part(frames, turns or {})
    position = _position_part(frames, turns or {})
    return SensorBiases(
        frames=len(frames),
        heading=rotation[0],
        boresight=(rotation[1], rotation[2], rotation[3]),
        time_offset=position[0],
        lever_ahead=position[1],
        lever_right=position[2],
        altitude=Estimate(None, None, _CONSTANT),
        rotation_noise=rotation[4],
        position_noise=position[3],
    )


def correct(scene: Scene, biases: SensorBiases, *, turns: Mapping[str, float] | None = None) -> Scene:
    """Return the scene with priors from which the significant biases are taken; poses stay as they are.

    Where a frame has a pose, its motion and axes are those of the poses, otherwise those of the readings.
    """
    turns = turns or {}
    to_camera = _rotation(np.radians([part.applied for part in biases.boresight]))
    about_up = _rotation(math.radians(biases.heading.applied) * _UP)
    offset, ahead, right = (part.applied for part in (biases.time_offset, biases.lever_ahead, biases.lever_right))
    frames = []
    for frame, speed in zip(scene.frames, _velocities(scene.frames), strict=True):
        prior = frame.prior
        if prior is None:
            frames.append(frame)
            continue
        rotation, position = prior.rotation, prior.position
        if rotation is not None:
            turn = turns.get(frame.name, 0.0)
            rotation = turned(to_camera @ turned(rotation, -turn) @ about_up.T, turn)
        if position is not None:
            pose = frame.cam_from_world
            seen = rotation if pose is None else pose.rotation
            if seen is not None:
                axes = _level_axes(turned(seen, -turns.get(frame.name, 0.0)))
                position = position - axes @ np.array([ahead, right])
            if speed is not None:
                position = position - offset * speed
        frames.append(
            dataclasses.replace(frame, prior=dataclasses.replace(prior, rotation=rotation, position=position))
        )
    return scene.replace(frames=tuple(frames))


def _rotation_part(
    frames: Sequence[Frame], turns: Mapping[str, float]
) -> tuple[Estimate, Estimate, Estimate, Estimate, float | None]:
    """Return heading, boresight about x, y and z, and the noise an axis in degrees.

    The model is told = B^T true H: H turns the world about the vertical, B the camera in its mount.
    """
    told, true, centres = [], [], []
    for frame in frames:
        pose, prior = frame.cam_from_world, frame.prior
        if pose is not None and prior is not None and prior.rotation is not None:
            turn = turns.get(frame.name, 0.0)
            told.append(turned(prior.rotation, -turn))
            true.append(turned(pose.rotation, -turn))
            centres.append(pose.centre)
    if len(told) < _LEAST_FRAMES:
        none = Estimate(None, None, f"{len(told)} photos have an attitude, {_LEAST_FRAMES} are needed")
        return none, none, none, none, None
    tells, trues = np.array(told), np.array(true)
    up_in_camera = (trues @ _UP).mean(axis=0)
    up_in_camera /= np.linalg.norm(up_in_camera)
    free = np.eye(3)
    parameters, covariance, noise = _fit_rotation(tells, trues, free)
    alone = noise / math.sqrt(len(told))
    confounded = math.sqrt(covariance[0, 0]) > _INFLATION * alone
    if confounded:
        # Of the boresight only what does not look like heading.
        free = np.linalg.svd(up_in_camera[None])[2][1:].T
        parameters, covariance, noise = _fit_rotation(tells, trues, free)
    boresight = free @ parameters[1:]
    spread = free @ covariance[1:, 1:] @ free.T
    sigma = math.degrees(math.hypot(math.sqrt(covariance[0, 0]), _frame_heading_sigma(frames, np.array(centres))))
    heading = Estimate(math.degrees(parameters[0]), sigma)
    if sigma > _HEADING_LIMIT:
        heading = Estimate(None, None, f"the positions do not spread enough to tell north (to {sigma:.0f} degrees)")
    reason = _ONE_WITH_HEADING if confounded else ""
    x, y, z = (
        Estimate(math.degrees(boresight[i]), math.degrees(math.sqrt(max(spread[i, i], 0.0))), reason)
        for i in range(3)
    )
    return heading, x, y, z, math.degrees(noise)


def _fit_rotation(told: Array, true: Array, free: Array) -> tuple[Array, Array, float]:
    """Fit heading and boresight (1 + k,), the latter in the columns of ``free`` (3, k), by Cauchy weights.

    Returns radians, their covariance, and the robust standard deviation an axis. Gauss-Newton on what is left of
    told^T B^T true H.
    """
    count = len(told)
    parameters = np.zeros(1 + free.shape[1])
    parameters[0] = _start_heading(told, true)
    covariance, noise = np.eye(len(parameters)), 0.0
    for _ in range(_STEPS):
        predicted = _rotation(-free @ parameters[1:]) @ true @ _rotation(parameters[0] * _UP)
        left = _vectors(told.transpose(0, 2, 1) @ predicted)
        design = np.concatenate(
            [np.broadcast_to(_UP, (count, 3))[:, :, None], -predicted.transpose(0, 2, 1) @ free], axis=2
        )
        noise = max(1.4826 * float(np.median(np.abs(left))), 1e-9)
        noise *= math.sqrt(3 * count / (3 * count - len(parameters)))
        size = np.linalg.norm(left, axis=1) / (_CAUCHY * noise)
        weight = 1.0 / (1.0 + size**2)
        normal = np.einsum("n,nai,naj->ij", weight, design, design)
        # Directions that nothing determines (a boresight about the vertical) get no step and a great variance.
        normal += 1e-9 * count * np.eye(len(normal))
        step = -np.linalg.solve(normal, np.einsum("n,nai,na->i", weight, design, left))
        parameters = parameters + step
        covariance = noise**2 * np.linalg.inv(normal)
        if np.abs(step).max() < 1e-9:
            break
    return parameters, covariance, noise


def _start_heading(told: Array, true: Array) -> float:
    """Return the heading difference, in radians clockwise, nearest to the others: outliers do not move it."""
    about_up = -_vectors(told.transpose(0, 2, 1) @ true)[:, 2]
    chosen = about_up[:: max(1, len(about_up) // 400)]
    apart = np.abs((chosen[:, None] - about_up[None] + np.pi) % (2 * np.pi) - np.pi)
    return float(chosen[np.argmin(apart.sum(axis=1))])


def _frame_heading_sigma(frames: Sequence[Frame], centres: Array) -> float:
    """Return how well positions tell north, in radians: their noise over their spread."""
    sigmas = [
        float(np.mean(frame.prior.position_sigma[:2]))
        for frame in frames
        if frame.prior is not None and frame.prior.position_sigma is not None
    ]
    reach = float(np.sqrt(np.square(centres[:, :2] - centres[:, :2].mean(axis=0)).sum()))
    return (float(np.median(sigmas)) if sigmas else 1.0) / max(reach, 1e-9)


def _position_part(
    frames: Sequence[Frame], turns: Mapping[str, float]
) -> tuple[Estimate, Estimate, Estimate, float | None]:
    """Return time offset, lever arms ahead and to the right, and the noise an axis in metres."""
    placed = [frame for frame in frames if frame.prior is not None and frame.prior.position is not None]
    if len(placed) < _LEAST_FRAMES:
        none = Estimate(None, None, f"{len(placed)} photos have a position, {_LEAST_FRAMES} are needed")
        return none, none, none, None
    velocity = _velocities(placed)
    rows, differences = [], []
    for frame in placed:
        pose, prior = frame.cam_from_world, frame.prior
        assert pose is not None
        assert prior is not None
        assert prior.position is not None
        rows.append(_level_axes(turned(pose.rotation, -turns.get(frame.name, 0.0))))
        differences.append(prior.position - pose.centre)
    levers, left = np.array(rows), np.array(differences)
    centres = np.array([f.cam_from_world.centre for f in placed if f.cam_from_world is not None])
    whole = _whole(centres - centres.mean(axis=0))
    even = np.array([speed is not None for speed in velocity])
    motions = np.array([speed for speed in velocity if speed is not None]).reshape(-1, 3)
    pace = math.sqrt(float(np.square(motions).sum(axis=1).mean())) if len(motions) else 0.0
    if even.sum() >= _LEAST_FRAMES and pace > _STANDING:
        biases = np.concatenate([motions[:, :, None], levers[even]], axis=2)
        found, noise = _position_estimates(biases, whole[even], left[even], "smm")
        return found[0], found[1], found[2], noise
    why = "the camera hardly moved" if even.any() else "the photos tell neither times nor an even motion"
    found, noise = _position_estimates(levers, whole, left, "mm")
    return Estimate(None, None, why), found[0], found[1], noise


def _position_estimates(biases: Array, whole: Array, left: Array, units: str) -> tuple[list[Estimate], float]:
    """Return an estimate of each column of ``biases`` (F, 3, k), and the noise an axis in metres."""
    values, sigmas, noise = _fit_positions(biases, whole, left)
    found = []
    for i, unit in enumerate(units):
        best = noise / max(math.sqrt(float(np.square(biases[:, :, i]).sum())), 1e-9)
        if sigmas[i] <= _INFLATION * best:
            found.append(Estimate(float(values[i]), float(sigmas[i])))
            continue
        by_itself, alone, _ = _fit_positions(biases[:, :, i : i + 1], whole, left)
        found.append(
            Estimate(None, None, _ONE_WITH_WHOLE if alone[0] > _INFLATION * best else _sum(by_itself, alone, unit))
        )
    return found, noise


def _sum(value: Array, sigma: Array, unit: str) -> str:
    return (
        "flown at one speed and looking one way along the flight, time offset and lever arm move positions alike: "
        f"{value[0]:.2f} {unit} (to {sigma[0]:.2f}) if it were this alone"
    )


def _whole(centres: Array) -> Array:
    """Return what a shift, a turn and a scale of the whole flight do to centres (F, 3): (F, 3, 7)."""
    shifts = np.broadcast_to(np.eye(3), (len(centres), 3, 3))
    reach = max(float(np.sqrt(np.square(centres).sum(axis=1).mean())), 1e-9)
    turns = np.cross(np.eye(3)[None], centres[:, None] / reach).transpose(0, 2, 1)
    return np.concatenate([shifts, turns, centres[:, :, None] / reach], axis=2)


def _fit_positions(biases: Array, whole: Array, left: Array) -> tuple[Array, Array, float]:
    """Fit biases (F, 3, k) beside motions of the whole (F, 3, 7) to differences (F, 3), by Cauchy weights.

    Returns values and standard deviations (k,), and the robust noise an axis.
    """
    count, k = len(left), biases.shape[2]
    design = np.concatenate([biases, whole], axis=2)
    ridge = 1e-9 * count * np.eye(design.shape[2])
    weight, noise = np.ones(count), 0.0
    values, covariance = np.zeros(design.shape[2]), ridge
    for _ in range(_STEPS):
        normal = np.einsum("n,nai,naj->ij", weight, design, design) + ridge
        values = np.linalg.solve(normal, np.einsum("n,nai,na->i", weight, design, left))
        rest = left - design @ values
        free = max(3 * count - design.shape[2], 1)
        noise = max(1.4826 * float(np.median(np.abs(rest))) * math.sqrt(3 * count / free), 1e-9)
        weight = 1.0 / (1.0 + np.square(np.linalg.norm(rest, axis=1) / (_CAUCHY * noise)))
        covariance = noise**2 * np.linalg.inv(normal)
    return values[:k], np.sqrt(np.diagonal(covariance)[:k]), noise


def _velocities(frames: Sequence[Frame]) -> list[Array | None]:
    """Return metres a second (3,) of each frame, from those before and after it in time.

    None for frames without time or place, and where the drone turns, brakes or starts.
    """
    known: list[tuple[float, int, Array]] = []
    for i, frame in enumerate(frames):
        centre = None if frame.cam_from_world is None else frame.cam_from_world.centre
        if centre is None and frame.prior is not None:
            centre = frame.prior.position
        if frame.time is not None and centre is not None:
            known.append((frame.time, i, centre))
    known.sort(key=lambda entry: entry[:2])
    found: list[Array | None] = [None] * len(frames)
    legs = [
        (there - here) / (end - start) if end > start else None
        for (start, _, here), (end, _, there) in pairwise(known)
    ]
    for place, (_, i, _) in enumerate(known):
        near = [leg for leg in legs[max(place - 1, 0) : place + 1] if leg is not None]
        if not near:
            continue
        fastest = max(float(np.linalg.norm(leg)) for leg in near)
        if float(np.linalg.norm(near[0] - near[-1])) <= _EVEN * fastest:
            found[i] = np.mean(near, axis=0)
    return found


def _level_axes(rotation: Array) -> Array:
    """Return level unit vectors (3, 2) ahead of and to the right of a picture with ``cam_from_world`` (3, 3)."""
    right = np.array([rotation[0, 0], rotation[0, 1], 0.0])
    size = float(np.linalg.norm(right))
    if size < 1e-6:  # on its side: nothing says which way is right
        return np.zeros((3, 2))
    right /= size
    return np.column_stack([np.cross(_UP, right), right])


def _rotation(vector: Array) -> Array:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def _vectors(rotations: Array) -> Array:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotations).as_rotvec())
