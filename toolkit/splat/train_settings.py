"""The settings of splat training, and the schedule that follows from them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from toolkit.settings import Boolean, Choice, Integer, Number, Settings

# A run holds at least this many rounds of densification, however short it is.
_ROUNDS = 12
# In runs shorter than this fewer Gaussians are added: the threshold for gradients rises.
_FULL_STEPS = 3000
# How much larger gradients summed without their signs are, roughly.
_ABSOLUTE_FACTOR = 4.0
# More than any machine holds.
MOST_GAUSSIANS = 50_000_000


class TrainSettings(Settings):
    """How Gaussians are trained (Kerbl et al. 2023; the learning rates are those of its code).

    What happens at a certain time of a run is a share of ``steps``, and what happens again and again has an
    interval in steps that shrinks in runs too short for it (:class:`Schedule`). So a run of 300 steps goes
    through the same phases as one of 30000.

    Kerbl et al. densify from 500 to 15000 of 30000 steps above a gradient of 2e-4, with a black background. The
    defaults here are for hundreds to thousands of steps: there the gradients are large mostly because colours have
    not been learned yet, and what is added without need has no time to become anything but haze. A background
    that changes keeps Gaussians from leaving holes that happen to be right.

    From coarse to fine the threshold of gradients stays as it is: its unit is half the side of the picture, and the
    same difference of two pictures gives the same gradient at every size.
    """

    steps = Integer(3000, bounds=(1, 1_000_000), unit="steps", doc="Length of the training; one photo a step.")
    max_side = Integer(
        800, bounds=(16, 8192), unit="px", doc="Photos whose longer side is larger are averaged down to this."
    )
    coarse_to_fine = Boolean(
        False,
        doc="Photos begin with a quarter of their sides, then a half, then in full: saves a quarter to a half of "
        "the time, sometimes at some loss of detail; goes well with densify_stop=0.8.",
    )
    coarse_quarter = Number(
        0.2, bounds=(0.0, 1.0), unit="of steps", doc="With coarse_to_fine: up to here sides are a quarter as long."
    )
    coarse_half = Number(0.5, bounds=(0.0, 1.0), unit="of steps", doc="... and up to here half as long.")
    lambda_dssim = Number(0.2, bounds=(0.0, 1.0), doc="Share of D-SSIM in the loss; the rest is L1.")
    background = Choice(
        "random",
        choices=("black", "white", "random"),
        doc="Colour behind the Gaussians; random: another each step, and black when measured.",
    )
    backend = Choice("cpu", choices=("cpu", "cuda", "reference"), doc="Rasterizer; reference is for tests only.")

    kind = Choice(
        "3d",
        choices=("3d", "2d"),
        doc="3d: ellipsoids (Kerbl et al. 2023); 2d: disks, which lie on surfaces (Huang et al. 2024).",
    )
    normal_weight = Number(
        0.05, bounds=(0.0, 100.0), doc="2d: weight of the disks' normals against those of the drawn depth."
    )
    normal_start = Number(
        0.233, bounds=(0.0, 1.0), unit="of steps", doc="2d: ... from here on (7,000 of 30,000 steps), 0 before."
    )
    distortion_weight = Number(
        0.0, bounds=(0.0, 1e6), doc="2d: weight of the spread of depths along a ray, per squared scene extent."
    )

    sh_degree = Integer(3, bounds=(0, 3), doc="Highest degree of the spherical harmonics of colour.")
    sh_every = Integer(
        1000, bounds=(1, 1_000_000), unit="steps", doc="The degree rises by one at this interval, from 0 on."
    )
    initial_opacity = Number(0.1, bounds=(0.001, 0.99), doc="Opacity of the Gaussians made from points.")

    update = Choice(
        "all",
        choices=("all", "visible"),
        doc="all: every Gaussian follows its momentum in each step; visible: those not in the photo rest.",
    )
    lr_means = Number(
        1.6e-4, bounds=(0.0, 1.0), unit="scene extents", doc="Learning rate of centres at the first step."
    )
    lr_means_final = Number(
        1.6e-6, bounds=(0.0, 1.0), unit="scene extents", doc="... at the last; exponential in between."
    )
    lr_quaternions = Number(1e-3, bounds=(0.0, 1.0), doc="Learning rate of rotations.")
    lr_log_scales = Number(5e-3, bounds=(0.0, 1.0), doc="Learning rate of log scales.")
    lr_opacity = Number(5e-2, bounds=(0.0, 1.0), doc="Learning rate of opacity logits.")
    lr_sh0 = Number(2.5e-3, bounds=(0.0, 1.0), doc="Learning rate of the base colour.")
    lr_sh_rest = Number(1.25e-4, bounds=(0.0, 1.0), doc="Learning rate of the higher spherical harmonics.")

    exposure = Boolean(
        False,
        doc="Learn an affine change of colours for each training photo, so that clouds and automatic exposure "
        "need no Gaussians; test photos are drawn with the mean of all.",
    )
    lr_exposure = Number(1e-3, bounds=(0.0, 1.0), doc="Learning rate of the photos' colour changes.")

    refine_poses = Boolean(
        False, doc="Learn the training photos' poses with the Gaussians (NoposeGS, Schmidt et al. 2024)."
    )
    lr_camera = Number(
        1e-3,
        bounds=(0.0, 1.0),
        unit="scene extents and radians",
        doc="Learning rate of poses at the first step, in translation and rotation alike.",
    )
    lr_camera_final = Number(1e-5, bounds=(0.0, 1.0), doc="... at the last; exponential in between.")
    pose_start = Number(
        0.0,
        bounds=(0.0, 1.0),
        unit="of steps",
        doc="Poses rest up to here, while the Gaussians find their colours.",
    )
    pose_stop = Number(1.0, bounds=(0.0, 1.0), unit="of steps", doc="... and from here on.")
    pose_ramp = Integer(
        0,
        bounds=(0, 1_000_000),
        unit="steps",
        doc="In the first steps of each pose, so many, its rate rises: noise in the gradients of good poses does "
        "not throw them off; 0: full at once.",
    )
    pose_pivot = Boolean(
        False,
        doc="Learn each camera's rotation about a point in the middle of what it sees, at the points' median "
        "depth, so that parallax has a rate of its own (in the spirit of Park et al., CamP, 2023); otherwise about "
        "the camera, as NoposeGS.",
    )
    pose_prior = Choice(
        "start",
        choices=("start", "sensor"),
        doc="Where poses are pulled to: where they started, or what sensors said (in the scene's frame).",
    )
    pose_prior_weight = Number(
        0.0,
        bounds=(0.0, 1e6),
        doc="Weight of that pull: of the mean square of a pose's deviations in sigmas; 0: none.",
    )
    pose_prior_reach = Number(
        0.0,
        bounds=(0.0, 1e6),
        unit="sigmas",
        doc="The pull ends for poses that are farther off, so that it holds the good ones only; 0: never.",
    )
    pose_position_sigma = Number(
        0.01, bounds=(1e-9, 100.0), unit="scene extents", doc="Sigma of positions where no sensor tells its own."
    )
    pose_rotation_sigma = Number(
        1.0, bounds=(1e-6, 180.0), unit="degrees", doc="Sigma of orientations where no sensor tells its own."
    )
    refine_test_steps = Integer(
        0,
        bounds=(0, 100_000),
        unit="steps",
        doc="After the training, steps on the pose of each test photo against the finished Gaussians, for measures "
        "of their own beside those with poses that no test photo had a part in; 0: not measured.",
    )
    opacity_cost = Number(0.0, bounds=(0.0, 10.0), doc="Weight of the mean opacity in the loss; NoposeGS: 0.01.")
    max_anisotropy = Number(
        0.0,
        bounds=(0.0, 1e6),
        doc="Gaussians longer than this many times their thickness cost their excess; 0: none do; NoposeGS: 10.",
    )

    density = Choice(
        "adaptive",
        choices=("adaptive", "mcmc"),
        doc="How Gaussians are added: adaptive clones and splits where gradients are high (Kerbl et al. 2023); "
        "mcmc moves faint ones to opaque ones, grows to max_gaussians and shakes centres (Kheradmand et al. 2024).",
    )
    densify_start = Number(0.15, bounds=(0.0, 1.0), unit="of steps", doc="Densification and pruning begin here.")
    densify_stop = Number(0.7, bounds=(0.0, 1.0), unit="of steps", doc="... and end here.")
    densify_every = Integer(
        100, bounds=(1, 100_000), unit="steps", doc="Longest interval between two rounds of densification."
    )
    grad_threshold = Number(
        5e-4,
        bounds=(0.0, 1.0),
        doc="Gaussians whose mean screen-space gradient (per half image side) exceeds this are densified; "
        "times the root of 3000 / steps in shorter runs.",
    )
    absolute_gradients = Boolean(
        False,
        doc="Sum the pixels' gradients without their signs, so that large Gaussians over fine texture are split, "
        "too (Ye et al., AbsGS, 2024); they are larger then, so the threshold is raised fourfold.",
    )
    clone_scale = Number(
        0.01, bounds=(0.0, 10.0), unit="scene extents", doc="Up to this size they are cloned, above it split."
    )
    prune_opacity = Number(0.005, bounds=(0.0, 1.0), doc="Gaussians below this opacity are removed.")
    prune_scale = Number(
        0.1, bounds=(0.0, 100.0), unit="scene extents", doc="After the first opacity reset larger ones are removed."
    )
    reset_every = Integer(
        3000,
        bounds=(0, 1_000_000),
        unit="steps",
        doc="Interval at which opacities are set back while densifying, so that floaters die; 0: never.",
    )
    max_gaussians = Integer(
        150_000,
        bounds=(4, MOST_GAUSSIANS),
        doc="Never more than these, or than fit into the memory; the highest gradients go first.",
    )
    early_max_gaussians = Integer(
        0,
        bounds=(0, MOST_GAUSSIANS),
        doc="Never more than these up to early_until, so that poses settle before details do; 0: max_gaussians.",
    )
    early_until = Number(
        0.333, bounds=(0.0, 1.0), unit="of steps", doc="... NoposeGS: 10,000 of 30,000 steps, with 256,000."
    )
    mcmc_growth = Number(0.05, bounds=(0.0, 1.0), unit="of Gaussians", doc="mcmc: added in each round.")
    mcmc_noise = Number(5e5, bounds=(0.0, 1e9), doc="mcmc: strength of the noise on centres; 0: none.")
    mcmc_opacity_cost = Number(0.01, bounds=(0.0, 10.0), doc="mcmc: weight of the mean opacity in the loss.")
    mcmc_scale_cost = Number(
        0.01, bounds=(0.0, 10.0), doc="mcmc: weight of the mean scale, in scene extents, in the loss."
    )

    eval_every = Integer(
        250, bounds=(1, 1_000_000), unit="steps", doc="Interval at which one test photo is measured, for a curve."
    )
    checkpoint_every = Integer(500, bounds=(1, 1_000_000), unit="steps", doc="Interval between checkpoints.")


@dataclass(frozen=True, slots=True)
class Schedule:
    """What :class:`TrainSettings` mean for one run; steps count from 1, after they are done.

    Attributes
    ----------
    steps:
        Length of the run.
    densify_first, densify_last:
        Densification happens after steps in ``(densify_first, densify_last]`` ...
    densify_every:
        ... at this interval: the setting, or a twelfth of that span where that is shorter.
    grad_threshold:
        The setting, in runs of fewer than 3000 steps times the root of 3000 / steps, with absolute gradients
        times 4.
    reset_every:
        Opacities are set back at multiples of this up to ``densify_last``; 0, and with mcmc: never.
    sh_every:
        The SH degree rises at multiples of this: the setting, or a sixth of the run where that is shorter, so
        that the last degree has half of the run to be learned.
    sh_degree:
        The highest degree.
    reads_gradients:
        Whether the density control reads screen-space gradients at all.
    normal_weight, normal_first:
        Weight of the normals after step ``normal_first``; 0 with kind 3d.
    distortion_weight:
        Weight of the spread of depths; 0 with kind 3d.
    quarter_last, half_last:
        Up to these steps photos have a quarter, then a half, of their sides; 0, 0 without coarse to fine.
    pose_first, pose_last:
        Poses are learned in steps in ``(pose_first, pose_last]``; 0, 0 where they are not.
    most_gaussians, early_most, early_last:
        The cap on their number, and the cap up to step ``early_last``.
    """

    steps: int
    densify_first: int
    densify_last: int
    densify_every: int
    grad_threshold: float
    reset_every: int
    sh_every: int
    sh_degree: int
    reads_gradients: bool
    normal_weight: float
    normal_first: int
    distortion_weight: float
    quarter_last: int
    half_last: int
    pose_first: int
    pose_last: int
    most_gaussians: int
    early_most: int
    early_last: int

    @classmethod
    def of(cls, settings: TrainSettings) -> Schedule:
        """Return the schedule of a run with these settings."""
        first = round(settings.densify_start * settings.steps)
        last = round(settings.densify_stop * settings.steps)
        adaptive, coarse = settings.density == "adaptive", settings.coarse_to_fine
        return cls(
            steps=settings.steps,
            densify_first=first,
            densify_last=last,
            densify_every=max(1, min(settings.densify_every, (last - first) // _ROUNDS)),
            grad_threshold=_grad_threshold(settings),
            reset_every=settings.reset_every if adaptive else 0,
            sh_every=max(1, min(settings.sh_every, settings.steps // 6)),
            sh_degree=settings.sh_degree,
            reads_gradients=adaptive,
            normal_weight=settings.normal_weight if settings.kind == "2d" else 0.0,
            normal_first=round(settings.normal_start * settings.steps),
            distortion_weight=settings.distortion_weight if settings.kind == "2d" else 0.0,
            quarter_last=round(settings.coarse_quarter * settings.steps) if coarse else 0,
            half_last=round(settings.coarse_half * settings.steps) if coarse else 0,
            pose_first=round(settings.pose_start * settings.steps) if settings.refine_poses else 0,
            pose_last=round(settings.pose_stop * settings.steps) if settings.refine_poses else 0,
            most_gaussians=settings.max_gaussians,
            early_most=min(settings.early_max_gaussians or settings.max_gaussians, settings.max_gaussians),
            early_last=round(settings.early_until * settings.steps) if settings.early_max_gaussians else 0,
        )

    def densifies_after(self, step: int) -> bool:
        """Say whether Gaussians are densified and pruned after this step."""
        inside = self.densify_first < step <= self.densify_last
        return inside and (step - self.densify_first) % self.densify_every == 0

    def observes(self, step: int) -> bool:
        """Say whether this step's screen-space gradients will ever be read."""
        return self.reads_gradients and step <= self.densify_last and self.densify_first < self.densify_last

    def resets_after(self, step: int) -> bool:
        """Say whether opacities are set back after this step."""
        return self.reset_every > 0 and step % self.reset_every == 0 and step < self.densify_last

    def prunes_large_after(self, step: int) -> bool:
        """Say whether too large Gaussians are removed after this step: once opacities were set back."""
        return self.reset_every > 0 and step > self.reset_every

    def normal_weight_at(self, step: int) -> float:
        """Return the weight of the normals in this step."""
        return self.normal_weight if step > self.normal_first else 0.0

    def shrink_at(self, step: int) -> int:
        """Return by how much the photos' sides are divided in this step: 4, 2 or 1."""
        if step <= self.quarter_last:
            return 4
        return 2 if step <= self.half_last else 1

    def moves_poses_in(self, step: int) -> bool:
        """Say whether the pose of this step's photo is learned."""
        return self.pose_first < step <= self.pose_last

    def most_gaussians_at(self, step: int) -> int:
        """Return how many Gaussians there may be after this step."""
        return self.early_most if step <= self.early_last else self.most_gaussians

    def sh_degree_at(self, step: int) -> int:
        """Return the degree with which this step is drawn."""
        return min(self.sh_degree, (step - 1) // self.sh_every)


def _grad_threshold(settings: TrainSettings) -> float:
    unsigned = _ABSOLUTE_FACTOR if settings.absolute_gradients else 1.0
    return settings.grad_threshold * unsigned * math.sqrt(max(1.0, _FULL_STEPS / settings.steps))


def means_rate(settings: TrainSettings, step: int) -> float:
    """Return the learning rate of centres at a step, in scene extents: exponential from first to last step."""
    return decayed(settings.lr_means, settings.lr_means_final, step, settings.steps)


def camera_rate(settings: TrainSettings, step: int) -> float:
    """Return the learning rate of poses at a step: exponential from first to last step of the run."""
    return decayed(settings.lr_camera, settings.lr_camera_final, step, settings.steps)


def decayed(first: float, last: float, step: int, steps: int) -> float:
    """Return ``first`` at step 1, ``last`` at step ``steps``, exponential between; where one is 0, ``first``."""
    if steps == 1 or first == 0 or last == 0:
        return first
    share = (step - 1) / (steps - 1)
    return math.exp((1 - share) * math.log(first) + share * math.log(last))
