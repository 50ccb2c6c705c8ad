"""Named settings of trainings that refine poses: the rows of A-3DGS (section 4.1 and Table 2), and short ones.

Apart from :data:`toolkit.splat.presets.PRESETS`, which say how much time there is for poses that are known.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from toolkit.errors import SettingsError
from toolkit.splat.presets import Preset, find_preset
from toolkit.splat.train_settings import TrainSettings

_PAPER_STEPS = 30_000

# What NoposeGS changes in 3DGS, at A-3DGS's values. The rate of cameras is theirs for a scene scaled into the unit
# cube; here its unit is the scene's extent, 1.1 times the distance of the farthest camera from the middle of all.
_NOPOSEGS: Mapping[str, Any] = {
    **find_preset("paper").changes,
    "refine_poses": True,
    "densify_stop": 1.0,
    "lr_camera_final": 1e-5,
    "lr_means_final": 1.6e-5,
    "opacity_cost": 0.01,
    "max_anisotropy": 10.0,
    "early_max_gaussians": 256_000,
    "early_until": 10_000 / _PAPER_STEPS,
}

POSE_PRESETS: Mapping[str, Preset] = MappingProxyType(
    {
        "orbslam-noposegs": Preset(
            "As A-3DGS trains on poses of ORB-SLAM3 (Table 2).",
            MappingProxyType({**_NOPOSEGS, "lr_camera": 1e-3, "lr_means": 1e-3}),
        ),
        "sensor-dpt": Preset(
            'As A-3DGS trains on poses of GPS and gimbal; cameras start at 1.5e-3, which the paper calls "lower" '
            "although it is more than the 1e-3 of its Table 2; the value is taken as printed.",
            MappingProxyType({**_NOPOSEGS, "lr_camera": 1.5e-3, "lr_means": 1.6e-4}),
        ),
        "poses-short": Preset(
            "The same costs in a thousand steps, with rates for so few, as each pose moves some dozens of times; "
            "rotations have a pivot, and good poses are held.",
            MappingProxyType(
                {
                    "steps": 1000,
                    "max_side": 400,
                    "sh_degree": 0,
                    "refine_poses": True,
                    "lr_camera": 6e-3,
                    "lr_camera_final": 6e-4,
                    "pose_start": 0.05,
                    "pose_ramp": 6,
                    "pose_pivot": True,
                    # Young Gaussians pull all cameras alike by a tenth of a degree. Poses within that of their
                    # start are held; those with a degree to go are not, for their photos pull much harder.
                    "pose_prior_weight": 5e-4,
                    "pose_prior_reach": 1.0,
                    "pose_rotation_sigma": 0.04,
                    "lr_means": 2e-3,  # where Gaussians cannot follow, poses stay where the first ones hold them
                    "lr_means_final": 1e-4,
                    "opacity_cost": _NOPOSEGS["opacity_cost"],
                    "max_anisotropy": _NOPOSEGS["max_anisotropy"],
                    "max_gaussians": 30_000,
                    "early_max_gaussians": 10_000,
                    "early_until": _NOPOSEGS["early_until"],
                    "checkpoint_every": 250,
                }
            ),
        ),
    }
)


def pose_preset_settings(name: str) -> TrainSettings:
    """Return the settings of a preset that refines poses.

    Raises
    ------
    SettingsError
        Where there is none of this name; the message lists those that there are.
    """
    if name not in POSE_PRESETS:
        raise SettingsError(f"Unknown preset '{name}'", expected="one of " + ", ".join(POSE_PRESETS))
    return TrainSettings().replace(POSE_PRESETS[name].changes)
