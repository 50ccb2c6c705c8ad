"""A camera that circles a ring of blades: points, tracks and true poses, and drifted reconstructions of it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Frame, Points, Scene, Tracks

Array = NDArray[np.float64]

RADIUS = 0.35
CAMERA = ColmapCamera("OPENCV_FISHEYE", 480, 360, (262.0, 261.0, 243.5, 177.0, 0.045, -0.021, 0.006, -0.002))
# How the camera hangs on the ring: it looks along the axis at the blades, tilted outwards and along the ring.
MOUNT = Rotation.from_euler("xyz", [14.0, 9.0, 3.0], degrees=True) * Rotation.from_matrix(
    [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
)


@dataclass(frozen=True)
class RingSample:
    """The true scene, with pixels off by noise; ``angles`` in degrees from the first frame."""

    scene: Scene
    angles: Array


def ring_sample(
    frames: int = 120,
    *,
    turn: float = 360.0,
    shake: float = 0.0,
    orientation_shake: float = 0.0,
    noise: float = 0.4,
    points_a_blade: int = 12,
    blades: int = 90,
    wrong: float = 0.0,
    seam: bool = True,
    seed: int = 0,
) -> RingSample:
    """Return frames over ``turn`` degrees, the last one step before its end, at a speed that varies by a tenth.

    Parameters
    ----------
    frames, turn:
        Of the camera.
    shake:
        Standard deviation along the axis and of the radius, as parts of the radius.
    orientation_shake, noise:
        Standard deviations in degrees and pixels.
    points_a_blade, blades:
        On blades all around, each twisted.
    wrong:
        Part of the observations that are tens of pixels off.
    seam:
        Whether points keep their track across the end of the turn.
    seed:
        Of all draws.
    """
    rng = np.random.default_rng(seed)
    steps = 1.0 + 0.1 * np.sin(np.linspace(0.0, 14.0, frames)) + 0.03 * rng.standard_normal(frames)
    angles = np.concatenate([[0.0], np.cumsum(turn * steps / steps.sum())])[:-1]
    poses = _poses(angles, shake, orientation_shake, rng)
    xyz = _blades(blades, points_a_blade, rng)
    rows = []
    for i, pose in enumerate(poses):
        pixel = CAMERA.project(pose.apply(xyz))
        seen = np.isfinite(pixel).all(axis=1) & (pixel >= 4).all(axis=1) & (pixel < [476, 356]).all(axis=1)
        number = np.flatnonzero(seen)
        rows.append(np.column_stack([number, np.full(len(number), i), pixel[number]]))
    table = np.concatenate(rows)
    point, frame = table[:, 0].astype(int), table[:, 1].astype(int)
    pixel = table[:, 2:] + noise * rng.standard_normal((len(table), 2))
    bad = rng.random(len(table)) < wrong
    pixel[bad] += rng.uniform(-40, 40, (int(bad.sum()), 2))
    keep = rng.random(len(table)) > 0.15
    point, frame, pixel = point[keep], frame[keep], pixel[keep]
    if not seam:
        point, xyz = _without_seam(point, frame, xyz, frames)
    used, point = np.unique(point, return_inverse=True)
    rgb = np.full((len(used), 3), 128, dtype=np.uint8)
    made = Points(xyz[used], rgb, tracks=Tracks(point, frame, pixel))
    named = tuple(Frame(f"{i:04d}.png", 1, pose) for i, pose in enumerate(poses))
    return RingSample(Scene(Path("images"), {1: CAMERA}, named, made), angles)


def drifted(
    sample: RingSample,
    *,
    turn: float = 300 / 360,
    climb: float = 0.15,
    shrink: float = 0.8,
    lean: float = 8.0,
    focal: float = 1.06,
    seed: int = 1,
) -> Scene:
    """Return the reconstruction that a wrong lens would give: every step a little wrong, and so a spiral.

    Parameters
    ----------
    sample:
        The truth.
    turn:
        Found over true angle of each step.
    climb:
        How far the path climbs along its axis in all, in radii.
    shrink:
        Scale at the end, 1 at the start.
    lean:
        Degrees by which the axis leans over the whole.
    focal:
        Found over true focal length; the found distortion is none.
    seed:
        Of small errors of single frames.
    """
    rng = np.random.default_rng(seed)
    assert sample.scene.points is not None
    tracks = sample.scene.points.tracks
    assert tracks is not None
    part = sample.angles / sample.angles[-1]
    poses, local = [], []
    for frame, angle, along in zip(sample.scene.frames, sample.angles, part, strict=True):
        assert frame.cam_from_world is not None
        lost = Rotation.from_euler("zx", [(turn - 1) * angle, lean * along], degrees=True).as_matrix()
        scale = 1.0 + (shrink - 1.0) * along
        wobble = Rotation.from_rotvec(np.radians(0.03) * rng.standard_normal(3)).as_matrix()
        rotation = wobble @ frame.cam_from_world.rotation @ lost.T
        centre = scale * lost @ frame.cam_from_world.centre + [0.0, 0.0, RADIUS * climb * along]
        poses.append(RigidTransform(rotation, -rotation @ centre))
        local.append(scale)
    xyz = sample.scene.points.xyz.copy()
    first = np.unique(tracks.point, return_index=True)[1]
    for point, row in enumerate(first):
        i = int(tracks.frame[row])
        pose = sample.scene.frames[i].cam_from_world
        assert pose is not None
        xyz[point] = poses[i].inverse().apply(local[i] * pose.apply(xyz[point]))
    fx, fy, cx, cy = CAMERA.params[:4]
    lens = dataclasses.replace(CAMERA, params=(focal * fx, focal * fy, cx - 3.5, cy + 3.0, 0.0, 0.0, 0.0, 0.0))
    frames = tuple(
        dataclasses.replace(f, cam_from_world=p) for f, p in zip(sample.scene.frames, poses, strict=True)
    )
    points = dataclasses.replace(sample.scene.points, xyz=xyz)
    return sample.scene.replace(frames=frames, cameras={1: lens}, points=points)


def _poses(angles: Array, shake: float, orientation_shake: float, rng: np.random.Generator) -> list[RigidTransform]:
    poses = []
    for angle in angles:
        off = RADIUS * shake * rng.standard_normal(2)
        place = np.array([RADIUS + off[0], 0.0, off[1]])
        turned = Rotation.from_euler("z", -angle, degrees=True)
        tilt = Rotation.from_rotvec(np.radians(orientation_shake) * rng.standard_normal(3))
        rotation = (tilt * MOUNT * turned).as_matrix()
        poses.append(RigidTransform(rotation, -rotation @ turned.inv().apply(place)))
    return poses


def _blades(blades: int, count: int, rng: np.random.Generator) -> Array:
    """Points on twisted blades that stand on a hub, 0.1 to 0.2 m in front of the camera's plane."""
    number = np.repeat(np.arange(blades), count)
    height = rng.uniform(0.0, 1.0, len(number))
    depth = rng.uniform(0.0, 1.0, len(number))
    radius = 0.30 + 0.15 * height
    angle = 2 * np.pi * number / blades + (0.02 + 0.03 * height) * depth
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0.13 + 0.05 * depth])


def _without_seam(point: Array, frame: Array, xyz: Array, frames: int) -> tuple[Array, Array]:
    """Give points that both ends see two numbers, one for each end."""
    late = frame >= frames // 2
    both = np.intersect1d(point[(frame < frames // 4)], point[frame >= frames - frames // 4])
    split = late & np.isin(point, both)
    return np.where(split, point + len(xyz), point), np.concatenate([xyz, xyz])
