"""Rounds of triangulation and adjustment that take sensor poses to the accuracy of the pictures."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap

from toolkit.errors import Cancelled, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.poses.adjust import AdjustmentReport, adjust, position_priors, residual_noise
from toolkit.poses.resection import Resection, place_by_points
from toolkit.poses.sensor_biases import correct, estimate_biases
from toolkit.poses.sensors import SensorPoseSettings
from toolkit.poses.thin import thin_points
from toolkit.poses.triangulation import triangulation_options
from toolkit.progress import ProgressEvent
from toolkit.scene import Frame, Scene, scene_from_pycolmap
from toolkit.settings import Boolean, Integer, Number

# Errors left by a coarse round are smaller than this many standard deviations of its residuals.
_REACH = 6.0
# A coarse round needs no more points a picture than these: poses are far from their accuracy.
_COARSE_POINTS = 100
# A round that does not halve the error is followed by one that asks for half of it.
_SLOWEST = 0.5


class SensorSfmSettings(SensorPoseSettings):
    """Poses from sensors, refined by the pictures."""

    correct_turns = Boolean(
        True,
        doc="Photos that were turned by a multiple of 90 degrees after they were taken get a pose that is turned "
        "too; no: they are only reported.",
    )
    rounds = Integer(
        4,
        bounds=(1, 10),
        doc="At most so often are points triangulated anew and everything adjusted, ever tighter; it ends with "
        "the first round whose limit is max_error, usually the second.",
    )
    first_error = Number(
        8.0,
        bounds=(0.1, 45.0),
        unit="degrees",
        doc="Rays that miss a point by more are not used in the first round: the error of the sensor poses.",
    )
    max_error = Number(4.0, bounds=(0.1, 100.0), unit="px", doc="The same in the last round, in pixels.")
    min_angle = Number(
        1.5, bounds=(0.0, 45.0), unit="degrees", doc="Points whose rays meet under a smaller angle are removed."
    )
    min_points = Integer(
        15, bounds=(6, 10000), unit="points", doc="Frames that see fewer points at the end lose their pose."
    )
    distrust = Boolean(True, doc="Readings that the pictures contradict are not used; no: they are only reported.")
    place_others = Boolean(
        True, doc="Frames without usable readings are placed by the points that their matches belong to."
    )
    estimate_biases = Boolean(
        True,
        doc="Find constant errors of the sensors (heading, boresight, time offset, lever arm) after the first "
        "round, and take time offset and lever arm out of the positions that hold the rounds that follow, where "
        "they are significant; attitudes are only a start and stay as they are. No: all are only reported.",
    )
    min_matches = Integer(15, bounds=(6, 1000), unit="matches", doc="Pairs with fewer inliers are not used.")
    refine_focal = Boolean(True, doc="Find the focal length; no: keep that of the scene's cameras.")
    square_pixels = Boolean(
        True,
        doc="A pinhole camera that starts with two equal focal lengths keeps them equal: flights in circles hardly "
        "tell one of them from the tilt of the camera.",
    )
    refine_distortion = Boolean(True, doc="Find the distortion; no: keep that of the scene's cameras.")
    refine_principal_point = Boolean(
        True, doc="Find the principal point in the last round, where the pictures determine it."
    )
    threads = Integer(0, bounds=(0, 256), doc="Threads of the solver; 0: as many as there are cores.")


class Refinement:
    """Triangulates and adjusts, round by round, in COLMAP's thread.

    Attributes
    ----------
    reports:
        What each adjustment did, so far.
    others:
        The frames without readings, and what points said of them.
    scene:
        The scene with readings as they are used: from the second round on with corrected positions.

    Parameters
    ----------
    turns:
        Degrees by which pictures are turned clockwise against their cameras, by name, where they are.
    """

    def __init__(
        self,
        scene: Scene,
        database_path: Path,
        settings: SensorSfmSettings,
        seed: int,
        turns: Mapping[str, float] | None = None,
    ) -> None:
        self.reports: list[AdjustmentReport] = []
        self.others = Resection(scene, (), {})
        self.scene, self._database, self._settings, self._seed = scene, database_path, settings, seed
        self._turns = turns or {}
        cameras = {scene.camera_of(frame) for frame in scene.registered}
        focals = [camera.intrinsics[0, 0] for camera in cameras if isinstance(camera, ColmapCamera)]
        self._focal = float(np.median(focals))
        self._done = False

    def event(self) -> ProgressEvent:
        """Say how far it is."""
        most = self._settings.rounds
        return ProgressEvent("sensors.refine", most if self._done else min(len(self.reports), most - 1), most)

    def run(self, token: pycolmap.CancellationToken) -> pycolmap.Reconstruction:
        """Return the adjusted reconstruction."""
        settings = self._settings
        model = self.scene.to_pycolmap()
        # In pixels at the middle of a picture, so that it can be told from the residuals.
        limit = max(self._focal * math.tan(math.radians(settings.first_error)), settings.max_error)
        for number in range(settings.rounds - 1):
            if limit <= settings.max_error:
                break
            model = self._round(model, limit, token, final=False, first=number == 0)
            if number == 0 and settings.estimate_biases:
                self._correct_positions(model)
            limit = max(min(_REACH * residual_noise(model), _SLOWEST * limit), settings.max_error)
        if settings.place_others and len(self.scene.registered) < len(self.scene):
            if not self.reports:  # the others need points
                model = self._round(model, settings.max_error, token, final=False, first=False)
            model = self._with_others(model, limit)
        model = self._round(model, settings.max_error, token, final=True, first=False)
        self._done = True
        return model

    def _correct_positions(self, model: pycolmap.Reconstruction) -> None:
        """Take what is wrong with all positions out of those that hold the rounds that follow."""
        found = scene_from_pycolmap(model, self.scene.image_dir, like=self.scene)
        corrected = correct(found, estimate_biases(found, turns=self._turns), turns=self._turns)
        self.scene = self.scene.replace(
            frames=tuple(
                _with_position_of(frame, better)
                for frame, better in zip(self.scene.frames, corrected.frames, strict=True)
            )
        )

    def _with_others(self, model: pycolmap.Reconstruction, limit: float) -> pycolmap.Reconstruction:
        """Return the reconstruction with the frames that points place, for a last round with all frames."""
        self.others = place_by_points(
            scene_from_pycolmap(model, self.scene.image_dir, like=self.scene),
            model,
            self._database,
            max_error=limit,
            least=self._settings.min_points,
            seed=self._seed,
        )
        return self.others.scene.replace(points=None).to_pycolmap() if self.others.placed else model

    def _round(
        self,
        model: pycolmap.Reconstruction,
        pixels: float,
        token: pycolmap.CancellationToken,
        *,
        final: bool,
        first: bool,
    ) -> pycolmap.Reconstruction:
        def check_cancelled() -> None:
            if token.is_cancelled:
                raise Cancelled("Cancelled in the refinement of sensor poses")

        settings = self._settings
        check_cancelled()
        model = pycolmap.triangulate_points(
            model,
            self._database,
            self.scene.image_dir,
            # COLMAP writes the model here, and to a folder beside it first.
            self._database.parent / "model",
            clear_points=True,
            options=triangulation_options(
                degrees=math.degrees(math.atan(pixels / self._focal)),
                pixels=pixels,
                min_angle=settings.min_angle,
                seed=self._seed,
                min_matches=settings.min_matches,
                threads=settings.threads,
                adjusted=True,
            ),
            cancellation_token=token,
        )
        check_cancelled()
        if not model.num_points3D():
            raise _no_points(settings)
        if not final:
            thin_points(model, _COARSE_POINTS)
        report = adjust(
            model,
            refine_focal=settings.refine_focal,
            # Poses that are still coarse would be taken for distortion.
            refine_distortion=settings.refine_distortion and not first,
            refine_principal_point=settings.refine_principal_point and final,
            max_error=pixels,
            min_angle=settings.min_angle,
            threads=settings.threads,
            check_cancelled=check_cancelled,
            priors=position_priors(self.scene, model),
        )
        self.reports.append(report)
        return model


def _with_position_of(frame: Frame, better: Frame) -> Frame:
    """Return a frame with the corrected position. Its attitude stays: later rounds do not read it."""
    if frame.prior is None or better.prior is None:
        return frame
    return dataclasses.replace(frame, prior=dataclasses.replace(frame.prior, position=better.prior.position))


def _no_points(settings: SensorSfmSettings) -> StageError:
    return StageError(
        "No point could be triangulated under the sensors' poses",
        expected=f"matches that fit to {settings.first_error:g} degrees",
        found="none in three pictures",
        todo="Raise first_error, match more pairs, or use colmap-3dgs",
    )
