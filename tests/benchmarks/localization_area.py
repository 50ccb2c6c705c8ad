"""Measures localisation as the map grows: towns side by side, cut into tiles, and photos of which nothing is known.

``python tests/benchmarks/localization_area.py --towns 1 2 4 8`` builds towns of 360 x 360 m from different seeds.
Their maps are not trained: disks are put where the rays of nadir pictures meet the true surface, so that size and
time can be measured on maps that would take days to train here; what is found in them says how retrieval and tiles
do, and nothing of how good trained maps are. For every number of towns: area, Gaussians, size on disk, seconds to
make the index of places, what of the map was in memory at most, and for photos all over the area without any start
(retrieval of the five likest places, then render, match, solve) how many are found and right, and their time by
part.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.anywhere import localize_anywhere
from toolkit.localize.query import Query
from toolkit.localize.retrieval import build_place_index
from toolkit.localize.settings import LocalizeSettings
from toolkit.localize.tiles import TiledMap, write_tiles
from toolkit.matching.picture_features import picture_matcher
from toolkit.matching.picture_settings import PictureMatchSettings
from toolkit.metrics.localization import pose_errors
from toolkit.progress import TqdmProgress, track
from toolkit.samples.town import Town, TownSettings, build_town, render_view
from toolkit.splat.gaussians import SH_C0, Gaussians

SIDE, HEIGHT, SPACING = 360.0, 80.0, 55.0  # metres
CAMERA = ColmapCamera.pinhole(640, 480, 502.0)
STRIDE = 3
TILE = 60.0
NUMBERS = 3 + 4 + 3 + 1 + 3  # of a Gaussian of one colour, float32


def town(seed: int) -> Town:
    settings = TownSettings(extent=SIDE, buildings=130, trees=250)
    return build_town(settings, np.random.default_rng(seed))


def place(number: int) -> np.ndarray:
    """Return where town ``number`` lies: on a grid of streets 400 m apart, four towns in a row."""
    return np.array([400.0 * (number % 4), 400.0 * (number // 4), 0.0])


def nadir(x: float, y: float, heading: float, tilt: tuple[float, float] = (0.0, 0.0)) -> RigidTransform:
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(np.radians([*tilt, heading])).as_matrix()
    rotation = turn @ np.diag([1.0, -1.0, -1.0])
    return RigidTransform(rotation, -rotation @ np.array([x, y, HEIGHT]))


def moved(pose: RigidTransform, by: np.ndarray) -> RigidTransform:
    return RigidTransform(pose.rotation, pose.translation - pose.rotation @ by)


def surveyed(number: int) -> Iterator[tuple[RigidTransform, np.ndarray, np.ndarray]]:
    """Yield pose, picture and depth of nadir pictures all over a town, in its own world."""
    drawn = town(number)
    axis = np.arange(-SIDE / 2 + SPACING / 2, SIDE / 2, SPACING)
    for x in axis:
        for y in axis:
            pose = nadir(float(x), float(y), 0.0)
            view = render_view(drawn, CAMERA, pose, samples=2)
            yield pose, view.colour, view.depth


def disks(points: np.ndarray, colours: np.ndarray) -> Gaussians:
    """Return level disks at points (N, 3), one in each cell of the pictures' spacing."""
    cell = STRIDE * HEIGHT / CAMERA.params[0]
    _, first = np.unique(np.round(points / cell).astype(np.int64), axis=0, return_index=True)
    xyz, rgb = points[first], colours[first] / 255.0
    count = len(xyz)
    return Gaussians(
        means=torch.tensor(xyz, dtype=torch.float32),
        quaternions=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        log_scales=torch.full((count, 3), float(np.log(0.55 * cell))),
        opacity_logits=torch.full((count,), 4.0),
        sh=torch.tensor((rgb - 0.5) / SH_C0, dtype=torch.float32)[:, None],
    )


def joined(parts: Sequence[Gaussians]) -> Gaussians:
    return Gaussians(**{name: torch.cat([getattr(part, name) for part in parts]) for name, _ in parts[0].named()})


def queries(number: int, count: int) -> Iterator[tuple[Query, RigidTransform]]:
    """Yield photos of a town from anywhere over it, in any heading, with true poses in the world of all towns."""
    drawn, random = town(number), np.random.default_rng([number, 1])
    for index in range(count):
        x, y = random.uniform(-SIDE / 2 + 50, SIDE / 2 - 50, 2)
        pose = nadir(float(x), float(y), random.uniform(0, 360), tuple(random.uniform(-5, 5, 2)))
        picture = render_view(drawn, CAMERA, pose, samples=2).colour
        yield Query(f"town {number} photo {index}", picture, CAMERA), moved(pose, place(number))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--towns", type=int, nargs="+", default=[1, 2, 4, 8], help="how many side by side")
    parser.add_argument("--queries", type=int, default=24, help="photos, shared among the towns [24]")
    chosen = parser.parse_args(arguments)
    matcher, bar = picture_matcher(PictureMatchSettings()), TqdmProgress()
    parts, names, poses, features = [], [], [], []
    print("| towns | km2 | Gaussians | MB on disk | s to index | MB in memory | found | right | s | parts |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for number in track(range(max(chosen.towns)), "towns", bar):
        points, colours = [], []
        for pose, colour, depth in surveyed(number):
            y, x = np.mgrid[0 : CAMERA.height : STRIDE, 0 : CAMERA.width : STRIDE]
            _, rays = CAMERA.ray(np.column_stack([x.ravel() + 0.5, y.ravel() + 0.5]))
            deep = depth[y.ravel(), x.ravel()].astype(float)
            seen = pose.inverse().apply(rays * (deep / rays[:, 2])[:, None])
            points.append(seen[deep > 0] + place(number))
            colours.append(colour[y.ravel(), x.ravel()][deep > 0])
            names.append(f"town {number}")
            poses.append(moved(pose, place(number)))
            features.append(matcher.features(colour))
        parts.append(disks(np.concatenate(points), np.concatenate(colours)))
        if number + 1 in chosen.towns:
            told = measured(joined(parts), names, poses, features, number + 1, chosen.queries, matcher)
            print(told, flush=True)
    bar.close()


def measured(gaussians, names, poses, features, towns, count, matcher) -> str:
    """Return the table's row of so many towns."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "tiles"
        write_tiles(gaussians, "2d", folder, side=TILE)
        size = sum(path.stat().st_size for path in folder.iterdir()) / 1e6
        total = len(gaussians)
        start = time.perf_counter()
        places = build_place_index(names, poses, features)
        indexed = time.perf_counter() - start
        tiled = TiledMap(folder, most=300_000)
        found = right = asked = kept = 0
        seconds: dict[str, list[float]] = {}
        for number in range(towns):
            for query, true in queries(number, max(1, count // towns)):
                done = localize_anywhere(tiled, places, query, LocalizeSettings(), matcher)
                asked, kept = asked + 1, max(kept, tiled.kept)
                for part, value in done.seconds.items():
                    seconds.setdefault(part, []).append(value)
                if done.cam_from_world is not None:
                    found += 1
                    metres, degrees = pose_errors(done.cam_from_world, true)
                    right += metres < 0.5 and degrees < 1.0
    parts = {part: round(sum(values) / asked, 2) for part, values in seconds.items()}
    area = towns * SIDE**2 / 1e6
    return (
        f"| {towns} | {area:.2f} | {total} | {size:.0f} | {indexed:.1f} | {kept * NUMBERS * 4 / 1e6:.0f} | "
        f"{found} of {asked} | {right} | {sum(parts.values()):.1f} | {parts} |"
    )


if __name__ == "__main__":
    main()
