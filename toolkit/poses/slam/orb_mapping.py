"""How the map grows: its first two keyframes, and each that follows."""

from __future__ import annotations

import numpy as np

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.slam.local_adjustment import Observations, adjust_locally
from toolkit.poses.slam.orb_features import SCALE_FACTOR, Features, Indices
from toolkit.poses.slam.orb_map import OrbMap
from toolkit.poses.slam.orb_matching import match_along_lines, match_near
from toolkit.poses.slam.orb_tracker import Tracked
from toolkit.poses.slam.two_view import TwoViews, check_points, triangulate

#: Keyframes with which a new one makes points.
_PARTNERS = 4
#: Least baseline of such a pair, as a part of the median depth.
_BASELINE = 0.01
#: Largest cosine of the angle between the rays of a new point: one degree.
_PARALLAX_COSINE = float(np.cos(np.radians(1.0)))
#: Keyframes outside the window that hold an adjustment where it is.
_ANCHORS = 8
#: Pixels around a new point's prediction in other keyframes.
_FUSE = 3.0
#: A point must be found in this share of the frames that should see it.
_FOUND_SHARE = 0.25
#: Keyframes after which a point must be seen by three.
_TRIAL = 2
#: How far the ratio of distances may be from the ratio of pyramid levels.
_RATIO_SLACK = 1.5 * SCALE_FACTOR
_FIRST_STEPS, _STEPS = 20, 10


def first_map(
    numbers: tuple[int, int], features: tuple[Features, Features], matches: Indices, start: TwoViews
) -> OrbMap:
    """Return the map of two frames: ``matches`` (N, 2) are rows of their features. Median depth is one."""
    world = OrbMap()
    scale = 1.0 / float(np.median(start.points[:, 2]))
    second = RigidTransform(start.second_from_first.rotation, scale * start.second_from_first.translation)
    for number, found, pose in zip(numbers, features, (RigidTransform.identity(), second), strict=True):
        world.add_keyframe(number, found, pose)
    points = world.add_points(scale * start.points, 1)
    for place in (0, 1):
        world.observe(place, matches[start.matches, place], points)
    adjust_window(world, [1], [0], _FIRST_STEPS)
    world.remove(np.flatnonzero(world.alive & (world.observers < 2)))
    for place in (0, 1):
        world.refresh(place)
    return world


def insert_keyframe(
    world: OrbMap, camera: ColmapCamera, number: int, features: Features, tracked: Tracked, window: int
) -> int:
    """Add a tracked frame to the map, with the points that it brings, and adjust the last keyframes.

    Parameters
    ----------
    world:
        Changed in place.
    camera, number, features, tracked:
        The frame.
    window:
        Keyframes that an adjustment may move.

    Returns
    -------
    Place of the keyframe.
    """
    place = world.add_keyframe(number, features, tracked.pose)
    world.observe(place, tracked.rows, tracked.points)
    world.refresh(place)
    partners = [other for other in world.covisible(tracked.points, _PARTNERS + 1) if other != place][:_PARTNERS]
    depth = float(np.median(tracked.pose.apply(world.xyz[tracked.points])[:, 2]))
    for partner in partners:
        _make_points(world, place, partner, depth)
    _find_in_others(world, camera, place, partners)
    local = world.covisible(world.points_of([place]), window + _ANCHORS)
    moving, anchors = _window(world, place, local, window)
    adjust_window(world, moving, anchors, _STEPS)
    _cull(world, place)
    world.refresh(place)
    return place


def adjust_window(world: OrbMap, moving: list[int], anchors: list[int], steps: int) -> None:
    """Adjust keyframes ``moving`` and their points, with ``anchors`` fixed; cut what does not fit."""
    points = world.points_of(moving)
    rank = np.full(len(world.xyz) + 1, -1)
    rank[points] = np.arange(len(points))
    places = [*moving, *anchors]
    rows = [np.flatnonzero(rank[world.keyframes[place].point_of] >= 0) for place in places]
    seen = Observations(
        np.concatenate([np.full(len(row), k) for k, row in enumerate(rows)]),
        np.concatenate(
            [rank[world.keyframes[place].point_of[row]] for place, row in zip(places, rows, strict=True)]
        ),
        np.concatenate(
            [world.keyframes[place].features.plane[row] for place, row in zip(places, rows, strict=True)]
        ),
        np.concatenate(
            [world.keyframes[place].features.sigma[row] for place, row in zip(places, rows, strict=True)]
        ),
    )
    before = [world.keyframes[place].pose for place in places]
    poses, xyz, fits = adjust_locally(before, len(moving), world.xyz[points], seen, steps=steps)
    world.xyz[points] = xyz
    for k, place in enumerate(places):
        world.keyframes[place].pose = poses[k]
        world.forget(place, rows[k][~fits[seen.camera == k]])


def _window(world: OrbMap, place: int, local: list[int], window: int) -> tuple[list[int], list[int]]:
    """Return the keyframes that move, the new one among them, and those that stay: at least the oldest."""
    moving = [place, *(other for other in local if other != place)][:window]
    anchors = [other for other in local if other not in moving][:_ANCHORS]
    if not anchors:
        # One is enough: the scale does not run away, a damped solver takes no step along what it does not know. Two
        # would keep the error of the first motion, which is known from two pictures only.
        oldest = min(moving)
        moving.remove(oldest)
        anchors = [oldest]
    return moving, anchors


def _make_points(world: OrbMap, place: int, partner: int, depth: float) -> None:
    """Triangulate what a new keyframe and another one both see, and the map does not have yet."""
    mine, other = world.keyframes[place], world.keyframes[partner]
    other_from_mine = other.pose @ mine.pose.inverse()
    if np.linalg.norm(other_from_mine.translation) < _BASELINE * depth:
        return
    pairs = match_along_lines(
        mine.features,
        other.features,
        np.flatnonzero(mine.point_of < 0),
        np.flatnonzero(other.point_of < 0),
        other_from_mine,
    )
    if not len(pairs):
        return
    a, b = pairs[:, 0], pairs[:, 1]
    first, second = mine.features, other.features
    local = triangulate(other_from_mine, first.plane[a], second.plane[b])
    good, cosine = check_points(
        other_from_mine, local, first.plane[a], second.plane[b], first.sigma[a], second.sigma[b]
    )
    good &= cosine < _PARALLAX_COSINE
    with np.errstate(invalid="ignore"):
        distances = np.linalg.norm(local, axis=1) / np.linalg.norm(other_from_mine.apply(local), axis=1)
        ratio = distances / SCALE_FACTOR ** (second.octave[b] - first.octave[a]).astype(float)
        good &= (ratio < _RATIO_SLACK) & (ratio > 1 / _RATIO_SLACK)
    points = world.add_points(mine.pose.inverse().apply(local[good]), place)
    world.observe(place, a[good], points)
    world.observe(partner, b[good], points)
    world.refresh(partner)
    world.refresh(place)


def _find_in_others(world: OrbMap, camera: ColmapCamera, place: int, others: list[int]) -> None:
    """Look for the points of a new keyframe in others, among the features that have no point there."""
    points = world.points_of([place])
    for other in others:
        keyframe = world.keyframes[other]
        unseen = np.setdiff1d(points, keyframe.point_of, assume_unique=False)
        pixels, octave = world.predict(camera, keyframe.pose, unseen)
        things, rows = match_near(keyframe.features, world.descriptors[unseen], pixels, octave, _FUSE)
        free = keyframe.point_of[rows] < 0
        world.observe(other, rows[free], unseen[things[free]])


def _cull(world: OrbMap, place: int) -> None:
    """Remove points that turned out to be none: rarely found again, or seen by too few keyframes."""
    age = place - world.born
    rare = world.found < _FOUND_SHARE * world.visible
    few = (age >= _TRIAL) & (age <= _TRIAL + 1) & (world.observers < 3) & (world.born > 1)
    world.remove(np.flatnonzero(world.alive & (rare | few | (world.observers < 2))))
