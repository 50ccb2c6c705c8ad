"""Settings of multi-view stereo, of what is rejected before fusion, of fusion and of depth from elsewhere."""

from __future__ import annotations

from toolkit.depth.settings import DepthSettings
from toolkit.settings import Boolean, Choice, Group, Integer, Number, Settings


class ViewChoiceSettings(Settings):
    """Which pictures each picture is compared with."""

    views = Integer(5, bounds=(1, 32), unit="views", doc="Most source views of a picture.")
    best_angle = Number(
        10.0, bounds=(0.1, 90.0), unit="degrees", doc="Triangulation angle that is preferred, at the shared points."
    )
    min_angle = Number(
        1.0,
        bounds=(0.0, 90.0),
        unit="degrees",
        doc="Views whose rays meet under less, in the median, are not used.",
    )
    max_angle = Number(
        60.0,
        bounds=(1.0, 179.0),
        unit="degrees",
        doc="Views whose rays meet under more, in the median, are not used.",
    )
    min_shared = Integer(10, bounds=(1, 100000), unit="points", doc="Fewest points that two pictures must share.")


class PatchMatchSettings(Settings):
    """Search for a plane at each pixel by propagation and random refinement."""

    levels = Integer(3, bounds=(1, 6), doc="Sizes of the picture, each half the next, coarse to fine.")
    iterations = Integer(3, bounds=(1, 20), doc="Rounds over all pixels at each size; the smallest has two more.")
    radius = Integer(5, bounds=(1, 15), unit="px", doc="Half the side of the window that is compared.")
    step = Integer(
        2, bounds=(1, 5), unit="px", doc="Every how many rows and columns of the window one is compared."
    )
    best = Integer(
        2,
        bounds=(1, 32),
        unit="views",
        doc="The cost is the mean over so many views that agree best; others may be hidden.",
    )
    sigma_colour = Number(
        0.1,
        bounds=(0.01, 10.0),
        doc="Difference of brightness (0 to 1) at which a pixel of the window counts less.",
    )
    geometric = Boolean(
        True, doc="After all pictures: a second search in which planes should agree with the other pictures' depth."
    )
    geometric_weight = Number(
        0.2, bounds=(0.0, 2.0), unit="1/px", doc="Cost of a pixel of disagreement, in that second search."
    )
    margin = Number(
        25.0, bounds=(0.0, 1000.0), unit="%", doc="By how much the range of depth is wider than that of the points."
    )


class RejectSettings(Settings):
    """Pixels that are rejected before fusion: what makes fused clouds noisy."""

    border = Integer(
        8, bounds=(0, 1000), unit="px", doc="Pixels nearer to the picture's border; windows there lack a side."
    )
    mask_margin = Integer(2, bounds=(0, 100), unit="px", doc="Pixels nearer to a masked one than this.")
    min_texture = Number(
        0.008, bounds=(0.0, 1.0), doc="Pixels whose window varies less (standard deviation of brightness, 0 to 1)."
    )
    min_confidence = Number(
        0.5, bounds=(0.0, 1.0), doc="Pixels whose correlation with the best views is lower (1: equal; 0: none)."
    )
    edge = Number(
        3.0,
        bounds=(0.0, 1000.0),
        unit="%",
        doc="Pixels at a step of depth: their depth and a neighbour's plane differ by more; 0: none is.",
    )
    min_views = Integer(
        2, bounds=(0, 32), unit="views", doc="Fewest other views that must confirm a pixel's depth."
    )
    max_pixels = Number(
        1.5,
        bounds=(0.01, 100.0),
        unit="px",
        doc="A view confirms what comes back this near when projected there and back.",
    )
    max_depth = Number(
        1.0, bounds=(0.001, 100.0), unit="%", doc="A view confirms what has this depth in it, up to so much."
    )
    min_island = Integer(
        20,
        bounds=(0, 1000000),
        unit="px",
        doc="Connected pixels of similar depth that are fewer than this; 0: none.",
    )


class StereoSettings(Settings):
    """Multi-view stereo: which views, which search, what is rejected."""

    method = Choice(
        "cpu",
        choices=("cpu", "colmap-cuda"),
        doc="cpu: PatchMatch of this toolkit; colmap-cuda: that of pycolmap, which needs a build with CUDA.",
    )
    max_side = Integer(
        1024,
        bounds=(32, 100000),
        unit="px",
        doc="Longest side of the pictures; larger ones are made smaller first.",
    )
    choice = Group(ViewChoiceSettings(), doc="Source views")
    search = Group(PatchMatchSettings(), doc="PatchMatch")
    reject = Group(RejectSettings(), doc="What is rejected before fusion")


class ExternalSettings(Settings):
    """Depth from elsewhere, fitted to the sparse points of each picture."""

    use = Choice(
        "fill",
        choices=("replace", "fill", "with"),
        doc="replace: no stereo; fill: only where stereo has none; with: the mean of both, weighted by confidence, "
        "where they agree, else stereo where there is any.",
    )
    agree = Number(5.0, bounds=(0.01, 100.0), unit="%", doc="Difference of depth up to which both agree.")
    confidence = Number(
        0.5, bounds=(0.0, 1.0), doc="Confidence of depth whose provider gives none; falls with the fit's residual."
    )
    border = Integer(4, bounds=(0, 1000), unit="px", doc="Pixels nearer to the picture's border are left out.")
    edge = Number(
        5.0,
        bounds=(0.0, 1000.0),
        unit="%",
        doc="Pixels at a step of depth larger than this are left out; 0: none is.",
    )
    depth = Group(DepthSettings(provider="arrays"), doc="Where depth comes from and how it is scaled")


class FusionSettings(Settings):
    """How depth maps become one cloud: COLMAP's fusion."""

    min_pixels = Integer(3, bounds=(1, 1000), unit="pixels", doc="Fewest pixels of different views in a point.")
    max_pixels = Number(
        2.0, bounds=(0.1, 100.0), unit="px", doc="Reprojection error up to which pixels are joined."
    )
    max_depth = Number(1.0, bounds=(0.001, 100.0), unit="%", doc="Difference of depth up to which they are.")
    max_normal = Number(25.0, bounds=(0.1, 180.0), unit="degrees", doc="Angle of normals up to which they are.")
    check_views = Integer(
        50, bounds=(1, 10000), unit="views", doc="Views that are searched for a pixel's partners."
    )
