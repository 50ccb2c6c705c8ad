"""Named settings of splat training: by how much time there is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from toolkit.errors import SettingsError
from toolkit.splat.train_settings import MOST_GAUSSIANS, TrainSettings


@dataclass(frozen=True, slots=True)
class Preset:
    """A name for some changes of the default settings.

    Attributes
    ----------
    doc:
        What it is for, in a line.
    changes:
        Settings that differ from the defaults.
    """

    doc: str
    changes: Mapping[str, Any]


_PAPER_STEPS = 30_000

PRESETS: Mapping[str, Preset] = MappingProxyType(
    {
        "draft": Preset(
            "A first look: training in less than a minute on two cores.",
            MappingProxyType(
                {
                    "steps": 1000,
                    "max_side": 400,
                    "coarse_to_fine": True,
                    "densify_stop": 0.8,  # so that pictures of full size have their say, too
                    "sh_degree": 1,
                    "max_gaussians": 30_000,
                    "checkpoint_every": 250,
                }
            ),
        ),
        "standard": Preset("The defaults: some minutes on a laptop.", MappingProxyType({})),
        "paper": Preset(
            "As Kerbl et al. 2023: hours on a CPU, and as many Gaussians as the memory holds.",
            MappingProxyType(
                {
                    "steps": _PAPER_STEPS,
                    "max_side": 1600,
                    "coarse_to_fine": False,
                    "background": "black",
                    "sh_degree": 3,
                    "sh_every": 1000,
                    "densify_start": 500 / _PAPER_STEPS,
                    "densify_stop": 15_000 / _PAPER_STEPS,
                    "densify_every": 100,
                    "grad_threshold": 2e-4,
                    "reset_every": 3000,
                    "max_gaussians": MOST_GAUSSIANS,
                }
            ),
        ),
    }
)


def find_preset(name: str) -> Preset:
    """Return the preset of this name.

    Raises
    ------
    SettingsError
        Where there is none; the message lists those that there are.
    """
    if name not in PRESETS:
        raise SettingsError(f"Unknown preset '{name}'", expected="one of " + ", ".join(PRESETS))
    return PRESETS[name]


def preset_settings(name: str) -> TrainSettings:
    """Return the settings of a preset. Raises as :func:`find_preset`."""
    return TrainSettings().replace(find_preset(name).changes)
