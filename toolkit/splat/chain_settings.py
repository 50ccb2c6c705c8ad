"""Settings of what tracks frames by rendering, apart from the code: whoever reads them needs no PyTorch."""

from __future__ import annotations

from toolkit.settings import Boolean, Choice, Group, Integer, Number, Settings
from toolkit.splat.train_settings import TrainSettings


class LocalSettings(Settings):
    """The Gaussians of one frame."""

    stride = Integer(2, bounds=(1, 64), unit="px", doc="Sides of the square of pixels that gives one Gaussian.")
    opacity = Number(0.8, bounds=(0.01, 0.99), doc="Of each Gaussian before the fit.")
    width = Number(
        0.5, bounds=(0.05, 5.0), unit="strides", doc="Standard deviation before the fit, seen from the frame."
    )
    steps = Integer(100, bounds=(0, 100_000), unit="steps", doc="Of the fit to the frame's own photo.")


class RelativePoseSettings(Settings):
    """How the motion from one frame to the next is found."""

    steps = Integer(200, bounds=(1, 100_000), unit="steps", doc="Most steps on one pose, over all photo sizes.")
    lr = Number(
        6e-3, bounds=(1e-9, 1.0), unit="radians and depths", doc="Learning rate of the motion at the first step."
    )
    lr_final = Number(2e-4, bounds=(1e-9, 1.0), doc="... at the last; exponential in between.")
    lambda_dssim = Number(0.2, bounds=(0.0, 1.0), doc="Share of D-SSIM in the loss; the rest is L1.")
    min_alpha = Number(
        0.9, bounds=(0.0, 1.0), doc="Pixels that the Gaussians cover less than this are not compared."
    )
    min_overlap = Number(0.3, bounds=(0.0, 1.0), doc="Smallest share of the photo that must be covered.")
    max_loss = Number(
        0.2, bounds=(0.0, 2.0), doc="A pose is found where the loss falls to this; above, it did not converge."
    )
    patience = Integer(
        25, bounds=(1, 100_000), unit="steps", doc="A photo size is left where the loss stands still for so long."
    )
    tolerance = Number(
        1e-3, bounds=(0.0, 1.0), doc="... that is, where it does not fall by this share of the lowest so far."
    )


class ChainSettings(Settings):
    """How frames are tracked one after the other."""

    local = Group(LocalSettings(), doc="Gaussians of one frame")
    pose = Group(RelativePoseSettings(), doc="Motion to the next frame")
    match_scale = Boolean(True, doc="Scale each frame's depth so that it agrees with the frame before.")
    points_per_frame = Integer(
        500, bounds=(1, 1_000_000), doc="Of each frame's depth that become points of the scene (NoposeGS)."
    )


class Cf3dgsSettings(Settings):
    """Settings of CF-3DGS."""

    chain = Group(ChainSettings(), doc="Local Gaussians and motions between frames")
    train = Group(
        TrainSettings(densify_start=0.0, densify_stop=1.0, reset_every=0),
        doc="The global Gaussians; steps are those of the whole sequence, and lengths are in median depths of the "
        "first frame",
    )
    grow = Choice(
        "densify",
        choices=("densify", "fill"),
        doc="How the global set comes to cover what new frames show. densify: by density control alone (Fu et "
        "al.); fill: the new frame's own Gaussians are taken in, too, where nothing is yet.",
    )
    final_share = Number(
        0.0, bounds=(0.0, 1.0), unit="of steps", doc="On all frames, after the last one came; 0: none (Fu et al.)."
    )
