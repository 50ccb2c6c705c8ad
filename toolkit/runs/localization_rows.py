"""Rows of the tables on localisation (uav-splat-localization), and the figures that the paper published."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from toolkit.runs.paper_rows import PaperRow

#: The paper's maps in its order, and ours.
ROWS: Final = (
    PaperRow("2dgs-sparse", "2DGS, sparse start", "2dgs-sparse", {}),
    PaperRow("2dgs-dense", "2DGS, dense start", "2dgs-dense", {}),
    PaperRow("2dgs-dense-pos", "2DGS, dense start, positions held", "2dgs-dense-pos", {}),
    PaperRow("2dgs-held", "2DGS, dense start, depth held to stereo (ours)", "2dgs-held", {}),
)
#: Ways to find a pose, as a run's measures name them, in the table's order; others follow under their own names.
MODES: Final[Mapping[str, str]] = {
    "paper": "one shot, SuperPoint + LightGlue (the paper's method)",
    "one-shot-aliked": "one shot, ALIKED + LightGlue",
    "one-shot-disk": "one shot, DISK + LightGlue",
    "one-shot-sift": "one shot, SIFT",
    "ours": "ours",
}
#: Those whose absence from a run is told, and how.
EXPECTED: Final = ("paper", "ours")
NOT_RUN: Final = "not run"
SCENARIOS: Final = ("sfm-train", "sfm-test", "calc-test", "sfm-test-pos10")


@dataclass(frozen=True, slots=True)
class MapFigures:
    """A map's row in the paper's Tables 1 and 2; None where it has none.

    Attributes
    ----------
    start, final:
        Gaussians before and after training.
    iterations:
        Of the training that the row is about.
    psnr_7000, psnr:
        In dB, at 7,000 iterations and at the end; of which pictures the paper does not say.
    seconds:
        Of training.
    c2c:
        Median cloud-to-cloud distance in metres.
    """

    start: int
    final: int
    iterations: int
    psnr_7000: float
    psnr: float | None
    seconds: float
    c2c: float


@dataclass(frozen=True, slots=True)
class PoseFigures:
    """A row of the paper's Table 3, metres and degrees; ``start_mte`` None where it has none."""

    mte: float
    rmse_t: float
    mre: float
    rmse_r: float
    start_mte: float | None = None


#: Tables 1 and 2. The third map ran out of memory at 14,450 iterations: its figures are of 7,000.
PAPER_MAPS: Final[Mapping[str, MapFigures]] = {
    "2dgs-sparse": MapFigures(154_563, 3_676_541, 30_000, 27.742, 31.543, 59 * 60 + 53, 0.88),
    "2dgs-dense": MapFigures(9_629_581, 5_140_024, 30_000, 28.486, 32.283, 3600 + 10 * 60 + 2, 0.85),
    "2dgs-dense-pos": MapFigures(9_629_581, 5_989_063, 7_000, 27.676, None, 18 * 60 + 27, 0.05),
}
#: Section 4.1: points of both starts, and the median distance of SfM's positions from those of GNSS in metres.
PAPER_SPARSE, PAPER_DENSE, PAPER_RESIDUAL = 154_563, 9_629_581, 0.25
#: Table 3, by map and scenario.
PAPER_POSES: Final[Mapping[str, Mapping[str, PoseFigures]]] = {
    "2dgs-sparse": {
        "sfm-train": PoseFigures(0.03, 0.04, 0.02, 0.03),
        "sfm-test": PoseFigures(0.28, 0.29, 0.11, 0.13),
        "calc-test": PoseFigures(0.50, 0.58, 0.19, 0.24),
        "sfm-test-pos10": PoseFigures(3.24, 3.91, 0.67, 1.20, 9.55),
    },
    "2dgs-dense": {
        "sfm-train": PoseFigures(0.03, 0.03, 0.02, 0.03),
        "sfm-test": PoseFigures(0.29, 0.30, 0.11, 0.14),
        "calc-test": PoseFigures(0.49, 0.60, 0.22, 0.31),
        "sfm-test-pos10": PoseFigures(3.28, 3.66, 0.58, 0.81, 9.73),
    },
    "2dgs-dense-pos": {
        "sfm-train": PoseFigures(0.06, 0.08, 0.05, 0.07),
        "sfm-test": PoseFigures(0.26, 0.27, 0.12, 0.13),
        "calc-test": PoseFigures(0.46, 0.54, 0.21, 0.26),
        "sfm-test-pos10": PoseFigures(3.77, 3.98, 0.64, 0.79, 9.60),
    },
}

#: What a reader of the tables must know of the paper's figures and of how ours are made.
NOTES: Final = (
    "Rows in italics are the paper's own figures: 77 map photos and 76 queries of a flight 80 m above a town "
    "(MARS-LVIG), pictures 1,600 pixels wide. Other pictures, sizes and steps than ours: the order of maps and "
    "starts can be compared, and by how much one start is worse than another.",
    "PSNR: ours is told of held-out queries (test) and of the pictures that a map was made from (training). The "
    "paper does not say which its own is: it stands in the column of test pictures. 7/30 is the step at that share "
    "of all steps: the paper tells 7,000 of 30,000. Its third map ran out of memory at 14,450 and has figures of "
    "7,000 alone; ours have one limit of Gaussians for all maps.",
    "C2C: median distance to the nearest point of the fused dense cloud, of the Gaussians' centres (the paper's "
    "measure) and of the rendered depth of map photos. Displacement: median distance of centres from where they "
    "started. Bias and spread: median of rendered minus true depth where the render counts as reliable, and its "
    "robust standard deviation; samples alone have a true depth.",
    "Errors are over the queries that were found, recall is over all of them; the paper does not say what became "
    "of queries that were not found. They are against the poses that structure from motion gave the queries, as "
    "the paper's; 'against truth' is the mean position error against the sample's true poses. Time is the median "
    "of a query. start: the error of the start pose itself.",
    "The paper's method is one shot with SuperPoint and LightGlue. With other features it runs under its own name; "
    f"'{NOT_RUN}' says that it did not run, for want of the network's weights or because it was not asked for.",
    "Training is the time of training alone, as the paper's. Whole map is all stages from features to training, "
    "also where one was taken from an earlier run; looking at test pictures on the way is in it.",
    "Queries placed are those that structure from motion could place in the map: their poses are the truth, and "
    "the others are in no figure.",
)
