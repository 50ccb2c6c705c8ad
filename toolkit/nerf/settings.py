"""Settings of radiance fields and their presets, apart from the code: whoever reads them needs no PyTorch."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from toolkit.settings import Boolean, Choice, Group, Integer, Number, Settings, Text


class HashGridSettings(Settings):
    """A multi-resolution hash grid (Müller et al. 2022, section 3)."""

    levels = Integer(8, bounds=(1, 24), doc="Grids from coarse to fine.")
    features = Integer(2, bounds=(1, 8), doc="Learned numbers of each corner.")
    log2_size = Integer(17, bounds=(8, 24), doc="Binary logarithm of the most corners that a grid keeps.")
    base_resolution = Integer(16, bounds=(2, 512), unit="cells", doc="Along a side of the coarsest grid.")
    finest_resolution = Integer(1024, bounds=(2, 16384), unit="cells", doc="Along a side of the finest grid.")
    width = Integer(64, bounds=(8, 512), doc="Of the layers of both small networks.")


class NerfSettings(Settings):
    """How a radiance field is trained. The defaults are those of the preset ``draft``."""

    field = Choice(
        "hash",
        choices=("hash", "frequency"),
        doc="hash: learned grids and small networks; frequency: the network of eight layers of 256 of NeRF.",
    )
    hash_grid = Group(HashGridSettings(), doc="The learned grids, with field hash")
    space = Choice(
        "contracted",
        choices=("contracted", "box"),
        doc="contracted: all of space, what lies outside the points' box squeezed into a shell around it; box: "
        "nothing but the box.",
    )
    margin = Number(0.1, bounds=(0.0, 10.0), doc="By which the box is larger than the points', on each side.")
    max_side = Integer(400, bounds=(8, 100_000), unit="px", doc="Photos are averaged down to this longer side.")
    rays = Integer(2048, bounds=(1, 1_000_000), unit="rays", doc="Pixels of a step, of all photos together.")
    budget = Integer(
        40_000,
        bounds=(0, 100_000_000),
        unit="samples",
        doc="Of a step, about: there are fewer rays where each has many samples in what is not empty; 0: no limit.",
    )
    samples = Integer(
        160, bounds=(2, 4096), doc="Intervals along a ray; with an occupancy grid those of its look-up."
    )
    asked = Integer(
        48,
        bounds=(2, 4096),
        doc="With an occupancy grid: intervals in which the network is asked, where the grid tells.",
    )
    fine_samples = Integer(
        0, bounds=(0, 4096), doc="More where a coarse network found something; 0: one network (frequency only)."
    )
    occupancy = Integer(
        64,
        bounds=(0, 512),
        unit="cells",
        doc="Side of the grid that tells where to look, and what is empty; 0: none.",
    )
    noise = Number(0.0, bounds=(0.0, 100.0), doc="Standard deviation of what is added to density in training.")
    background = Choice("black", choices=("black", "white"), doc="Behind everything.")
    steps = Integer(1500, bounds=(1, 100_000_000), doc="Length of the training, in what steps_count says.")
    steps_count = Choice(
        "in-all",
        choices=("in-all", "epochs", "per-40-frames"),
        doc="in-all: steps; epochs: rounds through all pixels; per-40-frames: steps for every 40 training frames.",
    )
    lr = Number(1e-2, bounds=(1e-9, 1.0), doc="Learning rate of Adam at the first step.")
    lr_factor = Number(0.03, bounds=(1e-9, 1.0), doc="What it is multiplied by ...")
    lr_every = Number(1.0, bounds=(1e-9, 1.0), unit="of steps", doc="... over this share of the training, or ...")
    lr_every_steps = Integer(0, bounds=(0, 100_000_000), unit="steps", doc="... so many steps, where not 0.")
    lr_stepped = Boolean(False, doc="Multiply at once after each share; otherwise smoothly in between.")
    beta2 = Number(0.99, bounds=(0.0, 0.9999999), doc="Adam's decay of squared gradients.")
    epsilon = Number(1e-15, bounds=(1e-30, 1.0), doc="Adam's smallest divisor.")
    depth_weight = Number(
        0.0, bounds=(0.0, 1000.0), doc="Weight of the sparse points' depth in the loss (DS-NeRF); 0: not used."
    )
    depth_rays = Integer(512, bounds=(1, 1_000_000), unit="rays", doc="Observations of points in a step.")
    depth_sigma = Number(
        1.0,
        bounds=(1e-6, 1000.0),
        unit="px",
        doc="Least error of an observation: where it is smaller, this is taken for the spread of its depth.",
    )
    depth_normalised = Boolean(
        True,
        doc="Every point's Gaussian has the integral one; no: equation 8 of DS-NeRF as it stands, in which "
        "uncertain points weigh more.",
    )
    warm_start = Text("", doc="Weights to start from: field.safetensors of another run, or its folder.")
    eval_every = Integer(500, bounds=(1, 10_000_000), unit="steps", doc="Measure one test photo so often.")
    checkpoint_every = Integer(500, bounds=(1, 10_000_000), unit="steps", doc="Write a checkpoint so often.")
    chunk = Integer(4096, bounds=(16, 1_000_000), unit="rays", doc="Rays that are drawn at once in renders.")


class DsNerfSettings(NerfSettings):
    """How a depth-supervised field is trained: 0.1 is the weight of the paper's baseline (section 4.4)."""

    depth_weight = Number(
        0.1, bounds=(0.0, 1000.0), doc="Weight of the sparse points' depth in the loss; 0: not used."
    )


# opt.py and models/nerf.py of nerf_pl (kwea123): 64 + 128 samples, density noise 1, 1,024 rays; Adam with torch's
# own betas and its eps of 1e-8. Section 4.4 of the paper: 5e-4, halved every 10 of 30 epochs.
_NERF_PL: dict[str, Any] = {
    "field": "frequency",
    "space": "box",
    "max_side": 100_000,
    "rays": 1024,
    "samples": 64,
    "fine_samples": 128,
    "occupancy": 0,
    "budget": 0,
    "noise": 1.0,
    "steps": 30,
    "steps_count": "epochs",
    "lr": 5e-4,
    "lr_factor": 0.5,
    "lr_every": 1 / 3,
    "lr_stepped": True,
    "beta2": 0.999,
    "epsilon": 1e-8,
}
# Section 4.4: 1,024 rays of 64 samples, 50k steps per 40 frames, decay every 1,000 steps. By how much it does not
# say; the code of DS-NeRF takes a tenth in 250,000 steps.
_DS_NERF: dict[str, Any] = {
    **_NERF_PL,
    "fine_samples": 0,
    "depth_rays": 1024,
    "depth_normalised": False,
    "steps": 50_000,
    "steps_count": "per-40-frames",
    "lr_factor": 0.1 ** (1 / 250),
    "lr_every_steps": 1000,
}

_DRAFT_DOC = "Some minutes on two cores: hash grid, small networks, empty space skipped."

#: Presets by name: what each is for and the settings that differ from the defaults.
NERF_PRESETS: Mapping[str, tuple[str, Mapping[str, Any]]] = MappingProxyType(
    {
        "draft": (_DRAFT_DOC, MappingProxyType({})),
        "paper": ("nerf_pl's network for 30 epochs: hours on a GPU, days on a CPU.", MappingProxyType(_NERF_PL)),
    }
)
DS_NERF_PRESETS: Mapping[str, tuple[str, Mapping[str, Any]]] = MappingProxyType(
    {
        "draft": (_DRAFT_DOC, MappingProxyType({})),
        "paper": ("50k steps per 40 frames: hours on a GPU, days on a CPU.", MappingProxyType(_DS_NERF)),
    }
)


def presets_of(settings: NerfSettings) -> Mapping[str, tuple[str, Mapping[str, Any]]]:
    """Return the presets that fit to settings of this kind."""
    return DS_NERF_PRESETS if isinstance(settings, DsNerfSettings) else NERF_PRESETS


def total_steps(settings: NerfSettings, frames: int, pixels: int) -> int:
    """Return how many steps the training of ``frames`` photos with ``pixels`` pixels in all has, at least one."""
    if settings.steps_count == "epochs":
        return max(1, settings.steps * -(-pixels // settings.rays))
    if settings.steps_count == "per-40-frames":
        return max(1, round(settings.steps * frames / 40))
    return int(settings.steps)


def learning_rate(settings: NerfSettings, step: int, steps: int) -> float:
    """Return the learning rate of a step, counted from 1, of ``steps``."""
    every = settings.lr_every_steps or settings.lr_every * steps
    times = (step - 1) / every
    # A third of 30 epochs, as a fraction, must not be a step late.
    return float(settings.lr * settings.lr_factor ** (int(times + 1e-9) if settings.lr_stepped else times))
