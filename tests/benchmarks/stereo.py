"""Time and memory of the CPU stereo: how they grow with pixels, source views and depth range.

``python tests/benchmarks/stereo.py`` renders a slanted, textured plane and searches it once for each entry. Every
table begins with the same base (4 views, depths within a factor of 2), so that ratios are of one run. Only the
search of one picture is timed: the photometric pass, and the one that uses other pictures' depth. Kernels are
compiled before.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from toolkit.depth.patchmatch import StereoView, patch_match
from toolkit.depth.stereo_settings import PatchMatchSettings
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.compiled import thread_count
from toolkit.geometry.rigid import RigidTransform

BASE_VIEWS, BASE_RANGE, DISTANCE = 4, 2.0, 3.0


def plane_views(width: int, height: int, views: int) -> tuple[list[StereoView], np.ndarray[Any, Any]]:
    """Return a picture and its source views on a circle about it, all with true depth, and the picture's depth."""
    rng = np.random.default_rng(0)
    sheet = ndimage.gaussian_filter(rng.random((1024, 1024)), 1.5, mode="wrap")
    sheet = (sheet - sheet.min()) / (sheet.max() - sheet.min())
    normal = np.array([0.4, 0.2, -1.0]) / np.linalg.norm([0.4, 0.2, -1.0])
    first = np.cross(normal, [0, 1, 0]) / np.linalg.norm(np.cross(normal, [0, 1, 0]))
    second = np.cross(normal, first)
    camera = ColmapCamera.pinhole(width, height, 0.9 * width)
    around = 2 * np.pi * np.arange(views) / views
    centres = np.vstack([[0, 0], 0.4 * np.stack([np.cos(around), np.sin(around)], axis=1)])
    rows, columns = np.indices((height, width)).reshape(2, -1)
    made = []
    for x, y in centres:
        pose = RigidTransform.look_at([x, y, -DISTANCE], [0, 0, 0], (0, -1, 0))
        in_camera = camera.ray(np.stack([columns, rows], axis=1) + 0.5)[1]
        along = in_camera @ pose.rotation
        distance = -(pose.centre @ normal) / (along @ normal)
        points = pose.centre + along * distance[:, None]
        at = 0.33 * width * np.stack([points @ first, points @ second])
        grey = ndimage.map_coordinates(sheet, at, order=1, mode="wrap").reshape(height, width)
        depth = (distance * in_camera[:, 2]).reshape(height, width).astype(np.float32)
        made.append(StereoView(grey.astype(np.float32), camera, pose, depth))
    depth_of_first = made[0].depth
    assert depth_of_first is not None
    return made, depth_of_first


def measure(
    size: tuple[int, int], views: int, spread: float, settings: PatchMatchSettings, repeats: int
) -> dict[str, Any]:
    """Return the median seconds of both passes, those per megapixel, and the errors of what is found."""
    pictures, truth = plane_views(*size, views)
    # Depths of the plane lie within 2.2 and 4.7.
    ends = (DISTANCE / spread / 1.4, DISTANCE * spread * 1.4)
    first, second = [], []
    for seed in range(repeats):
        start = time.perf_counter()
        planes = patch_match(pictures[0], pictures[1:], ends, settings, seed=seed)
        first.append(time.perf_counter() - start)
        start = time.perf_counter()
        planes = patch_match(pictures[0], pictures[1:], ends, settings, seed=seed, start=planes)
        second.append(time.perf_counter() - start)
    error = np.abs(planes.depth / truth - 1)[10:-10, 10:-10]
    total = statistics.median(first) + statistics.median(second)
    return {
        "size": list(size),
        "views": views,
        "range": spread,
        "search_s": statistics.median(first),
        "refine_s": statistics.median(second),
        "s_per_megapixel": total / (size[0] * size[1] / 1e6),
        "median_error": float(np.median(error)),
        "within_1pct": float(np.mean(error < 0.01)),
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def table(name: str, rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Print rows as they come, with the time relative to the first, and return them."""
    print(f"\n{name}\n{'size':>10} views range  search  refine    s/MP  ratio  median error  within 1 %  peak MiB")
    kept: list[dict[str, Any]] = []
    for row in rows:
        kept.append(row)
        row["ratio"] = row["s_per_megapixel"] / kept[0]["s_per_megapixel"]
        size = "x".join(map(str, row["size"]))
        print(
            f"{size:>10} {row['views']:5d} {row['range']:5g} {row['search_s']:7.2f} {row['refine_s']:7.2f} "
            f"{row['s_per_megapixel']:7.1f} {row['ratio']:6.2f} {row['median_error']:12.2%} "
            f"{row['within_1pct']:11.1%} {row['peak_mib']:9.0f}",
            flush=True,
        )
    return kept


def main() -> None:
    """Measure and print; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--size", default="384x256", help="of the pictures in the tables of views and ranges")
    parser.add_argument("--sizes", default="192x128,384x256,768x512", help="of the table of sizes, base first")
    parser.add_argument("--views", default="4,1,2,8", help="numbers of source views")
    parser.add_argument("--ranges", default="2,4,16", help="factors from the middle of the depths to both ends")
    parser.add_argument("--repeats", type=int, default=1, help="runs of each entry, of which the median counts")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    settings = PatchMatchSettings()

    def pair(text: str) -> tuple[int, int]:
        width, _, height = text.partition("x")
        return int(width), int(height)

    size, repeats = pair(options.size), options.repeats
    measure((64, 48), 2, BASE_RANGE, settings, 1)  # compiles
    threads = thread_count()
    print(f"{threads} threads, windows of radius {settings.radius} and step {settings.step}")
    found = {
        "views": table(
            "Source views",
            (measure(size, int(n), BASE_RANGE, settings, repeats) for n in options.views.split(",")),
        ),
        "ranges": table(
            "Depth range",
            (measure(size, BASE_VIEWS, float(f), settings, repeats) for f in options.ranges.split(",")),
        ),
        "sizes": table(
            "Size", (measure(pair(s), BASE_VIEWS, BASE_RANGE, settings, repeats) for s in options.sizes.split(","))
        ),
    }
    if options.json is not None:
        options.json.write_text(json.dumps({"threads": threads, **found}, indent=2), encoding="utf-8")


if __name__ == "__main__":
    main()
