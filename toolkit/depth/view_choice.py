"""Which pictures each picture is compared with, and between which depths, told by the sparse points."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.stereo_settings import ViewChoiceSettings
from toolkit.scene import Frame, Scene, Tracks

Array = NDArray[np.float64]

# Widths of the preference for an angle, below and above it, in shares of it (Yao et al. 2018, ECCV, eq. 5).
_BELOW, _ABOVE = 0.3, 1.0
# Points without tracks hide each other in cells of so many to the width, where their depths differ by this factor.
_CELLS, _HIDDEN = 40, 1.15
_RANGE_PERCENTILES = (1.0, 99.0)


@dataclass(frozen=True, slots=True)
class ViewChoice:
    """Sources and depth range of a frame.

    Attributes
    ----------
    name:
        Of the frame.
    sources:
        Names of its source views, best first; empty where there is none.
    depth_range:
        Nearest and farthest z, or None.
    points:
        How many points it sees.
    reason:
        Why it has no source or range; empty where it has both.
    """

    name: str
    sources: tuple[str, ...]
    depth_range: tuple[float, float] | None
    points: int
    reason: str = ""

    def __bool__(self) -> bool:
        return bool(self.sources) and self.depth_range is not None


def seen_points(scene: Scene) -> dict[str, NDArray[np.int64]]:
    """Return for each registered frame, by its name, which points it sees: rows in ascending order.

    Where there are no tracks, those that project into the picture and are not far behind another one nearby.
    """
    points = scene.points
    frames = scene.registered
    if points is None or len(points) == 0:
        return {frame.name: np.zeros(0, np.int64) for frame in frames}
    tracks = points.tracks
    if tracks is not None and len(tracks.point):
        place = {frame.name: number for number, frame in enumerate(scene.frames)}
        order = np.argsort(tracks.frame, kind="stable")
        ends = np.searchsorted(tracks.frame[order], np.arange(len(scene.frames) + 1))
        rows = {
            frame.name: np.unique(tracks.point[order[ends[place[frame.name]] : ends[place[frame.name] + 1]]])
            for frame in frames
        }
        return {name: _in_front(scene, scene.frame(name), found) for name, found in rows.items()}
    return {frame.name: _not_hidden(scene, frame) for frame in frames}


def with_tracks(scene: Scene) -> Scene:
    """Return the scene with tracks: its own, or where it has none, :func:`seen_points` and their projections.

    COLMAP's fusion finds in them which pictures overlap.
    """
    points = scene.points
    if points is None or (points.tracks is not None and len(points.tracks.point)):
        return scene
    place = {frame.name: number for number, frame in enumerate(scene.frames)}
    rows, frames, pixels = [], [], []
    for name, seen in seen_points(scene).items():
        frame = scene.frame(name)
        assert frame.cam_from_world is not None
        rows.append(seen)
        frames.append(np.full(len(seen), place[name], np.int64))
        pixels.append(scene.camera_of(frame).project(frame.cam_from_world.apply(points.xyz[seen])))
    if not rows:
        return scene
    tracks = Tracks(np.concatenate(rows), np.concatenate(frames), np.concatenate(pixels))
    return scene.replace(points=dataclasses.replace(points, tracks=tracks))


def _in_front(scene: Scene, frame: Frame, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    assert scene.points is not None
    assert frame.cam_from_world is not None
    return rows[frame.cam_from_world.apply(scene.points.xyz[rows])[:, 2] > 0]


def _not_hidden(scene: Scene, frame: Frame) -> NDArray[np.int64]:
    assert scene.points is not None
    assert frame.cam_from_world is not None
    camera = scene.camera_of(frame)
    in_camera = frame.cam_from_world.apply(scene.points.xyz)
    pixel = camera.project(in_camera)
    inside = np.flatnonzero(((pixel >= 0) & (pixel < (camera.width, camera.height))).all(axis=1))
    cell = np.floor(pixel[inside] * (_CELLS / camera.width)).astype(np.int64)
    number = cell[:, 1] * _CELLS + cell[:, 0]
    nearest = np.full(number.max(initial=0) + 1, np.inf)
    np.minimum.at(nearest, number, in_camera[inside, 2])
    return inside[in_camera[inside, 2] <= _HIDDEN * nearest[number]]


def choose_views(scene: Scene, settings: ViewChoiceSettings, margin: float) -> tuple[ViewChoice, ...]:
    """Return sources and depth range of each registered frame.

    A view's score is the sum, over the points that both see, of a preference for triangulation angles near
    ``settings.best_angle`` (Yao et al. 2018, ECCV, eq. 5), so that overlap counts as well as angle. The range is
    that of the depths of the frame's points without the outermost percent, wider by ``margin`` percent.

    Parameters
    ----------
    scene:
        With poses and points.
    margin:
        In percent of the range's ends.
    """
    seen = seen_points(scene)
    return tuple(_choose(scene, frame, seen, settings, margin) for frame in scene.registered)


def _choose(
    scene: Scene,
    frame: Frame,
    seen: dict[str, NDArray[np.int64]],
    settings: ViewChoiceSettings,
    margin: float,
) -> ViewChoice:
    mine = seen[frame.name]
    if len(mine) < settings.min_shared:
        return ViewChoice(
            frame.name,
            (),
            None,
            len(mine),
            f"it sees only {len(mine)} of the scene's points, {settings.min_shared} are needed",
        )
    assert scene.points is not None
    assert frame.cam_from_world is not None
    depths = frame.cam_from_world.apply(scene.points.xyz[mine])[:, 2]
    low, high = np.percentile(depths, _RANGE_PERCENTILES)
    ends = (float(low / (1 + margin / 100)), float(high * (1 + margin / 100)))
    scores: list[tuple[float, str]] = []
    for other in scene.registered:
        if other.name == frame.name:
            continue
        shared = np.intersect1d(mine, seen[other.name], assume_unique=True)
        if len(shared) < settings.min_shared:
            continue
        angles = triangulation_angles(frame, other, scene.points.xyz[shared])
        if settings.min_angle <= float(np.median(angles)) <= settings.max_angle:
            scores.append((float(_preference(angles, settings.best_angle).sum()), other.name))
    scores.sort(key=lambda item: (-item[0], item[1]))
    names = tuple(name for _, name in scores[: settings.views])
    reason = (
        ""
        if names
        else (
            f"no other picture shares {settings.min_shared} points with it at a median angle of "
            f"{settings.min_angle:g} to {settings.max_angle:g} degrees"
        )
    )
    return ViewChoice(frame.name, names, ends, len(mine), reason)


def triangulation_angles(frame: Frame, other: Frame, xyz: Array) -> Array:
    """Return the angles (n,) in degrees under which the rays of two frames meet at points (n, 3)."""
    assert frame.cam_from_world is not None
    assert other.cam_from_world is not None
    a, b = xyz - frame.cam_from_world.centre, xyz - other.cam_from_world.centre
    cosine = (a * b).sum(axis=1) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-300)
    angles: Array = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return angles


def _preference(angles: Array, best: float) -> Array:
    width = np.where(angles < best, _BELOW, _ABOVE) * best
    preference: Array = np.exp(-((angles - best) ** 2) / (2 * width**2))
    return preference
