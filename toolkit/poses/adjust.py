"""The last bundle adjustment: robust, and with the principal point free where the pictures determine it.

COLMAP's mapper keeps the principal point in the middle of the picture and lets every residual below its outlier
threshold pull by its square. Both show in the poses: a principal point that is off by 8 of 1,536 pixels turns every
camera by 0.35 degrees. Here the reconstruction is adjusted once more with a Cauchy loss, scaled by the noise that
the residuals themselves show (Triggs et al. 2000, "Bundle adjustment - a modern synthesis", section 3), and with
the principal point among the unknowns.

A principal point and tangential distortion do nearly the same to a picture. With a model that has both (OPENCV)
they take each other's place: on photos of lenses without distortion rotations were 1.5 to 5 times worse than with
SIMPLE_RADIAL.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import pycolmap

from toolkit.scene import Scene

#: Residuals beyond this many standard deviations lose their weight.
_LOSS_SCALE = 2.0
#: The same of measured positions: three coordinates, of which 95 % have a norm below this.
_PRIOR_LOSS_SCALE = 2.8
#: Largest standard deviation, as a part of the longer side, of a principal point that counts as determined. It is
#: that of independent residuals; on filmed flights the true error was four times as large, and turned all cameras.
POINT_SIGMA = 0.0002
# The cost changes by less than this part in the last step: poses move by far less than their standard deviation.
_TOLERANCE = 1e-6
# The same where measured positions hold the whole, for these hold it loosely: steps after it moved poses of filmed
# flights by less than a millimetre and a thousandth of a degree, and took half the time.
_TOLERANCE_OF_POSITIONS = 1e-5
_STEPS = 200

#: Largest relative standard deviation of a focal length that counts as determined.
_FOCAL_DETERMINED = 0.02

Outcome = Literal["refined", "fixed", "not determined"]


@dataclass(frozen=True, slots=True)
class AdjustmentReport:
    """What the last adjustment did.

    Attributes
    ----------
    noise:
        Robust standard deviation of a residual's coordinate before, in pixels.
    principal_point:
        ``"refined"``; ``"fixed"`` as asked; or ``"not determined"``, and therefore not refined.
    principal_point_sigma:
        Standard deviation of the worst determined coordinate, in pixels, of independent residuals: the true error
        is larger. None where it was not to be refined or cannot be computed.
    focal:
        As for the principal point; looked into only where positions are given.
    focal_sigma:
        Largest relative standard deviation of a focal length, None where it was not looked into.
    steps:
        Steps of the solver that lowered the cost.
    converged:
        Whether the solver stopped by its tolerance and not by its number of steps.
    observations_removed:
        How many were farther than the outlier threshold afterwards.
    """

    noise: float
    principal_point: Outcome
    principal_point_sigma: float | None
    focal: Outcome
    focal_sigma: float | None
    steps: int
    converged: bool
    observations_removed: int

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return asdict(self)


def adjust(
    reconstruction: pycolmap.Reconstruction,
    *,
    refine_focal: bool,
    refine_distortion: bool,
    refine_principal_point: bool,
    max_error: float,
    min_angle: float,
    point_sigma: float = POINT_SIGMA,
    threads: int = 0,
    check_cancelled: Callable[[], None] = lambda: None,
    priors: Sequence[pycolmap.PosePrior] = (),
) -> AdjustmentReport:
    """Adjust poses, points and cameras of ``reconstruction`` in place.

    Parameters
    ----------
    reconstruction:
        As the mapper left it.
    refine_focal, refine_distortion:
        Whether focal lengths and distortion are among the unknowns.
    refine_principal_point:
        Whether principal points are, too, provided that all cameras' are determined to ``point_sigma``.
    max_error, min_angle:
        Observations with a larger error in pixels afterwards, and points seen under a smaller angle in degrees,
        are removed.
    point_sigma:
        Largest standard deviation of a principal point that counts as determined, as a part of the longer side.
    threads:
        Of the solver; 0: as many as there are cores.
    check_cancelled:
        Called between the steps; raises to stop.
    priors:
        Measured positions with their covariances, which hold the reconstruction where it is (a Cauchy loss keeps
        wrong ones from bending it); without any, two cameras hold place and scale. With positions, focal lengths
        are kept unless they are determined to 2 %: over flat ground, pictures that all look down from one height
        fit any focal length, and positions make it look as if only one height would do.
    """
    noise = residual_noise(reconstruction)
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=refine_focal, refine_extra_params=refine_distortion, print_summary=False
    )
    options.ceres.solver_options.num_threads = threads or -1
    options.ceres.solver_options.function_tolerance = _TOLERANCE_OF_POSITIONS if priors else _TOLERANCE
    options.ceres.solver_options.max_num_iterations = _STEPS
    wanted = point_sigma if refine_principal_point else None
    focal, focal_sigma, point, found_sigma = _unknowns(reconstruction, options, noise, priors, wanted)
    check_cancelled()
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    # A model without noise still needs a positive scale.
    options.ceres.loss_function_scale = max(_LOSS_SCALE * noise, 1e-3)
    summary = _adjuster(reconstruction, options, noise, priors).solve()
    assert isinstance(summary, pycolmap.CeresBundleAdjustmentSummary)
    check_cancelled()
    removed = pycolmap.ObservationManager(reconstruction).filter_all_points3D(max_error, min_angle)
    reconstruction.update_point_3d_errors()
    return AdjustmentReport(
        noise,
        point,
        found_sigma,
        focal,
        focal_sigma,
        summary.ceres_summary.num_successful_steps,
        summary.termination_type == pycolmap.BundleAdjustmentTerminationType.CONVERGENCE,
        int(removed),
    )


def position_priors(scene: Scene, reconstruction: pycolmap.Reconstruction) -> list[pycolmap.PosePrior]:
    """Return the positions of a scene's priors for the registered images, in the scene's world frame.

    Image numbers are the frame's place in the scene plus one. A position without a standard deviation has one metre
    on each axis.
    """
    priors = []
    for number in sorted(reconstruction.reg_image_ids()):
        prior = scene.frames[number - 1].prior
        if prior is None or prior.position is None:
            continue
        sigma = np.ones(3) if prior.position_sigma is None else prior.position_sigma
        priors.append(
            pycolmap.PosePrior(
                corr_data_id=reconstruction.image(number).data_id,
                position=prior.position,
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
                position_covariance=np.diag(np.square(sigma)),
            )
        )
    return priors


def focal_sigma(
    reconstruction: pycolmap.Reconstruction, *, refine_distortion: bool, refine_principal_point: bool
) -> float | None:
    """Return the largest relative standard deviation of a focal length, as the pictures alone determine it.

    Distortion and principal point are among the unknowns as told. None where the covariance cannot be computed: the
    focal length, or something else, is not determined at all.
    """
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=True,
        refine_extra_params=refine_distortion,
        refine_principal_point=refine_principal_point,
        print_summary=False,
    )
    return _sigmas(reconstruction, options, residual_noise(reconstruction), ())[0]


def residual_noise(reconstruction: pycolmap.Reconstruction) -> float:
    """Return the standard deviation, in pixels, of one coordinate of the residuals, whatever the outliers.

    It is 1.4826 times the median absolute residual.
    """
    points = reconstruction.points3D
    residuals = [np.zeros((0, 2))]
    for image_id in reconstruction.reg_image_ids():
        image = reconstruction.image(image_id)
        seen = image.get_observation_points2D()
        if seen:
            world = np.array([points[point.point3D_id].xyz for point in seen])
            motion = image.cam_from_world().matrix()
            projected = reconstruction.camera(image.camera_id).img_from_cam(world @ motion[:, :3].T + motion[:, 3])
            residuals.append(np.asarray(projected) - np.array([point.xy for point in seen]))
    together = np.abs(np.concatenate(residuals))
    return 1.4826 * float(np.nanmedian(together)) if together.size else 0.0


def _adjuster(
    reconstruction: pycolmap.Reconstruction,
    options: pycolmap.BundleAdjustmentOptions,
    noise: float,
    priors: Sequence[pycolmap.PosePrior],
) -> pycolmap.CeresBundleAdjuster:
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    if not priors:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        return pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    # While poses are still coarse the residuals are theirs and not noise of the pixels.
    pixel = min(max(noise, 1e-3), 1.0)
    weighted = [
        pycolmap.PosePrior(
            corr_data_id=prior.corr_data_id,
            position=prior.position,
            coordinate_system=prior.coordinate_system,
            # COLMAP takes a residual of one pixel for one standard deviation; the positions must keep step.
            position_covariance=prior.position_covariance / pixel**2,
        )
        for prior in priors
    ]
    robust = pycolmap.PosePriorBundleAdjustmentOptions()
    robust.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
    robust.ceres.prior_position_loss_scale = _PRIOR_LOSS_SCALE * pixel
    return pycolmap.create_pose_prior_ceres_bundle_adjuster(options, robust, config, weighted, reconstruction)


def _used_cameras(reconstruction: pycolmap.Reconstruction) -> Iterable[pycolmap.Camera]:
    numbers = {reconstruction.image(image_id).camera_id for image_id in reconstruction.reg_image_ids()}
    return [reconstruction.camera(number) for number in sorted(numbers)]


def _unknowns(
    reconstruction: pycolmap.Reconstruction,
    options: pycolmap.BundleAdjustmentOptions,
    noise: float,
    priors: Sequence[pycolmap.PosePrior],
    wanted: float | None,
) -> tuple[Outcome, float | None, Outcome, float | None]:
    """Set in ``options`` what of the cameras is refined; principal points if they are known to ``wanted``.

    Returns what becomes of focal lengths and of principal points, and how well each is determined (None where that
    was not looked into).
    """
    refine_principal_point = wanted is not None
    look = options.refine_focal_length and bool(priors)
    focal: Outcome = "refined" if options.refine_focal_length else "fixed"
    if not look and not refine_principal_point:
        return focal, None, "fixed", None
    options.refine_principal_point = refine_principal_point
    focal_sigma, point_sigma = _sigmas(reconstruction, options, noise, priors)
    if look:
        if refine_principal_point and not _within(focal_sigma, _FOCAL_DETERMINED):
            # It may be the principal point that leaves it open.
            options.refine_principal_point = False
            focal_sigma, _ = _sigmas(reconstruction, options, noise, priors)
        if not _within(focal_sigma, _FOCAL_DETERMINED):
            # The lens cannot be told from the shape of the ground where not even its focal length can.
            options.refine_focal_length = options.refine_extra_params = options.refine_principal_point = False
            return "not determined", focal_sigma, "fixed", None
    told = focal_sigma if look else None
    if wanted is None:
        return focal, told, "fixed", None
    longest = min(max(camera.width, camera.height) for camera in _used_cameras(reconstruction))
    options.refine_principal_point &= _within(point_sigma, wanted * longest)
    return focal, told, "refined" if options.refine_principal_point else "not determined", point_sigma


def _within(sigma: float | None, limit: float) -> bool:
    return sigma is not None and sigma <= limit


def _sigmas(
    reconstruction: pycolmap.Reconstruction,
    options: pycolmap.BundleAdjustmentOptions,
    noise: float,
    priors: Sequence[pycolmap.PosePrior],
) -> tuple[float | None, float | None]:
    """Return the largest standard deviations: of a focal length as part of itself, of a principal point in pixels.

    The covariance is that of independent residuals with standard deviation ``noise``, at the solution that is
    there; None where there is none, and for what is not among the unknowns in ``options``.
    """
    adjuster = _adjuster(reconstruction, options, noise, priors)
    covariance = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), reconstruction, adjuster)
    if covariance is None:
        return None, None
    focal, point = 0.0, 0.0
    for camera in _used_cameras(reconstruction):
        of_camera = covariance.get_other_params_cov(camera.params)
        if of_camera is None:
            return None, None
        focals, points = list(camera.focal_length_idxs()), list(camera.principal_point_idxs())
        free = focals if options.refine_focal_length else []
        free = free + (points if options.refine_principal_point else [])
        free = free + (list(camera.extra_params_idxs()) if options.refine_extra_params else [])
        sigma = np.full(len(camera.params), np.nan)
        # A negative variance is rounding of what is not determined.
        variance = np.diagonal(np.asarray(of_camera))
        sigma[sorted(free)] = noise * np.sqrt(np.where(variance >= 0, variance, np.nan))
        # NaN stays the largest: one camera that is not determined speaks for all.
        focal = float(np.max([focal, *(sigma[focals] / np.asarray(camera.params)[focals])]))
        point = float(np.max([point, *sigma[points]]))
    return None if math.isnan(focal) else focal, None if math.isnan(point) else point
