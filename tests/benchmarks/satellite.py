"""Measures surface models from satellite pictures: a computed city against its truth, and a real triplet.

``python tests/benchmarks/satellite.py --data city`` makes the city of 20 views (256 m, 0.5 m a pixel), corrects its
RPCs by tie points, and matches heights over the ground in all views, then in k views that are most spread, least
spread and random. ``TOOLKIT_DATA=<folder> python tests/benchmarks/satellite.py --data pleiades`` does so with the
triplet ``sat_pleiades_s2p`` and compares with the surface model that lies beside it: another program's, no ground
truth.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from toolkit.depth.height_dsm import heights_on
from toolkit.depth.height_map import match_heights
from toolkit.depth.height_settings import HeightSettings
from toolkit.geometry.ground_grid import GroundGrid
from toolkit.matching.match_tracks import match_tracks
from toolkit.matching.scene_matches import match_scene
from toolkit.metrics.elevation import ElevationErrors, compare_heights
from toolkit.poses.satellite import ground_box, pictures_to_match, refine_satellite, with_affine_cameras
from toolkit.progress import TqdmProgress
from toolkit.recipes.satellite_steps import SatelliteSettings, ground_views
from toolkit.samples.city import CitySettings, make_city
from toolkit.samples.registry import locate
from toolkit.scene import Scene
from toolkit.scene.dsm_files import SurfaceModel, read_dsm
from toolkit.scene.satellite import open_satellite
from toolkit.views.fisher import select_views
from toolkit.views.settings import ViewSelectionSettings

HEAD = ("views", "MAE m", "RMSE m", "median m", "spread m", "within 1 m", "s")


def agreeing(scene: Scene, work: Path) -> tuple[Scene, np.ndarray]:
    """Return the scene with affine cameras that agree and pictures of eight bits, and the box of its ground."""
    bar, settings = TqdmProgress(), SatelliteSettings()
    pictures = pictures_to_match(scene, work, progress=bar)
    start = time.perf_counter()
    found = match_scene(pictures, work / "matches.db", settings.sift, settings.pairs, settings.match, progress=bar)
    bar.close()
    refined = refine_satellite(scene, match_tracks(found.database, pictures), settings.refine)
    told = refined.to_dict()
    print(
        f"{len(scene)} views, {told['points']} tie points: residuals {told['rms_before_px']:.2f} px as delivered, "
        f"{told['rms_px']:.2f} px corrected; {time.perf_counter() - start:.0f} s"
    )
    box = ground_box(refined.scene, margin=settings.margin)
    local, fitted = with_affine_cameras(refined.scene, box, pictures)
    print(
        f"affine cameras over {box[1] - box[0]} m: {max(one.rms_px for one in fitted):.3f} px rms, "
        f"{max(one.max_px for one in fitted):.3f} px at most, of the worst view"
    )
    return local, box


def measure(
    scene: Scene, chosen: Sequence[int], box: np.ndarray, truth: SurfaceModel, resolution: float
) -> tuple[ElevationErrors, np.ndarray, float]:
    """Return the errors of heights matched in some views, the heights on the truth's grid, and seconds."""
    views = ground_views(scene, [scene.frames[number] for number in chosen])
    grid = GroundGrid.over(box, resolution)
    start = time.perf_counter()
    made = match_heights(views, grid, (float(box[0, 2]), float(box[1, 2])), HeightSettings())
    seconds = time.perf_counter() - start
    assert scene.georeference is not None
    found = heights_on(made.heights, grid, scene.georeference, truth)
    return compare_heights(found, truth.heights, truth.resolution), found, seconds


def line(title: str, errors: ElevationErrors, seconds: float) -> None:
    """Print a row."""
    cells = [
        f"{errors.mean_absolute:.2f}",
        f"{errors.root_mean_square:.2f}",
        f"{errors.median_absolute:.2f}",
        f"{errors.spread:.2f}",
        f"{errors.completeness:.1%}",
        f"{seconds:.0f}",
    ]
    print(f"| {title} | {' | '.join(cells)} |", flush=True)


def picture(path: Path, found: np.ndarray, truth: np.ndarray, differences: np.ndarray) -> None:
    """Write found and true heights as relief and their differences, -5 to 5 m, side by side."""
    middle = 127 + 25.4 * np.clip(np.nan_to_num(differences), -5, 5)
    parts = [_relief(found), _relief(truth), middle.astype(np.uint8)]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.hstack(parts)).save(path)


def _relief(heights: np.ndarray) -> np.ndarray:
    down, right = np.gradient(heights)
    light = (1 + 0.7 * right - 0.7 * down) / np.sqrt(1 + right**2 + down**2)
    return np.clip(110 * np.nan_to_num(light), 0, 255).astype(np.uint8)


def city(work: Path, counts: Sequence[int], seeds: int) -> None:
    """Measure the city."""
    bar = TqdmProgress()
    sample = make_city(work / "city", CitySettings(), progress=bar)
    bar.close()
    scene, box = agreeing(sample.scene, work / "city-work")
    half = 0.5 * sample.settings.plan.size
    box[:, :2] = [[-half, -half], [half, half]]
    truth = read_dsm(sample.dsm_map)
    print(f"\n| {' | '.join(HEAD)} |\n{'|---' * len(HEAD)}|")
    errors, found, seconds = measure(scene, range(len(scene)), box, truth, 0.5)
    line(f"all {len(scene)}", errors, seconds)
    picture(work / "pictures" / "city.png", found, truth.heights, errors.differences)
    towards = np.stack([view.satellite for view in sample.views])
    for k in counts:
        for spread in ("most", "least"):
            chosen = select_views(towards, k, ViewSelectionSettings(spread=spread)).chosen
            errors, _, seconds = measure(scene, chosen, box, truth, 0.5)
            line(f"{k}, {spread} spread", errors, seconds)
        for seed in range(seeds):
            chosen = np.random.default_rng(seed).choice(len(scene), k, replace=False).tolist()
            errors, _, seconds = measure(scene, chosen, box, truth, 0.5)
            line(f"{k}, random {seed}", errors, seconds)


def pleiades(work: Path) -> None:
    """Measure the real triplet."""
    folder = locate("sat_pleiades_s2p")
    if folder is None:
        raise SystemExit("sat_pleiades_s2p is not here: set TOOLKIT_DATA to the folder that has it")
    triplet = folder / "triplet"
    scene, box = agreeing(open_satellite(sorted(triplet.glob("img_*.tif"))), work / "pleiades")
    truth = read_dsm(triplet / "expected_dsm.tif")
    print(f"\n| {' | '.join(HEAD)} |\n{'|---' * len(HEAD)}|")
    errors, found, seconds = measure(scene, range(len(scene)), box, truth, truth.resolution)
    line("3", errors, seconds)
    print(f"moved by {errors.east:.2f} m east, {errors.north:.2f} m north, {errors.up:.2f} m up")
    picture(work / "pictures" / "pleiades.png", found, truth.heights, errors.differences)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument(
        "--data", nargs="+", choices=("city", "pleiades"), default=["city", "pleiades"], help="[both]"
    )
    parser.add_argument("--views", type=int, nargs="*", default=[3, 5, 8, 12], help="numbers of views [3 5 8 12]")
    parser.add_argument("--seeds", type=int, default=2, help="random choices of views [2]")
    parser.add_argument("--work", type=Path, default=Path("runs/bench-satellite"), help="folder")
    options = parser.parse_args()
    if "city" in options.data:
        city(options.work, options.views, options.seeds)
    if "pleiades" in options.data:
        pleiades(options.work)


if __name__ == "__main__":
    main()
