"""Measures blade footage: which pairs fold blades onto each other, what closing the circle gives, learned features.

``python tests/benchmarks/blades.py [pairs] [growth] [masks] [segments] [circle] [learned] [--work DIR]`` prints the
tables of docs/blades.md, all of them where none is named. The footage is made once and kept in ``--work``.
``toolkit table blades-camera-models`` makes that of camera models, ``temple_ring.py`` that of real pictures.

Truth: a verified pair is wrong where fewer than half of its inliers show the same place of the same blade. A blade
of 30 points or more stands apart where their middle is at least half as far from that of every other such blade as
it is in truth, at the scale that most blades have.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from blade_footage import (
    COLUMNS,
    KNOWN,
    arc_of,
    blades_apart,
    engine,
    head,
    masked,
    reconstruct,
    row,
    told,
    unknown_lens,
    with_edges,
    with_lens_found,
    wrong_pairs,
)
from scipy.spatial.transform import Rotation

from toolkit.matching.feature_choice import FeatureSettings
from toolkit.matching.pairs import PairSettings
from toolkit.matching.wrong_pairs import WrongPairSettings, drop_pairs, find_wrong_pairs
from toolkit.metrics.circle import circle_errors, fit_circle
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.poses.arc_sigma import ArcSigma
from toolkit.poses.circular import close_circle
from toolkit.poses.circular_result import CircularResult
from toolkit.poses.circular_selection import circle_tracks
from toolkit.poses.circular_settings import CircularSettings
from toolkit.poses.sfm import incremental_sfm
from toolkit.recipes.blades import faint_features, small_step_sfm
from toolkit.samples.engine import EngineSample
from toolkit.scene import Scene


def measure_pairs(work: Path) -> None:
    """Exhaustive against sequential on the same frames: 40 degrees in 200 frames, ten blades pass."""
    sample = engine(work, frames=200, stride=2)
    scene = masked(sample, work)
    head(f"Pairs: {len(scene)} frames, {sample.angles[-1]:.1f} degrees, lens known", *COLUMNS)
    every = reconstruct(scene, work / "every", PairSettings(method="exhaustive"))
    told(sample, "exhaustive", every, int(wrong_pairs(sample, every).sum()))
    start = time.perf_counter()
    flagged = find_wrong_pairs(every.database, scene, WrongPairSettings())
    seconds = time.perf_counter() - start
    target = work / "every" / "dropped.db"
    drop_pairs(every.database, flagged.wrong, target)
    kept = incremental_sfm(scene, target, small_step_sfm().replace(KNOWN), work_dir=work / "every")
    wrong = {tuple(pair) for pair in every.report.pairs[every.report.verified][wrong_pairs(sample, every)].tolist()}
    dropped = {tuple(pair) for pair in flagged.wrong.tolist()}
    apart, there = blades_apart(sample, kept.scene)
    row(
        "exhaustive, wrong pairs dropped",
        len(every.report.pairs),
        int(every.report.verified.sum()) - len(dropped),
        len(wrong - dropped),
        f"{len(kept.scene.registered)} of {len(scene)}",
        arc_of(kept.scene),
        f"{apart} of {there}",
        0 if kept.scene.points is None else len(kept.scene.points),
        f"{every.report.seconds + seconds:.0f}",
        f"{kept.seconds['mapping'] + kept.seconds['adjustment']:.0f}",
    )
    print(
        f"\nDropped {len(dropped)} pairs, {len(dropped - wrong)} of them right; {len(wrong - dropped)} wrong stay."
    )
    head("Windows, the same frames (2.5 frames are 5 of the paper's)", *COLUMNS)
    for window in (3, 5, 8, 10):
        pairs = PairSettings(method="sequential", overlap=window, quadratic=False)
        found = reconstruct(scene, work / f"window{window}", pairs)
        told(sample, f"sequential, {window}", found, int(wrong_pairs(sample, found).sum()))


def measure_growth(work: Path) -> None:
    """How the cost of matching grows with frames."""
    sample = engine(work, frames=200, stride=2)
    scene = masked(sample, work)
    head("Cost of matching", "frames", "sequential, 8: pairs", "s", "exhaustive: pairs", "s")
    for count in (50, 100, 200):
        part = scene.replace(frames=scene.frames[:count])
        cells: list[object] = [count]
        for pairs in (
            PairSettings(method="sequential", overlap=8, quadratic=False),
            PairSettings(method="exhaustive"),
        ):
            found = reconstruct(part, work / f"growth{count}", pairs, sfm=False)
            cells += [len(found.report.pairs), f"{found.report.seconds:.1f}"]
        row(*cells)


def measure_masks(work: Path) -> None:
    """With and without a mask of what does not turn."""
    sample = engine(work, frames=200, stride=2)
    head("Mask of what does not turn, sequential, 8", *COLUMNS)
    for name, scene in (("masked", masked(sample, work)), ("not masked", sample.scene.without_poses())):
        found = reconstruct(scene, work / name, PairSettings(method="sequential", overlap=8, quadratic=False))
        told(sample, name, found, int(wrong_pairs(sample, found).sum()))


def measure_segments(work: Path) -> None:
    """Three segments of 98 degrees, with little and with much shake, lens unknown."""
    head(
        "98 degrees from different places, OPENCV_FISHEYE found with the poses",
        *(
            "shake (%)",
            "start (deg)",
            "placed",
            "arc (deg)",
            "+- (deg)",
            "with edges (deg)",
            "+- (deg)",
            "radius spread",
            "out of plane",
            "size, last to first",
            "with edges",
        ),
    )
    for shake in (0.05, 1.0):
        for start in (0.0, 120.0, 240.0):
            sample = engine(work, frames=246, stride=4, start=start, shake=shake)
            pairs = PairSettings(method="sequential", overlap=sample.window, quadratic=False)
            scene = unknown_lens(masked(sample, work))
            database = reconstruct(scene, work / "segment", pairs, sfm=False).database
            made = with_lens_found(scene, database, work / "segment")
            edged = with_edges(made, sample)
            found, fit = made.scene, fit_circle(made.scene.centres())
            row(
                f"{shake:g}",
                f"{start:g}",
                f"{len(found.registered)} of {len(found)}",
                f"{fit.arc_degrees:.1f}",
                sigma_of(edged.before),
                f"{edged.after.arc_degrees:.1f}",
                sigma_of(edged.after),
                f"{fit.radius_spread:.4f}",
                f"{fit.out_of_plane_rms:.4f}",
                f"{size_drift(found, sample.scene):.3f}",
                f"{size_drift(edged.scene, sample.scene):.3f}",
            )


def sigma_of(arc: ArcSigma) -> str:
    """Return the standard deviation of an arc."""
    return "not known" if arc.sigma is None else f"{arc.sigma:.2f}"


def size_drift(found: Scene, truth: Scene) -> float:
    """Return the scale at the end divided by that at the beginning, from the steps of the camera: 1 is no drift."""
    true = {frame.name: frame.cam_from_world for frame in truth.frames}
    centres, exact = found.centres(), []
    for frame in found.registered:
        pose = true[frame.name]
        assert pose is not None
        exact.append(pose.centre)
    steps = np.linalg.norm(centres[10:] - centres[:-10], axis=1)
    steps /= np.linalg.norm(np.array(exact[10:]) - np.array(exact[:-10]), axis=1)
    fifth = max(1, len(steps) // 5)
    return float(np.median(steps[-fifth:]) / np.median(steps[:fifth]))


def measure_circle(work: Path) -> None:
    """A whole turn with shake, as it drifts and closed: lens found or known, seam given or withheld."""
    sample = engine(work, frames=360, stride=10)
    everything = {"max_scale": 0.0, "min_track": 2}
    captures = {"lens found": unknown_lens(masked(sample, work)), "lens known": masked(sample, work)}
    head(
        f"A whole turn, {sample.settings.film.frames} frames, shake 0.2 %",
        *("", "placed", "turn (deg)", "gap (% of circumference)", "position (% of radius)"),
        *("orientation (deg)", "its sigma", "of it the mount", "angle (deg)", "s"),
    )
    for (lens, scene), closed in itertools.product(captures.items(), (True, False)):
        pairs = PairSettings(method="sequential", overlap=sample.window, quadratic=False, closed=closed)
        folder = work / f"circle-{lens[5:]}-{closed}"
        name = f"{lens}, matches across the seam{'' if closed else ' withheld'}"
        kept = KNOWN if lens == "lens known" else {}
        database = reconstruct(scene, folder, pairs, sfm=False).database
        start = time.perf_counter()
        if kept:
            found = incremental_sfm(scene, database, small_step_sfm().replace(kept), work_dir=folder).scene
        else:
            found = with_lens_found(scene, database, folder).scene
        _circle_row(f"sfm, {name}", found, None, sample, time.perf_counter() - start)
        for selected in (True,) if kept else (False, True):
            start = time.perf_counter()
            chosen = circle_tracks(found, database, CircularSettings().replace({} if selected else everything))
            result = close_circle(chosen.scene, CircularSettings(full_turn=not closed).replace(kept))
            told = f"circle, {'fine features, long tracks' if selected else 'all features'}, {name}"
            _circle_row(told, result.scene, result, sample, time.perf_counter() - start)


def _circle_row(
    name: str, found: Scene, result: CircularResult | None, sample: EngineSample, seconds: float
) -> None:
    errors = circle_errors(found, sample.scene)
    step = float(sample.angles[-1] - sample.angles[0])
    fit = fit_circle(found.centres(), expected_turn=step)
    sigma = None if result is None else result.orientation_sigma
    row(
        name,
        f"{len(found.registered)} of {len(found)}",
        f"{fit.arc_degrees:.2f} of {step:.2f}",
        f"{100 * abs(fit.arc_degrees - step) / 360.0:.4f}",
        f"{100 * np.sqrt(np.mean(errors.position**2)):.2f} (max {100 * errors.position.max():.2f})",
        f"{np.sqrt(np.mean(errors.rotation_deg**2)):.3f} (max {errors.rotation_deg.max():.3f})",
        "" if sigma is None else f"{sigma:.3f}",
        f"{shared_turn(found, sample.scene):.3f}",
        f"{np.sqrt(np.mean(errors.angle_deg**2)):.3f} (max {np.abs(errors.angle_deg).max():.3f})",
        f"{seconds:.0f}",
    )


def shared_turn(found: Scene, truth: Scene) -> float:
    """Return by how many degrees all cameras are turned alike in their own axes: the error of their mount."""
    to_truth = trajectory_errors(found, truth, "sim3").reference_from_estimate
    off = []
    for frame in found.registered:
        true = truth.frame(frame.name).cam_from_world
        assert frame.cam_from_world is not None
        assert true is not None
        turned = to_truth.apply_to_pose(frame.cam_from_world).rotation @ true.rotation.T
        off.append(Rotation.from_matrix(turned).as_rotvec(degrees=True))
    return float(np.linalg.norm(np.mean(off, axis=0)))


def methods() -> Iterator[tuple[str, FeatureSettings]]:
    yield "SIFT", faint_features()
    for name in ("disk", "aliked"):
        settings = FeatureSettings(method=f"{name}-lightglue")
        yield f"{name.upper()} + LightGlue", settings.replace({f"{name}.max_features": 1024})


def measure_learned(work: Path) -> None:
    """SIFT against learned features on the engine."""
    sample = engine(work, frames=40, stride=4)
    scene = masked(sample, work)
    window = sample.window
    head(f"Features on the engine, {len(scene)} frames, sequential, {window}", *COLUMNS)
    for name, features in methods():
        pairs = PairSettings(method="sequential", overlap=window, quadratic=False)
        found = reconstruct(scene, work / "learned", pairs, features)
        told(sample, name, found, int(wrong_pairs(sample, found).sum()))
        print(f"{name}: features {found.seconds_features:.0f} s, {found.report.seconds_per_pair:.3f} s a pair")


def main() -> None:
    measures: dict[str, Callable[[Path], None]] = {
        "pairs": measure_pairs,
        "growth": measure_growth,
        "masks": measure_masks,
        "segments": measure_segments,
        "circle": measure_circle,
        "learned": measure_learned,
    }
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", choices=[[], *measures], default=[], help="which of them [all]")
    parser.add_argument(
        "--work", type=Path, default=Path("runs/bench-blades"), help="folder of footage and results"
    )
    options = parser.parse_args()
    for name in options.what or measures:
        measures[name](options.work)


if __name__ == "__main__":
    main()
