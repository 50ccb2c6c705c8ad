"""Table 3 of the drone paper (A-3DGS): its rows, its figures, and which stages its times are made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

PAPER = "a-3dgs"

Part = Literal["poses", "scene", "not counted"]

#: The stage in which kernels are compiled.
COMPILE = "compile"

#: What a stage's time counts as, by the stage's name. The paper counts the making of points to the poses, and no
#: intrinsics (section 5.3) and no measuring. Visual words come with ORB-SLAM3 and are once for all scenes; kernels
#: are compiled once a machine. A stage that is not here counts in the total only, and is told.
STAGE_PARTS: Mapping[str, Part] = {
    "features": "poses",
    "matches": "poses",
    "sfm": "poses",
    "sensors": "poses",
    "slam": "poses",
    "place": "poses",
    "depth": "poses",
    "points": "poses",
    "triangulate": "poses",
    "chain": "poses",
    "flatten": "scene",
    "undistort": "scene",
    "depth-maps": "scene",
    "cf-3dgs": "scene",
    "train": "scene",
    "intrinsics": "not counted",
    "vocabulary": "not counted",
    COMPILE: "not counted",
    "measure": "not counted",
}


@dataclass(frozen=True, slots=True)
class Measure:
    """One column of the table.

    Attributes
    ----------
    key:
        Name in the CSV file.
    title:
        Heading with its unit.
    metric:
        Its name in a run's result, or how it begins where the network's name follows (``test.lpips_vgg``).
    digits:
        After the decimal point.
    better:
        Which way it is better.
    """

    key: str
    title: str
    metric: str
    digits: int
    better: Literal["higher", "lower"]


#: The measures that Table 3 has.
MEASURES = (
    Measure("psnr", "PSNR (dB)", "test.psnr", 3, "higher"),
    Measure("ssim", "SSIM", "test.ssim", 3, "higher"),
    Measure("lpips", "LPIPS", "test.lpips", 3, "lower"),
    Measure("pos", "POS (m)", "poses.sim3.pos", 3, "lower"),
    Measure("rot", "ROT (°)", "poses.sim3.rot_deg", 3, "lower"),
    Measure("ate", "ATE (m)", "poses.sim3.ate", 3, "lower"),
)

#: What we add: poses that claim a metric frame as they are, and the error from neighbour to neighbour.
MORE_MEASURES = (
    Measure("pos_unaligned", "POS unaligned (m)", "poses.none.pos", 3, "lower"),
    Measure("rot_unaligned", "ROT unaligned (°)", "poses.none.rot_deg", 3, "lower"),
    Measure("ate_unaligned", "ATE unaligned (m)", "poses.none.ate", 3, "lower"),
    Measure("rpe_translation", "RPE (m)", "poses.rpe.translation", 3, "lower"),
    Measure("rpe_rotation", "RPE (°)", "poses.rpe.rotation_deg", 3, "lower"),
    Measure("psnr_refined", "PSNR, test poses fitted (dB)", "test_refined.psnr", 3, "higher"),
)

#: Parts of the time, in the table's order.
TIMES = ("poses", "scene", "total")


@dataclass(frozen=True, slots=True)
class PaperFigures:
    """A row of the paper's table; None where it has a dash. Times in seconds; ``scenes`` are in the means."""

    psnr: float
    ssim: float
    lpips: float
    pos: float | None
    rot: float | None
    ate: float | None
    poses: float | None
    scene: float | None
    total: float
    scenes: int = 5


@dataclass(frozen=True, slots=True)
class PaperRow:
    """A method of the table.

    Attributes
    ----------
    key:
        As on the command line.
    title:
        As in the table.
    recipe:
        Name of the recipe that runs it.
    changes:
        Settings that differ from the recipe's defaults, by dotted names.
    needs:
        What it cannot do without beside pictures.
    paper_title, paper:
        The paper's own row, where it has this method.
    """

    key: str
    title: str
    recipe: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    needs: Literal["", "gps", "gps and gimbal", "video"] = ""
    paper_title: str = ""
    paper: PaperFigures | None = None


def _clock(text: str) -> float:
    hours, minutes, seconds = (int(part) for part in text.split(":"))
    return float(3600 * hours + 60 * minutes + seconds)


#: Rows in the table's order.
ROWS = (
    PaperRow(
        "colmap-3dgs",
        "COLMAP + 3DGS",
        "colmap-3dgs",
        {"pairs.method": "exhaustive"},
        paper_title="COLMAP + 3DGS",
        paper=PaperFigures(
            31.219, 0.916, 0.122, None, None, None, _clock("00:29:10"), _clock("00:30:30"), _clock("00:59:41")
        ),
    ),
    PaperRow(
        "colmap-3dgs-spatial",
        "COLMAP + 3DGS, spatial pairs",
        "colmap-3dgs",
        {"pairs.method": "spatial"},
        needs="gps",
    ),
    PaperRow(
        "cf-3dgs",
        "CF-3DGS",
        "cf-3dgs",
        paper_title="CF-3DGS (540p)",
        paper=PaperFigures(22.536, 0.610, 0.253, 4.732, 12.283, 5.567, None, None, _clock("02:20:10"), scenes=3),
    ),
    PaperRow(
        "cf-3dgs-ground",
        "CF-3DGS from the ground plane (no depth network)",
        "cf-3dgs",
        {"depth.provider": "ground"},
        needs="gps and gimbal",
    ),
    PaperRow(
        "noposegs",
        "NoposeGS",
        "noposegs",
        paper_title="NoposeGS",
        paper=PaperFigures(20.801, 0.522, 0.546, 33.365, 51.551, 35.794, None, None, _clock("00:35:48")),
    ),
    PaperRow("noposegs-plane", "NoposeGS from planes (no depth network)", "noposegs", {"start": "plane"}),
    PaperRow(
        "orbslam-noposegs",
        "ORBSLAM-NoposeGS",
        "orbslam-noposegs",
        needs="video",
        paper_title="ORBSLAM-NoposeGS",
        paper=PaperFigures(
            26.735, 0.785, 0.290, 0.318, 1.148, 0.344, _clock("00:05:20"), _clock("00:19:38"), _clock("00:24:58")
        ),
    ),
    PaperRow("orb-pnp-noposegs", "ORB-PnP-NoposeGS (our simpler SLAM)", "orb-pnp-noposegs", needs="video"),
    PaperRow(
        "sensor-dpt",
        "Sensor-DPT",
        "sensor-dpt",
        needs="gps and gimbal",
        paper_title="Sensor-DPT",
        paper=PaperFigures(
            24.710, 0.698, 0.372, 0.615, 0.856, 0.666, _clock("00:00:31"), _clock("00:17:12"), _clock("00:17:43")
        ),
    ),
    PaperRow("sensor-ground", "Sensor poses, ground plane", "sensor-ground", needs="gps and gimbal"),
    PaperRow("sensor-3dgs", "Sensor poses, matched points", "sensor-3dgs", needs="gps and gimbal"),
    PaperRow("sensor-fused", "Sensors fused with pictures", "sensor-fused", needs="gps"),
    PaperRow(
        "sensor-fused-slam",
        "Sensors fused with pictures and SLAM (ORB-PnP)",
        "sensor-fused",
        {"slam.backend": "orb-pnp"},
        needs="video",
    ),
)

#: What a reader of the table must know of the paper's figures and of how ours are made.
NOTES = (
    "Rows marked *paper* are Table 3 of the paper: means over five scenes of JB3D (1920 x 1080, 30,000 steps, "
    "NVIDIA L40, 40 cores); other pictures, sizes and steps than ours: only the order of methods can be compared.",
    "The paper's text and its table disagree on POS: section 4.2.2 says that the trajectory from sensor data has "
    "the lower absolute position error, the table has 0.615 m for Sensor-DPT and 0.318 m for ORBSLAM-NoposeGS.",
    "Our means leave out failed scenes, as the paper's do for CF-3DGS; n says how many of the data sets are in "
    "each row. Rows with different n are not means of the same scenes.",
    "The paper runs all methods on the keyframes that ORB-SLAM3 chose; ours take the pictures of the data sets (of "
    "the filmed flights every sixth or eighth frame), and every eighth picture is a test picture, as in the paper.",
    "Rows without a depth network are none of the paper's methods: they stand in where the network's weights are "
    "missing. The ground plane lies under the poses from GPS and gimbal, which CF-3DGS itself does without.",
    "CF-3DGS and NoposeGS bring the depth maps of adjacent frames to one scale (chain.match_scale), of which their "
    "papers say nothing.",
    "POS, ROT and ATE are after Sim(3) alignment to the reference; unaligned ones are given where the method "
    "claims the metric frame of the data. RPE is the root mean square from neighbour to neighbour after it.",
    "Poses is the time up to poses and first points, scene that of undistortion and training; measuring, the "
    "compiling of kernels (once a machine) and the training of visual words (once for all) are left out. Methods "
    "that find poses and scene together have a total only. Stages that another run had already computed count with "
    "the time that they took there.",
)
