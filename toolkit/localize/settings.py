"""Settings of localisation: how a photo is matched with a map's renders, and when a pose is believed."""

from __future__ import annotations

from toolkit.matching.picture_settings import PictureMatchSettings
from toolkit.settings import Boolean, Group, Integer, Number, Settings


class PnpSettings(Settings):
    """A pose from pixels and points: RANSAC, then Levenberg-Marquardt (COLMAP's)."""

    max_error = Number(
        3.0, bounds=(0.1, 100.0), unit="px", doc="Matches whose point misses its pixel by more are outliers."
    )
    min_inliers = Integer(20, bounds=(6, 100_000), unit="matches", doc="A pose with fewer inliers is not believed.")
    confidence = Number(0.9999, bounds=(0.5, 1.0), doc="RANSAC ends when it has found the best pose this surely.")
    max_trials = Integer(10_000, bounds=(100, 1_000_000), unit="trials", doc="... or after so many.")


class OneShotSettings(Settings):
    """Render, match, back-project, PnP: once (uav-splat-localization, section 3.2)."""

    render_side = Integer(
        1024, bounds=(32, 8192), unit="px", doc="Longer side of what is rendered; never more than the photo's."
    )
    match = Group(
        PictureMatchSettings(method="aliked-lightglue", max_features=1024),
        doc="Features of photo and render, and their matches; the paper's are superpoint-lightglue",
    )
    pnp = Group(PnpSettings(max_error=8.0), doc="The pose from matches and depth")


class ReliabilitySettings(Settings):
    """Which pixels of a render may be back-projected."""

    min_alpha = Number(0.8, bounds=(0.0, 1.0), doc="Less covered pixels have no depth.")
    max_spread = Number(
        0.05,
        bounds=(0.0, 10.0),
        unit="of the depth",
        doc="Largest standard deviation of the depths that a pixel is blended of (kind 3d: difference of mean and "
        "median), or twice the picture's median one where that is larger.",
    )
    max_step = Number(
        0.05,
        bounds=(0.0, 10.0),
        unit="of the depth",
        doc="Largest difference of depth to the eight neighbours: at outlines the pixel may be of either surface.",
    )
    max_slant = Number(
        80.0, bounds=(1.0, 90.0), unit="deg", doc="2d: largest angle between the surface's normal and the ray."
    )


class FanSettings(Settings):
    """More start poses, rendered small, for starts that are far off."""

    most = Integer(24, bounds=(0, 1000), doc="Start poses that are tried where the first one finds nothing.")
    side = Integer(320, bounds=(32, 4096), unit="px", doc="Longer side of photo and renders meanwhile.")
    enough = Integer(40, bounds=(6, 100_000), unit="matches", doc="Inliers with which the search ends.")
    reach = Number(
        2.0, bounds=(0.1, 10.0), unit="sigmas", doc="How far from the start they lie, in its standard deviations."
    )


class PolishSettings(Settings):
    """The pose at which the render looks most like the photo, from the exact gradient by the pose."""

    use = Boolean(True, doc="Polish the pose at the end.")
    side = Integer(640, bounds=(32, 4096), unit="px", doc="Longer side of what is compared.")
    steps = Integer(20, bounds=(1, 1000), unit="steps", doc="Evaluations of loss and gradient, at most.")
    lambda_dssim = Number(0.5, bounds=(0.0, 1.0), doc="Share of D-SSIM in the loss; the rest is L1.")
    max_move = Number(
        3.0,
        bounds=(0.1, 100.0),
        unit="sigmas",
        doc="A polished pose farther than this from that of the matches, in standard deviations of the latter, is "
        "not taken.",
    )


class JudgeSettings(Settings):
    """When a pose is believed."""

    min_inliers = Integer(
        30, bounds=(6, 100_000), unit="matches", doc="Fewest inliers of the last round, at full size."
    )
    min_inlier_share = Number(0.15, bounds=(0.0, 1.0), doc="... and their least share of the matches.")
    max_position_sigma = Number(
        0.02, bounds=(0.0, 10.0), unit="of the depth", doc="Largest standard deviation of the position."
    )
    min_likeness = Number(
        0.3,
        bounds=(-1.0, 1.0),
        doc="Least correlation of photo and render in their details, where the map is reliable.",
    )
    innovation = Number(
        4.0,
        bounds=(0.5, 100.0),
        unit="sigmas",
        doc="A pose farther from the start than this, by the covariances of both, is not believed; only where the "
        "start says how sure it is.",
    )
    map_sigma = Number(
        0.0005,
        bounds=(0.0, 1.0),
        unit="of the depth",
        doc="Standard deviation of the map's own errors, which matches share: added to that of every position.",
    )


class LocalizeSettings(Settings):
    """Render, match and solve again until nothing moves; say so where the camera is lost."""

    render_side = Integer(
        1024, bounds=(32, 8192), unit="px", doc="Longer side of what is rendered; never more than the photo's."
    )
    finest = Number(
        0.25,
        bounds=(0.0, 10.0),
        unit="of a Gaussian",
        doc="Photos whose pixels are finer on the ground than this share of the map's small Gaussians (the lower "
        "quartile of their standard deviations) are shrunk: near the ground the map has no such detail. 0: never.",
    )
    blur = Number(
        1.0,
        bounds=(0.0, 10.0),
        unit="of a Gaussian",
        doc="Matches may miss by so much of the map's small Gaussians, where that is more than pnp.max_error: near "
        "the ground nothing in the map has a sharper place.",
    )
    rounds = Integer(
        6, bounds=(1, 100), doc="Renders that are matched, at most, from a start that was good enough."
    )
    still = Number(
        0.0005,
        bounds=(0.0, 1.0),
        unit="of the depth",
        doc="The pose stands still when it, or what it looks at, moves by less.",
    )
    match = Group(PictureMatchSettings(), doc="Features of photo and render, and their matches")
    pnp = Group(PnpSettings(max_error=2.0), doc="The pose from matches and depth")
    reliable = Group(ReliabilitySettings(), doc="Which pixels may be back-projected")
    fan = Group(FanSettings(), doc="Further start poses")
    polish = Group(PolishSettings(), doc="Photometric polish")
    judge = Group(JudgeSettings(), doc="When a pose is believed")


class SequenceSettings(Settings):
    """Photos of one flight in order: the last poses say where the next one is looked for."""

    acceleration = Number(
        3.0,
        bounds=(0.0, 1000.0),
        unit="scene units/s2",
        doc="Standard deviation of the acceleration on each axis: how wrong constant velocity is.",
    )
    angular_acceleration = Number(
        20.0, bounds=(0.0, 10_000.0), unit="deg/s2", doc="The same of the rotation, about each axis."
    )
    speed = Number(
        10.0,
        bounds=(0.0, 1000.0),
        unit="scene units/s",
        doc="Standard deviation of the velocity on each axis while only one pose is known.",
    )
    angular_speed = Number(20.0, bounds=(0.0, 1000.0), unit="deg/s", doc="The same of the rotation.")
    attitude_sigma = Number(
        3.0,
        bounds=(0.001, 180.0),
        unit="deg",
        doc="Standard deviation of attitudes by an IMU, where they are given.",
    )
