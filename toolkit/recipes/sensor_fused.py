"""Sensors fused with pictures: sensor poses choose the pairs, matches under them find the sensors' constant errors.

As sensor poses + 3DGS, for speed: pairs that see the same by position and view, and features without the doubled
first octave. So the time grows with the number of photos and not with its square.
"""

from __future__ import annotations

from typing import Any

from toolkit.matching.features import SiftSettings
from toolkit.matching.match import MatchSettings
from toolkit.matching.pairs import PairSettings
from toolkit.metrics.lpips import Lpips
from toolkit.poses.sensor_refine import SensorSfmSettings
from toolkit.poses.slam.merge import MergeSettings
from toolkit.poses.slam.orb_pnp import OrbPnpSettings
from toolkit.poses.slam.orbslam3 import OrbSlam3Settings
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult
from toolkit.recipes.cached import CachedStage
from toolkit.recipes.flight_video import film_of
from toolkit.recipes.sensor_3dgs import sensor_stages
from toolkit.recipes.slam_stages import (
    VideoSettings,
    orb_pnp_tracker,
    orbslam3_tracker,
    place_stage,
    slam_metrics,
    track_stage,
)
from toolkit.recipes.steps import PosedStages, train_and_measure
from toolkit.settings import Choice, Group, Settings
from toolkit.splat.train_settings import TrainSettings


class SlamJoinSettings(Settings):
    """Whether and how the relative motion that SLAM sees joins the sensors."""

    backend = Choice(
        "none",
        choices=("none", "orb-pnp", "orbslam3"),
        doc="SLAM over the flight's video, joined with GPS in a pose graph: the refinement begins with its poses "
        "in place of the gimbal's. For flights whose attitudes or positions are bad or missing; it costs the time "
        "of the whole video, but for one that another method's run has tracked already.",
    )
    video = Group(VideoSettings(), doc="Frames and visual words")
    orb_pnp = Group(OrbPnpSettings(), doc="Our own SLAM (slam.backend=orb-pnp)")
    orbslam3 = Group(OrbSlam3Settings(), doc="ORB-SLAM3 (slam.backend=orbslam3)")
    merge = Group(MergeSettings(), doc="How GPS joins and places what was tracked")


class SensorFusedSettings(Settings):
    """Settings of every stage of sensors fused with pictures.

    Features default to ``first_octave=0`` (the picture is not doubled first) and at most 2,048 a photo: on the
    sample flight a third of the time and a third of the features, with residuals of 0.27 px instead of 0.19. For
    the last hundredths of a degree set ``sift.first_octave`` to -1.

    Training does not refine the poses: on two sample flights (24 photos of 240 x 180, 600 steps) free refinement
    changed PSNR of test photos by -0.25 to +0.11 dB and made poses 3 to 5 % (ROT) and 10 to 14 % (POS) better, and
    with a pull to the start they stayed. ``train.refine_poses`` turns it on, after a warm-up and with such a pull.
    """

    sift = Group(SiftSettings(first_octave=0, max_features=2048), doc="Features")
    pairs = Group(PairSettings(method="sensor", neighbours=6, reach=4.0), doc="Which photos are matched with which")
    match = Group(MatchSettings(), doc="Matching and geometric verification")
    slam = Group(SlamJoinSettings(), doc="Relative motion from SLAM")
    sensors = Group(
        SensorSfmSettings(attitude="auto"),
        doc="Poses from GPS and gimbal, refined by the pictures, and their biases",
    )
    train = Group(
        TrainSettings(
            lr_camera=1e-3,
            lr_camera_final=5e-5,
            pose_start=0.2,
            pose_prior="start",
            pose_prior_weight=0.003,
            pose_position_sigma=0.001,
            pose_rotation_sigma=0.1,
        ),
        doc="Gaussian splats",
    )


def run(data: RecipeInput, settings: SensorFusedSettings, context: RecipeContext) -> RecipeResult:
    """Take poses from GPS and gimbal, find what is wrong with them by matches, then train a splat on them."""
    lpips = Lpips()
    before, motion = _slam_stages(data, settings.slam, context)
    posed = sensor_stages(data, settings, context, start=before[-1] if before else None)
    metrics = {**motion, **posed.metrics, **bias_metrics(posed.stages[-1].report["biases"])}
    return train_and_measure(data, PosedStages((*before, *posed.stages), metrics), settings.train, context, lpips)


def _slam_stages(
    data: RecipeInput, settings: SlamJoinSettings, context: RecipeContext
) -> tuple[tuple[CachedStage, ...], dict[str, float | None]]:
    """Return the stages that track the flight's video and place it by GPS, with their measures."""
    if settings.backend == "none":
        return (), {}
    film = film_of(data)
    if settings.backend == "orbslam3":
        tracker = orbslam3_tracker(film, settings.orbslam3, settings.video, context)
    else:
        tracker = orb_pnp_tracker(settings.orb_pnp)
    tracked = track_stage(data, film, tracker, settings.video.pictures, context)
    placed = place_stage(data, tracked, "merge", settings.merge, context)
    return (*tracker.before, tracked, placed), slam_metrics(tracked, placed)


def bias_metrics(biases: dict[str, Any]) -> dict[str, float | None]:
    """Return the sensors' constant errors as measures; None where the flight leaves them open.

    Parameters
    ----------
    biases:
        :meth:`toolkit.poses.sensor_biases.SensorBiases.to_dict`.
    """
    x, y, z = (part["value"] for part in biases["boresight"])
    return {
        "sensors.heading_bias_deg": biases["heading"]["value"],
        "sensors.heading_bias_sigma_deg": biases["heading"]["sigma"],
        "sensors.boresight_x_deg": x,
        "sensors.boresight_y_deg": y,
        "sensors.boresight_z_deg": z,
        "sensors.time_offset_s": biases["time_offset"]["value"],
        "sensors.lever_ahead_m": biases["lever_ahead"]["value"],
        "sensors.lever_right_m": biases["lever_right"]["value"],
    }


RECIPE = Recipe(
    name="sensor-fused",
    title="Sensors fused with pictures",
    paper="",
    description=(
        "Camera poses from GPS and gimbal choose which photos are matched, by position and view; matches under "
        "these poses give points, an adjustment with the GPS as prior, and the sensors' constant errors (heading, "
        "boresight, time offset). Photos without gimbal angles get them from the direction of flight; photos "
        "without GPS, or with a wrong one, are placed by their matches. Where the flight's video is there, SLAM's "
        "relative motion can join in (slam.backend). The result is in metres, east-north-up."
    ),
    settings_type=SensorFusedSettings,
    run=run,
)
