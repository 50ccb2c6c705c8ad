"""A simple monocular SLAM of our own: ORB features, PnP against a local map, local bundle adjustment.

It follows the plan of ORB-SLAM (Mur-Artal et al. 2015, "ORB-SLAM: a versatile and accurate monocular SLAM system")
without its loop closing, its relocalisation and its map merging: scale drifts on long flights, and where tracking
is lost a new segment begins.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.optional import require
from toolkit.poses.slam.local_adjustment import refine_pose
from toolkit.poses.slam.orb_features import Features, Indices, OrbExtractor, read_grey
from toolkit.poses.slam.orb_map import OrbMap
from toolkit.poses.slam.orb_mapping import first_map, insert_keyframe
from toolkit.poses.slam.orb_matching import match_anywhere
from toolkit.poses.slam.orb_tracker import Tracked, Tracker
from toolkit.poses.slam.result import SlamResult, SlamSegment
from toolkit.poses.slam.two_view import NoMotion, first_motion
from toolkit.progress import Progress, ProgressEvent
from toolkit.scene.timed_poses import TimedPoses
from toolkit.settings import Integer, Number, Settings

_STAGE = "slam.orb-pnp"
#: Share of the first frame's features below which the start is tried from a new first frame.
_MATCHED_SHARE = 0.15
#: Frames for which one first frame is tried.
_PATIENCE = 150


class OrbPnpSettings(Settings):
    """Monocular SLAM without loop closing."""

    features = Integer(1000, bounds=(100, 10000), unit="features", doc="Most ORB features of a frame.")
    fast_threshold = Integer(
        12, bounds=(2, 60), unit="grey levels", doc="How much a corner must differ from its surroundings."
    )
    start_matches = Integer(
        80, bounds=(20, 5000), unit="matches", doc="Fewest points of the first two views of a map."
    )
    start_parallax = Number(
        1.5, bounds=(0.1, 20.0), unit="degrees", doc="Least median angle between the rays of the first two views."
    )
    min_points = Integer(
        20, bounds=(8, 500), unit="points", doc="A frame that sees fewer points of the map is lost."
    )
    keyframe_interval = Integer(20, bounds=(1, 500), unit="frames", doc="Frames between two keyframes, at least.")
    keyframe_features = Integer(50, bounds=(8, 5000), unit="points", doc="Fewest points that a keyframe sees.")
    keyframe_shared = Number(
        90.0, bounds=(1.0, 100.0), unit="%", doc="A keyframe shares less of its points with the one before."
    )
    weak_shared = Number(
        60.0,
        bounds=(0.0, 100.0),
        unit="%",
        doc="A frame that shares less than this becomes a keyframe whatever the interval: tracking weakens.",
    )
    window = Integer(8, bounds=(2, 50), unit="keyframes", doc="Keyframes that one adjustment may move.")


class OrbPnp:
    """Monocular SLAM by ORB features and PnP; a :class:`~toolkit.poses.slam.result.SlamBackend`.

    Keyframes follow A-3DGS, section 3.2.1: 20 frames have passed, the frame sees 50 features of the map, and shares
    less than 90 % of the last keyframe's; and a frame that shares very few of them becomes one at once.
    """

    def __init__(self, settings: OrbPnpSettings | None = None) -> None:
        self._settings = (settings or OrbPnpSettings()).frozen()

    @property
    def name(self) -> str:
        """``orb-pnp``."""
        return "orb-pnp"

    def track(
        self,
        pictures: Sequence[Path],
        times: NDArray[np.float64],
        camera: ColmapCamera,
        *,
        seed: int,
        progress: Progress,
        work_dir: Path,
    ) -> SlamResult:
        """Track all frames; parameters as for :meth:`toolkit.poses.slam.result.SlamBackend.track`.

        The same pictures, settings and seed give the same result on the same machine. Nothing is written to
        ``work_dir``.

        Raises
        ------
        DataError
            Where pictures and times do not belong together, times do not increase, or a picture is missing, damaged
            or not of the camera's size.
        MissingDependencyError
            Without OpenCV.
        """
        started = time.perf_counter()
        _check(pictures, times)
        require("cv2").setRNGSeed(seed)
        run = _Run(self._settings, camera, seed)
        frame_seconds = np.zeros(len(pictures))
        progress(ProgressEvent(_STAGE, 0, len(pictures)))
        for number, path in enumerate(pictures):
            begun = time.perf_counter()
            run.take(number, read_grey(path, camera))
            frame_seconds[number] = time.perf_counter() - begun
            progress(ProgressEvent(_STAGE, number + 1, len(pictures), run.state))
        run.finish(len(pictures))
        return SlamResult(
            self.name,
            tuple(segment.result(times) for segment in run.segments),
            len(pictures),
            frame_seconds,
            time.perf_counter() - started,
            tuple(run.notes),
        )


@dataclass(frozen=True, eq=False)
class _Found:
    """A frame that is no keyframe: its pose relative to one, and the points that it saw, where and how exactly."""

    place: int
    cam_from_keyframe: RigidTransform
    points: Indices
    plane: NDArray[np.float64]
    sigma: NDArray[np.float64]


class _Segment:
    """A map and the frames that were found in it."""

    def __init__(self, world: OrbMap, least: int) -> None:
        self.world = world
        self._least = least
        self._frames: dict[int, _Found] = {}

    def add(self, number: int, features: Features, found: Tracked, place: int) -> None:
        """Keep a frame, relative to a keyframe, with which it moves when the map is adjusted."""
        cam_from_keyframe = found.pose @ self.world.keyframes[place].pose.inverse()
        plane, sigma = features.plane[found.rows], features.sigma[found.rows]
        self._frames[number] = _Found(place, cam_from_keyframe, found.points, plane, sigma)

    def pose(self, number: int) -> RigidTransform:
        """Return the pose of a frame in the map as it is now, which knows more than when the frame was tracked."""
        found = self._frames[number]
        pose = found.cam_from_keyframe @ self.world.keyframes[found.place].pose
        left = np.flatnonzero(self.world.alive[found.points])
        if len(left) < self._least:
            return pose
        refined, inlier = refine_pose(
            pose, self.world.xyz[found.points[left]], found.plane[left], found.sigma[left]
        )
        return refined if inlier.sum() >= self._least else pose

    def result(self, times: NDArray[np.float64]) -> SlamSegment:
        """Return all poses in the map as it ended."""
        poses = {keyframe.number: keyframe.pose for keyframe in self.world.keyframes}
        keys = np.array(sorted(poses))
        keyframes = TimedPoses(times[keys], tuple(poses[int(number)] for number in keys))
        poses |= {number: self.pose(number) for number in self._frames}
        numbers = np.array(sorted(poses))
        frames = TimedPoses(times[numbers], tuple(poses[int(number)] for number in numbers))
        return SlamSegment(keyframes, keys, frames, numbers)


class _Run:
    """What is known between two frames."""

    def __init__(self, settings: OrbPnpSettings, camera: ColmapCamera, seed: int) -> None:
        self._settings, self._camera = settings, camera
        self._extract = OrbExtractor(camera, settings.features, settings.fast_threshold)
        self._tracker = Tracker(camera, settings.min_points, seed)
        self.segments: list[_Segment] = []
        self.notes: list[str] = []
        self.state = ""
        self._segment: _Segment | None = None
        self._waiting: list[tuple[int, Features]] = []  # frames that have no map yet
        self._waiting_since, self._reason = 0, ""
        self._velocity = RigidTransform.identity()
        self._last_pose = RigidTransform.identity()
        self._last_points: Indices = np.zeros(0, np.int64)

    def take(self, number: int, grey: NDArray[np.uint8]) -> None:
        """Track one frame."""
        features = self._extract(grey)
        if self._segment is None:
            self._start(number, features)
        else:
            self._follow(self._segment, number, features)

    def finish(self, frames: int) -> None:
        """Say what was left without a pose."""
        if self._segment is None:
            self._note_gap(frames)

    def _note_gap(self, end: int) -> None:
        if end > self._waiting_since:
            self.notes.append(f"Frames {self._waiting_since} to {end - 1} have no pose: {self._reason}.")

    def _start(self, number: int, features: Features) -> None:
        """Try to begin a map with this frame and the first of those that wait."""
        least = self._settings.start_matches
        self.state = "no map yet"
        if len(features) < least:
            self._reason = f"{len(features)} features in frame {number}, {least} needed"
            self._waiting = []
            return
        if not self._waiting:
            self._waiting = [(number, features)]
            self._reason = self._reason or "no second view"
            return
        first_number, first = self._waiting[0]
        matches = match_anywhere(first.descriptors, features.descriptors)
        a, b = matches[:, 0], matches[:, 1]
        start = first_motion(
            first.plane[a],
            features.plane[b],
            first.sigma[a],
            features.sigma[b],
            least=least,
            min_parallax_deg=self._settings.start_parallax,
        )
        if isinstance(start, NoMotion):
            self._reason = start.reason
            few = len(matches) < max(least, _MATCHED_SHARE * len(first))
            self._waiting = [] if few or len(self._waiting) >= _PATIENCE else self._waiting
            self._waiting.append((number, features))
            return
        world = first_map((first_number, number), (first, features), matches, start)
        if int(world.alive.sum()) < least // 2:
            self._reason = f"{int(world.alive.sum())} points were left of the first map"
            self._waiting.append((number, features))
            return
        self._begin(world, number)

    def _begin(self, world: OrbMap, number: int) -> None:
        """Begin a segment; the frames between the first two keyframes are found in the new map."""
        self._segment = _Segment(world, self._settings.min_points)
        self.segments.append(self._segment)
        self._note_gap(self._waiting[0][0])
        self._last_pose = world.keyframes[1].pose
        self._last_points = world.points_of([1])
        self._velocity = RigidTransform.identity()
        pose = self._last_pose
        for between, features in reversed(self._waiting[1:]):
            found = self._tracker.track(world, features, pose, self._last_points)
            if isinstance(found, Tracked):
                self._segment.add(between, features, found, 1)
                if between == number - 1:
                    self._velocity = self._last_pose @ found.pose.inverse()
                pose = found.pose
        self._waiting = []
        self.state = f"{int(world.alive.sum())} points"

    def _follow(self, segment: _Segment, number: int, features: Features) -> None:
        """Find a frame in the map, and make it a keyframe where it is time."""
        world = segment.world
        found = self._tracker.track(world, features, self._velocity @ self._last_pose, self._last_points)
        if not isinstance(found, Tracked):
            self.notes.append(
                f"Tracking was lost at frame {number}: {found} points of the map found, "
                f"{self._settings.min_points} needed."
            )
            self._segment, self._reason, self._waiting_since = None, "", number
            self._start(number, features)
            return
        self._velocity = found.pose @ self._last_pose.inverse()
        self._last_pose, self._last_points = found.pose, found.points
        if self._is_keyframe(world, number, found.points):
            place = insert_keyframe(world, self._camera, number, features, found, self._settings.window)
            self._last_pose, self._last_points = world.keyframes[place].pose, world.points_of([place])
        else:
            segment.add(number, features, found, len(world.keyframes) - 1)
        self.state = f"{len(found.points)} points"

    def _is_keyframe(self, world: OrbMap, number: int, points: Indices) -> bool:
        """Return whether a frame that sees ``points`` is to be a keyframe (A-3DGS, section 3.2.1)."""
        last = world.keyframes[-1]
        if len(points) < self._settings.keyframe_features:
            return False
        known = world.points_of([len(world.keyframes) - 1])
        trusted = known[world.observers[known] >= min(3, len(world.keyframes))]
        shared = 100 * len(np.intersect1d(points, trusted)) / max(len(trusted), 1)
        passed = number - last.number >= self._settings.keyframe_interval
        return (passed and shared < self._settings.keyframe_shared) or shared < self._settings.weak_shared


def _check(pictures: Sequence[Path], times: NDArray[np.float64]) -> None:
    if np.shape(times) != (len(pictures),) or not len(pictures):
        raise DataError(
            "Pictures and times do not belong together",
            expected="at least one picture, and a time for each",
            found=f"{len(pictures)} pictures and times {np.shape(times)}",
        )
    bad = np.flatnonzero(~(np.diff(times) > 0))
    if not np.isfinite(times).all() or len(bad):
        found = f"{times[bad[0] + 1]} after {times[bad[0]]}" if len(bad) else str(times)
        raise DataError(
            "The frames of a video must be in order of time",
            expected="finite seconds that increase",
            found=found,
            todo="Sort the pictures by their times",
        )
