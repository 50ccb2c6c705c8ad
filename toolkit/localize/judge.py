"""Whether a pose is believed: a wrong one with a small covariance is worse than none."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.settings import JudgeSettings
from toolkit.localize.starts import Start

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Pixels over which brightness and contrast are taken out before pictures are compared.
_WINDOW = 4.0
# Contrast below this, of 0 to 255, is noise.
_FLAT = 2.0


def likeness(photo: NDArray[np.uint8], render: NDArray[np.uint8], counting: Mask) -> float:
    """Return the correlation of two pictures' details, -1 to 1, over the pixels that count; 0 where none do.

    Grey values minus their local mean, divided by their local contrast (Gaussian windows of 4 pixels): light and
    shade of whole roofs do not count, edges do.
    """
    if not counting.any():
        return 0.0
    one, other = (_details(picture)[counting] for picture in (photo, render))
    scale = float(np.sqrt(np.square(one).mean() * np.square(other).mean()))
    return float((one * other).mean() / scale) if scale > 0 else 0.0


def _details(picture: NDArray[np.uint8]) -> Array:
    from scipy.ndimage import gaussian_filter

    grey = picture.astype(np.float64).mean(axis=-1)
    flat = grey - gaussian_filter(grey, _WINDOW)
    contrast = np.sqrt(gaussian_filter(np.square(flat), _WINDOW))
    return np.asarray(flat / np.maximum(contrast, _FLAT))


def objection(
    pose: RigidTransform,
    covariance: Array | None,
    start: Start,
    depth: float,
    inliers: int,
    matches: int,
    alike: float,
    settings: JudgeSettings,
) -> str:
    """Return why a pose is not believed, or an empty text.

    Parameters
    ----------
    pose, covariance:
        What was found, and how surely (:func:`toolkit.localize.pnp.pose_covariance`).
    start:
        Where the search began, with its own standard deviations.
    depth:
        Median depth of what is seen: the measure of lengths.
    inliers, matches:
        Of the last round.
    alike:
        :func:`likeness` of photo and render at the pose.
    """
    if inliers < settings.min_inliers:
        return f"{inliers} matches agree, {settings.min_inliers} are needed"
    if inliers < settings.min_inlier_share * matches:
        return f"{inliers} of {matches} matches agree, {settings.min_inlier_share:.0%} are needed"
    if covariance is None:
        return "the matches that agree leave the pose undetermined"
    sigma = float(np.sqrt(np.diag(covariance)[:3].max()))
    if sigma > settings.max_position_sigma * depth:
        return (
            f"the position is known to {sigma:.3g} only (one standard deviation), "
            f"{settings.max_position_sigma * depth:.3g} is the limit"
        )
    if alike < settings.min_likeness:
        return (
            f"photo and map do not look alike from there: correlation {alike:.2f}, {settings.min_likeness:g} needed"
        )
    return _innovation(pose, covariance, start, settings.innovation)


def _innovation(pose: RigidTransform, covariance: Array, start: Start, most: float) -> str:
    """Return whether the pose is too far from the start, by what both are unsure."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(pose.rotation @ start.cam_from_world.rotation.T).as_rotvec()
    parts = (
        ("position", pose.centre - start.cam_from_world.centre, start.position_sigma, covariance[:3, :3]),
        ("orientation", turn, np.radians(start.rotation_sigma_deg), covariance[3:, 3:]),
    )
    for what, off, sigma, own in parts:
        if not np.isfinite(sigma):
            continue
        distance = float(np.sqrt(off @ np.linalg.solve(own + sigma**2 * np.eye(3), off)))
        if distance > most:
            return f"the {what} is {distance:.1f} standard deviations from the start, {most:g} is the limit"
    return ""
