"""From the unknowns of the adjustment on a circle back to a scene, with what there is to say of it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.circular_constraints import turn_coefficients
from toolkit.poses.circular_model import LOOSE, Observations, Ring, Unknowns, poses, residuals, rotation_vectors
from toolkit.poses.circular_result import CircularCamera, CircularResult
from toolkit.poses.circular_settings import CircularSettings
from toolkit.poses.circular_solver import noise_of
from toolkit.poses.circular_start import Chain
from toolkit.poses.circular_tracks import Sequence
from toolkit.scene import Points, Scene, Tracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# A noise this much above that of the poses that were given says that the circle does not fit.
_STALLED = 1.5
# An arc with a larger standard deviation is badly determined.
_LOOSE_ARC = 1.0
# Slacks with a root mean square this much above their standard deviation are no slacks.
_WIDE = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """What the adjustment left: the ring with its unknowns and their covariance, what was seen, how it came."""

    frames: Sequence
    chain: Chain
    seen: Observations
    points: Index
    ring: Ring
    unknowns: Unknowns
    covariance: Array | None
    noise: float
    seam_points: int
    offered: int
    costs: Mapping[str, tuple[float, ...]]
    converged: bool


def circular_result(scene: Scene, settings: CircularSettings, found: Adjusted, seconds: float) -> CircularResult:
    """Return the adjusted scene and its measures. ``scene`` is the one before."""
    ring, index = found.ring, found.frames.index
    sigma, cameras = _arc_sigma(found), _cameras(found)
    before = noise_before(scene, found)
    tilt = np.degrees(np.linalg.norm(rotation_vectors(ring.tilt), axis=1))
    result = CircularResult(
        scene=_scene(scene, found),
        names=tuple(scene.frames[i].name for i in index),
        angles=np.degrees(ring.angle),
        axis=np.array([0.0, 0.0, 1.0]),
        radius=found.chain.radius,
        start_angles=np.degrees(found.chain.angle),
        axial=ring.axial,
        radial=ring.radial,
        tilt_deg=tilt,
        arc_sigma=sigma,
        orientation_sigma=_orientation_sigma(found),
        closure_gap=_gap(settings, ring, index) if settings.full_turn else None,
        seam_points=found.seam_points,
        cameras=cameras,
        start_noise=before,
        noise=found.noise,
        observations=len(found.seen),
        observations_removed=found.offered - len(found.seen),
        costs=dict(found.costs),
        converged=found.converged,
        remarks=(),
        seconds=seconds,
    )
    return dataclasses.replace(result, remarks=tuple(_remarks(result, settings, len(scene.registered))))


def noise_before(scene: Scene, found: Adjusted) -> float:
    """Return the noise in pixels of the observations that are left, under the poses and points of ``scene``."""
    assert scene.points is not None
    frames, seen = found.frames, found.seen
    xyz = np.einsum(
        "nab,nb->na",
        frames.rotation[seen.frame],
        scene.points.xyz[found.points][seen.point] - frames.centre[seen.frame],
    )
    off = np.full((len(seen), 2), np.nan)
    for number, model in enumerate(frames.models):
        rows = (seen.camera == number) & (xyz[:, 2] > 0)
        off[rows] = np.asarray(model.to_pycolmap().img_from_cam(xyz[rows])).reshape(-1, 2) - seen.pixel[rows]
    return noise_of(off)


def _scene(scene: Scene, found: Adjusted) -> Scene:
    assert scene.points is not None
    scale = found.chain.radius
    rotation, centre = poses(found.ring, found.frames.camera)
    placed = {
        int(i): RigidTransform(turn, -scale * turn @ place)
        for i, turn, place in zip(found.frames.index, rotation, centre, strict=True)
    }
    frames = tuple(
        dataclasses.replace(frame, cam_from_world=placed.get(i), prior=None) for i, frame in enumerate(scene.frames)
    )
    error = np.linalg.norm(residuals(found.ring, found.seen), axis=1)
    starts = found.seen.starts
    mean = np.add.reduceat(error, starts) / np.diff(np.append(starts, len(error)))
    points = Points(
        scale * found.ring.points,
        scene.points.rgb[found.points],
        mean,
        Tracks(found.seen.point, found.frames.index[found.seen.frame], found.seen.pixel),
    )
    cameras = {**scene.cameras, **dict(zip(found.frames.camera_ids, found.ring.models, strict=True))}
    return scene.replace(frames=frames, cameras=cameras, points=points, georeference=None)


def _arc_sigma(found: Adjusted) -> float | None:
    if found.covariance is None:
        return None
    last = (len(found.ring.angle) - 1) * found.unknowns.of_frame
    block = found.covariance[np.ix_([0, last], [0, last])]
    return math.degrees(math.sqrt(max(float(block[0, 0] + block[1, 1] - 2 * block[0, 1]), 0.0)))


def _orientation_sigma(found: Adjusted) -> float | None:
    """Return the root mean square in degrees of what angle, mount and tilt of a frame together are off.

    With ``cam_from_world = E M Rz(-a)`` small changes e, m, da of them turn the camera by ``e + E m - E M z da``.
    """
    if found.covariance is None:
        return None
    ring, wide = found.ring, found.unknowns.of_frame
    at_mount, total = len(ring.angle) * wide, 0.0
    for frame, camera in enumerate(found.frames.camera.tolist()):
        mount = at_mount + 3 * camera
        columns = [*range(frame * wide, frame * wide + wide), *range(mount, mount + 3)]
        by = np.zeros((3, len(columns)))
        by[:, 0] = -(ring.tilt[frame] @ ring.mount[camera])[:, 2]
        if wide == LOOSE:
            by[:, 3:LOOSE] = np.eye(3)
        by[:, wide:] = ring.tilt[frame]
        total += float(np.trace(by @ found.covariance[np.ix_(columns, columns)] @ by.T))
    return math.degrees(math.sqrt(total / len(ring.angle)))


def _cameras(found: Adjusted) -> tuple[CircularCamera, ...]:
    made = []
    at_mount = len(found.ring.angle) * found.unknowns.of_frame
    at = at_mount + 3 * len(found.ring.models)
    for number, model in enumerate(found.ring.models):
        free = found.unknowns.free[number]
        sigma = mount_sigma = None
        if found.covariance is not None:
            mount = np.diagonal(found.covariance)[at_mount + 3 * number : at_mount + 3 * number + 3]
            mount_sigma = math.degrees(math.sqrt(float(mount.max())))
            values = np.zeros(len(model.params))
            values[list(free)] = np.sqrt(np.diagonal(found.covariance)[at : at + len(free)])
            sigma = tuple(values.tolist())
        at += len(free)
        before: ColmapCamera = found.frames.models[number]
        made.append(
            CircularCamera(
                found.frames.camera_ids[number], model.model, before.params, model.params, sigma, mount_sigma
            )
        )
    return tuple(made)


def _gap(settings: CircularSettings, ring: Ring, index: Index) -> float:
    """Return the distance along the circle between the ends of the known turn, as a part of the circumference."""
    turned = float(turn_coefficients(settings, index) @ ring.angle)
    return abs(turned - math.radians(settings.turn_angle)) / (2 * math.pi)


def _remarks(result: CircularResult, settings: CircularSettings, registered: int) -> list[str]:
    remarks = []
    if registered < len(result.scene):
        remarks.append(f"{len(result.scene) - registered} of {len(result.scene)} frames had no pose and have none")
    if result.noise > _STALLED * result.start_noise:
        tell = f"residuals are {result.noise:.2f} px on the circle and were {result.start_noise:.2f} px before"
        if settings.mode == "hard":
            remarks.append(f"the hard circle does not fit: {tell}; a camera that shakes needs the soft mode")
        else:
            remarks.append(f"the circle does not fit: {tell}; give it more slack, or look at the order of frames")
    if settings.mode == "soft":
        limits = {
            "axial": settings.axial_slack / 100,
            "radial": settings.radial_slack / 100,
            "orientation_deg": math.sqrt(3) * settings.orientation_slack,
        }
        for name, limit in limits.items():
            if result.slack_rms[name] > _WIDE * limit:
                setting = name.removesuffix("_deg") + "_slack"
                remarks.append(
                    f"cameras leave the circle by {result.slack_rms[name] / limit:.1f} times the {setting} that "
                    "was allowed: raise it, or the path is no circle"
                )
    if result.arc_sigma is None:
        remarks.append("the pictures leave some of the cameras' parameters open: keep what is calibrated")
    elif result.arc_sigma > _LOOSE_ARC:
        remarks.append(
            f"the arc is known to +- {result.arc_sigma:.1f} degrees only: an open arc needs calibrated cameras"
        )
    if not result.converged:
        remarks.append("the solver stopped before it converged: raise max_steps, or look at the order of frames")
    return remarks
