"""Engine footage for measurements: made, masked, matched and reconstructed, and judged by its truth."""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.capture.mask_files import with_mask
from toolkit.errors import StageError, ToolkitError
from toolkit.matching.feature_choice import FeatureSettings, extract_features, match_features
from toolkit.matching.match import MatchReport
from toolkit.matching.pairs import PairSettings, choose_pairs
from toolkit.metrics.circle import fit_circle
from toolkit.poses.blade_edges import EdgeSettings, find_edges, straight_ones
from toolkit.poses.camera_start import counted_as_measured, plain_cameras, with_cameras
from toolkit.poses.edge_adjust import EdgeAdjustment, adjust_with_edges
from toolkit.poses.sfm import incremental_sfm
from toolkit.poses.sfm_result import SfmResult
from toolkit.poses.two_step import PassResult, one_step
from toolkit.recipes.blades import faint_features, small_step_sfm
from toolkit.runs.blades_table import START_FOCAL
from toolkit.samples.engine import EngineSample, EngineSettings, make_engine
from toolkit.scene import Scene
from toolkit.scene.colmap import colmap_camera
from toolkit.scene.pictures import load_grey

KNOWN = {"refine_focal": False, "refine_distortion": False, "refine_principal_point": False}


@dataclass(frozen=True, slots=True)
class Found:
    """What a way of matching led to."""

    report: MatchReport
    sfm: SfmResult | None
    reason: str
    seconds_features: float
    seconds_sfm: float
    database: Path


def engine(work: Path, **film: float) -> EngineSample:
    """Return footage, made where it is not there."""
    name = "-".join(f"{key}{value:g}" for key, value in film.items())
    settings = EngineSettings().replace({f"film.{key}": value for key, value in film.items()})
    return make_engine(work / f"engine-{name}", settings)


def masked(sample: EngineSample, work: Path) -> Scene:
    """Return the footage without poses, with the true mask of what does not turn."""
    folder = work / f"masks-{sample.folder.name}"
    return with_mask(sample.scene.without_poses(), sample.static_mask, folder)


def unknown_lens(scene: Scene) -> Scene:
    """Return the scene with a camera that is a guess: 0.8 widths, undistorted (the true one has 0.64 widths)."""
    width = max(camera.width for camera in scene.cameras.values())
    plain = plain_cameras(scene, "SIMPLE_RADIAL", START_FOCAL * width)
    return with_cameras(scene, counted_as_measured(plain, False))


def with_lens_found(scene: Scene, database: Path, work: Path) -> PassResult:
    """Reconstruct with an OPENCV_FISHEYE that is found with the poses and starts undistorted."""
    return one_step(scene, database, "OPENCV_FISHEYE", small_step_sfm(), work_dir=work)


def with_edges(found: PassResult, sample: EngineSample, every: int = 12) -> EdgeAdjustment:
    """Let straight edges of every twelfth frame take part in the adjustment."""
    scene = found.scene
    lens = colmap_camera(scene, scene.frames[0].camera_id).to_pycolmap()
    edges = []
    for frame in scene.registered[::every]:
        picture = load_grey(scene.image_path(frame))
        edges += find_edges(picture, EdgeSettings(), mask=~sample.static_mask)
    return adjust_with_edges(
        scene,
        straight_ones(lens, edges),
        refine_principal_point=found.sfm.adjustment.principal_point == "refined",
    )


def reconstruct(
    scene: Scene, work: Path, pairs: PairSettings, features: FeatureSettings | None = None, *, sfm: bool = True
) -> Found:
    """Match a scene and, where asked for, reconstruct it with its lens, which is kept."""
    chosen = features or faint_features()
    database = work / "matches.db"
    work.mkdir(parents=True, exist_ok=True)
    extracted = extract_features(scene, database, chosen.chosen_features)
    report = match_features(database, scene, choose_pairs(scene, pairs), chosen.chosen_matching)
    start, result, reason = time.perf_counter(), None, ""
    if sfm:
        try:
            result = incremental_sfm(scene, database, small_step_sfm().replace(KNOWN), work_dir=work)
        except ToolkitError as error:
            reason = str(error).splitlines()[0]
    return Found(report, result, reason, extracted.seconds, time.perf_counter() - start, database)


def wrong_pairs(sample: EngineSample, found: Found) -> NDArray[np.bool_]:
    """Return (P,) which of the verified pairs of a matching are wrong."""
    report = found.report
    with closing(pycolmap.Database.open(found.database)) as database:
        keypoints = {i: database.read_keypoints(i + 1)[:, :2] for i in range(len(report.names))}
        verdicts = []
        for i, j in report.pairs[report.verified].tolist():
            rows = np.asarray(database.read_two_view_geometry(i + 1, j + 1).inlier_matches)
            right = sample.right_matches(i, j, keypoints[i][rows[:, 0]], keypoints[j][rows[:, 1]])
            verdicts.append(right.mean() < 0.5)
    return np.array(verdicts, dtype=bool)


# What is seen of blades far off, between the near ones, is a handful of points that mean nothing.
_LEAST_POINTS = 30


def blades_apart(sample: EngineSample, scene: Scene) -> tuple[int, int]:
    """Return how many blades stand apart in a reconstruction, and how many it has points of."""
    points = scene.points
    if points is None or points.tracks is None:
        return 0, 0
    place = {frame.name: number for number, frame in enumerate(sample.scene.frames)}
    order = np.array([place[frame.name] for frame in scene.frames])
    first = np.unique(points.tracks.point, return_index=True)[1]
    frames, pixels = order[points.tracks.frame[first]], points.tracks.pixel[first]
    blade, truth = np.full(len(points), -1), np.full((len(points), 3), np.nan)
    for number in np.unique(frames):
        rows = np.flatnonzero(frames == number)
        surface = sample.surface(int(number), pixels[rows])
        blade[points.tracks.point[first[rows]]] = surface.blades
        truth[points.tracks.point[first[rows]]] = surface.points
    kept = [b for b in np.unique(blade) if b >= 0 and (blade == b).sum() >= _LEAST_POINTS]
    if not kept:
        return 0, 0
    found, size = _middles(points.xyz, blade, kept)
    true, true_size = _middles(truth, blade, kept)
    # Of one blade with points of others the size is anything; of most it gives the scale.
    least = 0.5 * float(np.median(size / true_size)) * true
    np.fill_diagonal(least, -1.0)
    return int((found >= least).all(axis=1).sum()), len(kept)


def _middles(
    xyz: NDArray[np.float64], blade: NDArray[np.int64], kept: list[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return distances (B, B) between the middles of blades, and their sizes (B,)."""
    middles = np.array([np.nanmedian(xyz[blade == b], axis=0) for b in kept])
    sizes = [
        np.nanmedian(np.linalg.norm(xyz[blade == b] - middle, axis=1))
        for b, middle in zip(kept, middles, strict=True)
    ]
    return np.linalg.norm(middles[:, None] - middles[None], axis=2), np.array(sizes)


def arc_of(scene: Scene) -> str:
    """Return the arc of the cameras, or that there is none."""
    try:
        return f"{fit_circle(scene.centres()).arc_degrees:.1f}"
    except StageError:
        return "no circle"


def row(*cells: object) -> None:
    """Print a line of a table."""
    print("| " + " | ".join(str(cell) for cell in cells) + " |", flush=True)


def head(title: str, *columns: str) -> None:
    """Print the beginning of a table."""
    print(f"\n### {title}\n")
    row(*columns)
    print("|" + "---|" * len(columns), flush=True)


def told(sample: EngineSample, name: str, found: Found, wrong: int) -> None:
    """Print a way of matching and what it led to."""
    verified = int(found.report.verified.sum())
    cells = [name, len(found.report.pairs), verified, wrong]
    if found.sfm is None:
        row(*cells, found.reason, "", "", "", f"{found.report.seconds:.0f}", "")
        return
    scene = found.sfm.scene
    apart, there = blades_apart(sample, scene)
    placed = f"{len(scene.registered)} of {len(scene)}"
    row(
        *cells,
        placed,
        arc_of(scene),
        f"{apart} of {there}",
        0 if scene.points is None else len(scene.points),
        f"{found.report.seconds:.0f}",
        f"{found.seconds_sfm:.0f}",
    )


COLUMNS = (
    *("", "pairs", "verified", "wrong", "placed", "arc (deg)", "blades apart", "points", "matching (s)", "sfm (s)"),
)
