"""Rounds of making points from tracks and adjusting everything, ever tighter."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.feature_choice import FeatureSettings
from toolkit.matching.match_tracks import match_tracks
from toolkit.matching.pairs import PairSettings
from toolkit.poses.adjust import AdjustmentReport, adjust, focal_sigma, residual_noise
from toolkit.poses.feedforward.depth_fit import DepthFitSettings
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.tracks import depth_scales, points_from_depth, residuals
from toolkit.poses.thin import thin_points
from toolkit.poses.triangulation import triangulate, triangulation_options
from toolkit.progress import Progress, ProgressEvent
from toolkit.scene import Points, Scene, Tracks, scene_from_pycolmap
from toolkit.settings import Choice, Group, Integer, Number, Settings

Array = NDArray[np.float64]

# Errors left by a coarse round are smaller than this many standard deviations of its residuals.
_REACH = 6.0
# A round that does not halve the error is followed by one that asks for half of it.
_SLOWEST = 0.5
# A coarse round needs no more points a picture than these: poses are far from their accuracy.
_COARSE_POINTS = 200
# As many pictures have to see a point.
_LEAST_PICTURES = 2


class TrackAdjustSettings(Settings):
    """Bundle adjustment on matched features."""

    points = Choice(
        "triangulated",
        choices=("triangulated", "depth"),
        doc="Points begin where rays meet, or where predicted depth puts them: better where rays are nearly "
        "parallel.",
    )
    intrinsics = Choice(
        "fixed",
        choices=("fixed", "shared", "each"),
        doc="Focal lengths: as predicted; found, one for all pictures of a size; found for each picture.",
    )
    rounds = Integer(
        4, bounds=(1, 10), doc="At most so often are points made anew and everything adjusted, ever tighter."
    )
    pose_error = Number(
        5.0,
        bounds=(0.1, 45.0),
        unit="degrees",
        doc="Rays that miss a point by more are not used in the first round: the error of the predicted cameras.",
    )
    max_error = Number(2.0, bounds=(0.1, 100.0), unit="px", doc="The same in the last round, in pixels.")
    min_angle = Number(
        1.0, bounds=(0.0, 45.0), unit="degrees", doc="Points whose rays meet under a smaller angle are left out."
    )
    min_points = Integer(
        10, bounds=(3, 10000), unit="points", doc="Pictures that see fewer points at the end lose their pose."
    )
    min_matches = Integer(15, bounds=(6, 1000), unit="matches", doc="Pairs with fewer inliers are not used.")
    features = Group(FeatureSettings(), doc="Features and their matching.")
    pairs = Group(PairSettings(), doc="Which pictures are matched.")
    depth = Group(DepthFitSettings(), doc="How the prediction's depth follows the adjusted points.")
    threads = Integer(0, bounds=(0, 256), doc="Threads of the solver; 0: as many as there are cores.")


class TrackRounds:
    """Makes points and adjusts, round by round."""

    def __init__(
        self,
        start: Scene,
        prediction: Prediction,
        database: Path,
        settings: TrackAdjustSettings,
        seed: int,
        progress: Progress,
        work_dir: Path,
    ) -> None:
        self.reports: list[AdjustmentReport] = []
        self.focal_sigma: float | None = None
        self._scene, self._prediction, self._database = start, prediction, database
        self._settings, self._seed, self._progress, self._work_dir = settings, seed, progress, work_dir
        cameras = [camera for camera in start.cameras.values() if isinstance(camera, ColmapCamera)]
        self._focal = float(np.median([camera.params[:2] for camera in cameras]))
        self._xyz: Array | None = None
        self._rows = np.zeros(0, dtype=np.int64)
        if settings.points == "depth":
            self._tracks = match_tracks(database, start)
            self._count = int(self._tracks.point.max()) + 1

    def run(self) -> Scene:
        """Return the adjusted scene."""
        settings = self._settings
        limit = max(self._focal * math.tan(math.radians(settings.pose_error)), settings.max_error)
        for number in range(settings.rounds):
            final = number == settings.rounds - 1 or limit <= settings.max_error
            limit = settings.max_error if final else limit
            model = self._points(limit)
            if not final and settings.points == "triangulated":
                thin_points(model, _COARSE_POINTS)
            self._adjust(model, limit, first=number == 0 and not final)
            if settings.points == "depth":
                self._remember(model)
            if final and settings.intrinsics != "fixed":
                self.focal_sigma = focal_sigma(model, refine_distortion=False, refine_principal_point=False)
            self._scene = scene_from_pycolmap(model, self._scene.image_dir, like=self._scene)
            if final:
                break
            limit = max(min(_REACH * residual_noise(model), _SLOWEST * limit), settings.max_error)
        return self._scene

    def _adjust(self, model: pycolmap.Reconstruction, limit: float, *, first: bool) -> None:
        settings = self._settings

        def told() -> None:
            self._progress(ProgressEvent("feedforward.tracks", len(self.reports), settings.rounds))

        # Poses that are still coarse would be taken for another focal length.
        free = settings.intrinsics != "fixed" and not first
        report = adjust(
            model,
            refine_focal=free,
            refine_distortion=False,
            refine_principal_point=False,
            max_error=limit,
            min_angle=settings.min_angle,
            threads=settings.threads,
            check_cancelled=told,
        )
        self.reports.append(report)
        told()

    def _points(self, limit: float) -> pycolmap.Reconstruction:
        """Return the poses so far with points whose observations are within ``limit`` pixels."""
        settings = self._settings
        if settings.points == "depth":
            model = self._from_depth(limit)
        else:
            options = triangulation_options(
                degrees=math.degrees(math.atan(limit / self._focal)),
                pixels=limit,
                min_angle=settings.min_angle,
                seed=self._seed,
                min_matches=settings.min_matches,
                threads=settings.threads,
                adjusted=True,
            )
            model = triangulate(
                self._scene, self._database, options, progress=self._progress, work_dir=self._work_dir
            )
        if model.num_points3D() < settings.min_points:
            raise StageError(
                "Too few matches agree with the predicted cameras",
                expected=f"at least {settings.min_points} points within {limit:.1f} px",
                found=f"{model.num_points3D()}",
                todo="Raise pose_error, match more features, or look at the prediction",
            )
        return model

    def _from_depth(self, limit: float) -> pycolmap.Reconstruction:
        """Return tracks with points as they were adjusted, or else from depth, and the observations that agree."""
        tracks, count = self._tracks, self._count
        scales = np.ones(len(self._prediction))
        if self._xyz is not None:
            found = depth_scales(self._scene, self._prediction, tracks, self._xyz)
            scales = np.where(np.isfinite(found), found, 1.0)
        xyz = points_from_depth(self._scene, self._prediction, tracks, count, scales)
        if self._xyz is not None:
            xyz = np.where(np.isfinite(self._xyz), self._xyz, xyz)
        near = residuals(self._scene, tracks, xyz) <= limit
        near &= (np.bincount(tracks.point[near], minlength=count) >= _LEAST_PICTURES)[tracks.point]
        self._rows, number = np.unique(tracks.point[near], return_inverse=True)
        points = Points(
            xyz[self._rows],
            np.zeros((len(self._rows), 3), dtype=np.uint8),
            tracks=Tracks(number.astype(np.int64), tracks.frame[near], tracks.pixel[near]),
        )
        model = self._scene.replace(points=points).to_pycolmap()
        model.extract_colors_for_all_images(self._scene.image_dir)
        return model

    def _remember(self, model: pycolmap.Reconstruction) -> None:
        """Keep where the adjustment put the tracks' points; those that it removed begin from depth again."""
        self._xyz = np.full((self._count, 3), np.nan)
        for number, point in model.points3D.items():
            self._xyz[self._rows[number - 1]] = point.xyz
