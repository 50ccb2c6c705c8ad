"""Measures localisation against a splat map beyond the paper's table: starts, suns, heights, and photos of nowhere.

``python tests/benchmarks/localization.py`` makes the nadir flight, further queries over its town and the map of
recipe ``2dgs-held`` (3,000 steps on pictures of 480 pixels) below ``--work``, unless they are there, and measures:

- ``offsets``: how often each method is right as the start is off by 0 to 40 m, and by 0 to 45 degrees (curves into
  ``--out``);
- ``queries``: another sun, other heights and a descent, started from what the queries' sensors say;
- ``lost``: photos of another town and of fields, and the run's own queries black, blurred, of noise and mirrored:
  how many are believed, of how many;
- ``times``: seconds of a query by part.

With ``--run`` they are measured in the map of another finished run of a recipe ``2dgs-*``.

Poses of a sample's query sets are in the true world; they are moved into the map's by the rigid motion between the
map photos' poses and the true ones.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from finished_runs import finished_run
from scipy.ndimage import gaussian_filter

from toolkit.geometry.alignment import Similarity
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.batch import Batch, localize_batch
from toolkit.localize.localizer import Localizer
from toolkit.localize.offsets import errors_by_offset
from toolkit.localize.one_shot import OneShot
from toolkit.localize.query import Query, query_of
from toolkit.localize.settings import LocalizeSettings, OneShotSettings
from toolkit.localize.splat_map import SplatMap
from toolkit.localize.starts import Start, attitude_offset, offset_starts
from toolkit.metrics.localization import LocalizationErrors, pose_errors
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.plots.localization import success_figure
from toolkit.progress import TqdmProgress
from toolkit.samples.nadir_flight import NadirFlightSettings, make_nadir_flight
from toolkit.samples.nadir_queries import NadirQuerySettings, make_nadir_queries
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene
from toolkit.splat.map_file import read_map

RIGHT = (0.5, 1.0)  # metres and degrees within which a pose is right
METRES, DEGREES = (0, 2.5, 5, 10, 15, 20, 30, 40), (0, 5, 10, 15, 20, 30, 45)


class Opened:
    """A run's map with its scene, and both methods."""

    def __init__(self, run: Path, features: str, changes: Sequence[str]) -> None:
        stored = read_map(run / "artifacts")
        self.scene = read_scene(run / "artifacts" / "scene")
        self.map = SplatMap(stored.gaussians, stored.kind)
        self.once = OneShot(self.map, OneShotSettings().replace({"match.method": features}))
        self.ours = Localizer(self.map, LocalizeSettings().replace_from_text(changes))

    @property
    def methods(self) -> tuple[OneShot | Localizer, ...]:
        return (self.once, self.ours)

    def own(self, every: int) -> Scene:
        """Return the scene with every so many of its queries."""
        kept = {frame.name for frame in self.scene.of_split("test")[::every]}
        frames = [frame for frame in self.scene.frames if frame.split != "test" or frame.name in kept]
        return self.scene.replace(frames=tuple(frames), points=None)

    def into_map(self, truth: Scene) -> Similarity:
        """Return the motion from the true world to the map's: of the map photos' poses."""
        mapped = self.scene.replace(frames=self.scene.of_split("train"), points=None)
        return trajectory_errors(mapped, truth, "se3").reference_from_estimate.inverse()


def line(name: str, batch: Batch, errors: LocalizationErrors) -> str:
    told = errors.measures()
    return (
        f"| {name} | {batch.method} | {errors.found} of {len(errors.names)} | {told['mte_m']:.3f} | "
        f"{told['rmse_t_m']:.3f} | {told['mre_deg']:.3f} | {told['recall_01']:.2f} | {told['recall_05']:.2f} | "
        f"{told['recall_5']:.2f} | {batch.median_seconds:.1f} |"
    )


HEAD = (
    "| starts | method | found | MTE m | RMSE-T m | MRE deg | 0.1 m 0.1 deg | 0.5 m 1 deg | 5 m 5 deg | s |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)


def offsets(opened: Opened, arguments: argparse.Namespace) -> None:
    """Success as starts are farther off, in metres and in degrees."""
    told: dict[str, dict[str, list[float]]] = {}
    print("| start off by | method | found | MTE m | MRE deg | within 0.5 m, 1 deg |\n|---|---|---|---|---|---|")
    for unit, steps in (("metres", METRES), ("degrees", DEGREES)):
        errors = errors_by_offset(opened.methods, opened.scene, steps, unit, every=arguments.every)
        for name, by_step in errors.items():
            for step, found in by_step.items():
                share = found.recall(*RIGHT)
                told.setdefault(unit, {}).setdefault(name, []).append(share)
                print(
                    f"| {step:g} {unit} | {name} | {found.found} of {len(found.names)} | {found.mte:.3f} | "
                    f"{found.mre_deg:.3f} | {share:.2f} |",
                    flush=True,
                )
        if arguments.out is not None:
            arguments.out.mkdir(parents=True, exist_ok=True)
            curves = {name: (list(steps), shares) for name, shares in told[unit].items()}
            drawn = success_figure(curves, offset=unit, success="within 0.5 m and 1 degree")
            drawn.write_html(arguments.out / f"offsets_{unit}.html")


def sensor_starts(scene: Scene, mapped: Scene) -> list[Start]:
    """Return where the sensors say that the frames are, without the constant turn that the map's frames show."""
    turn_out = attitude_offset(mapped)
    starts = []
    for frame in scene.frames:
        prior = frame.prior
        assert prior is not None
        assert prior.position is not None
        assert prior.rotation is not None
        rotation = turn_out.camera_from_sensors @ prior.rotation
        pose = RigidTransform(rotation, -rotation @ prior.position)
        sigma = 1.0 if prior.position_sigma is None else float(np.max(prior.position_sigma))
        starts.append(Start(frame.name, pose, max(sigma, 0.5), turn_out.sigma_deg))
    return starts


def queries(opened: Opened, arguments: argparse.Namespace) -> None:
    """Other queries over the same town, from their sensors; by height where that varies."""
    moved = opened.into_map(read_scene(arguments.truth))
    print(HEAD)
    for folder in arguments.data:
        scene = read_scene(folder)
        scene = scene.replace(frames=scene.frames[:: arguments.every])
        truth = {name: moved.apply_to_pose(pose) for name, pose in scene.poses.items()}
        starts = sensor_starts(scene, opened.scene)
        for method in opened.methods:
            batch = localize_batch(method, scene, starts)
            print(line(folder.name, batch, batch.errors(truth)), flush=True)
            if arguments.each:
                _each(batch, truth)


def _each(batch: Batch, truth: dict[str, RigidTransform]) -> None:
    for done in batch.found:
        true = truth[done.name]
        what = done.reason
        if done.cam_from_world is not None:
            metres, degrees = pose_errors(done.cam_from_world, true)
            what = f"{metres:.3f} m {degrees:.3f} deg, {done.inliers} inliers"
        print(f"    {done.name} at {true.centre[2]:.1f} m: {what}", flush=True)


def lost(opened: Opened, arguments: argparse.Namespace) -> None:
    """Photos that must not be found: what is believed all the same, and how surely."""
    own = opened.own(arguments.every)
    starts = {start.name: start for start in offset_starts(own, 5.0, 5.0, seed=0)}
    sets: dict[str, list[tuple[Query, Start]]] = {}
    for frame in own.of_split("test"):
        if frame.name not in starts:
            continue
        query, start = query_of(own, frame), starts[frame.name]
        noise = np.random.default_rng(len(sets.get("noise", []))).integers(0, 256, query.picture.shape, np.uint8)
        changed = {
            "black": np.zeros_like(query.picture),
            "blurred by 12 px": gaussian_filter(query.picture, (12, 12, 0)),
            "noise": noise,
            "mirrored": np.ascontiguousarray(query.picture[:, ::-1]),
        }
        for name, picture in changed.items():
            sets.setdefault(name, []).append((Query(frame.name, picture, query.camera), start))
    for folder in arguments.data or ():
        scene = read_scene(folder)
        around = list(starts.values())
        for number, frame in enumerate(scene.frames):
            start = around[number % len(around)]
            sets.setdefault(folder.name, []).append((query_of(scene, frame), start))
    print("| queries | method | believed | of | smallest sigma m |\n|---|---|---|---|---|")
    for name, pairs in sets.items():
        for method in opened.methods:
            found = [method.localize(query, start) for query, start in pairs]
            sure = [done for done in found if done]
            sigmas = [float(done.position_sigma.max()) for done in sure if done.position_sigma is not None]
            least = f"{min(sigmas):.3f}" if sigmas else "-"
            print(f"| {name} | {method.name} | {len(sure)} | {len(found)} | {least} |", flush=True)


def times(opened: Opened, arguments: argparse.Namespace) -> None:
    """Seconds of a query by part, from starts off by 0, 10 and 30 m."""
    scene = opened.own(arguments.every)
    for method in opened.methods:  # the first query waits for compilers
        localize_batch(method, scene, offset_starts(scene, 0.0, 0.0, seed=0)[:1])
    for metres in (0.0, 10.0, 30.0):
        for method in opened.methods:
            batch = localize_batch(method, scene, offset_starts(scene, metres, 0.0, seed=0))
            parts: dict[str, list[float]] = {}
            for done in batch.found:
                for part, seconds in done.seconds.items():
                    parts.setdefault(part, []).append(seconds)
            mean = {part: f"{np.sum(values) / len(batch.found):.2f}" for part, values in parts.items()}
            rounds = np.mean([done.rounds for done in batch.found])
            print(f"{metres:g} m, {method.name}: median {batch.median_seconds:.2f} s, {rounds:.1f} rounds, {mean}")


def sets(work: Path, kinds: Sequence[tuple[str, dict[str, object]]], bar: TqdmProgress) -> list[Path]:
    """Return the folders of query sets over the flight's town, made where they are missing."""
    folders = []
    for name, changes in kinds:
        settings = NadirQuerySettings().replace(changes)
        make_nadir_queries(work / name, NadirFlightSettings(), settings, progress=bar)
        folders.append(work / name)
    return folders


QUERIES = (
    ("sun", {"kind": "sun"}),
    ("height-60", {"kind": "height", "height": 60.0}),
    ("height-120", {"kind": "height", "height": 120.0}),
    ("descent", {"kind": "descent"}),
)
NOWHERE = (("another-town", {"kind": "town", "frames": 30}), ("fields", {"kind": "fields", "frames": 30}))
MAP = {
    "train.steps": 3000,
    "train.max_side": 480,
    "train.max_gaussians": 100_000,
    "scenarios.sfm_train": False,
    "scenarios.calc_test": False,
    "scenarios.sfm_test_pos10": False,
    "scenarios.every": 4,
}
MEASURES = {"offsets": offsets, "queries": queries, "lost": lost, "times": times}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", default=list(MEASURES), help=f"{', '.join(MEASURES)} [all]")
    parser.add_argument("--work", type=Path, default=Path("runs/bench-localization"), help="where all of it goes")
    parser.add_argument("--run", type=Path, help="folder of a finished run of a recipe 2dgs-* [made here]")
    parser.add_argument("--data", type=Path, nargs="+", help="folders of query sets [made here]")
    parser.add_argument("--truth", type=Path, help="the flight of the map, with its true poses [made here]")
    parser.add_argument("--every", type=int, default=1, help="take every so many queries [1]")
    parser.add_argument("--features", default="aliked-lightglue", help="of the one shot [aliked-lightglue]")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change a setting of ours")
    parser.add_argument("--each", action="store_true", help="print every query")
    parser.add_argument("--out", type=Path, help="folder for curves")
    chosen = parser.parse_args(arguments)
    bar = TqdmProgress()
    if chosen.truth is None:
        chosen.truth = chosen.work / "flight"
        make_nadir_flight(chosen.truth, NadirFlightSettings(), progress=bar)
    if chosen.run is None:
        chosen.run = finished_run("2dgs-held", "localization", chosen.truth, chosen.work / "runs", MAP).path
    opened, given = Opened(chosen.run, chosen.features, chosen.set), chosen.data
    for what in chosen.what:
        if given is None and what in ("queries", "lost"):
            chosen.data = sets(chosen.work, QUERIES if what == "queries" else NOWHERE, bar)
        bar.close()
        MEASURES[what](opened, chosen)


if __name__ == "__main__":
    main()
