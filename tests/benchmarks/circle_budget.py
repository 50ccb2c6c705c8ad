"""Tells what turns the cameras of a closed circle: where observations are true, noisy, or what was really seen.

``OPENBLAS_NUM_THREADS=1 python tests/benchmarks/circle_budget.py [--work DIR]`` makes the footage and the tracks of
``blades.py circle`` (lens found, matches across the seam) and closes the circle with

- the observations that were found, all of them and those that :func:`circle_tracks` chooses;
- of the chosen ones those whose places on the true surface agree, which only a sample can tell;
- the same tracks with every pixel where the true place of its point is seen, exact and with white noise.

It also prints how far features of each scale drift against the true surface from frame to frame.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
from pathlib import Path

import numpy as np
from blade_footage import engine, head, masked, reconstruct, row, unknown_lens, with_lens_found
from blades import shared_turn
from numpy.typing import NDArray

from toolkit.matching.pairs import PairSettings
from toolkit.metrics.circle import circle_errors
from toolkit.poses.circular import close_circle
from toolkit.poses.circular_scale import feature_scales
from toolkit.poses.circular_selection import circle_tracks
from toolkit.poses.circular_settings import CircularSettings
from toolkit.samples.engine import EngineSample
from toolkit.scene import Points, Scene, Tracks

#: Standard deviation of white noise in pixels: about that of the residuals of fine features.
NOISE = 0.06
#: Metres within which a point's places on the true surface agree.
AGREE = 1e-4
SCALES = (0.0, 1.5, 2.0, 4.0, 1000.0)


def tracks_of(scene: Scene) -> tuple[Points, Tracks]:
    """Return a scene's points and tracks."""
    assert scene.points is not None
    assert scene.points.tracks is not None
    return scene.points, scene.points.tracks


def true_places(scene: Scene, sample: EngineSample) -> NDArray[np.float64]:
    """Return where (T, 3) on the true surface each observation lies, NaN where it meets nothing."""
    _, tracks = tracks_of(scene)
    number = {frame.name: place for place, frame in enumerate(sample.scene.frames)}
    places = np.full((len(tracks.point), 3), np.nan)
    for index in np.unique(tracks.frame).tolist():
        rows = np.flatnonzero(tracks.frame == index)
        places[rows] = sample.surface(number[scene.frames[index].name], tracks.pixel[rows]).points
    return places


def mean_places(scene: Scene, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean place (P, 3) of each point's observations; NaN where one of them met nothing."""
    points, tracks = tracks_of(scene)
    count = np.bincount(tracks.point, minlength=len(points))
    sums = [np.bincount(tracks.point, places[:, axis], minlength=len(points)) for axis in range(3)]
    return np.stack(sums, axis=1) / np.maximum(count, 1)[:, None]


def agreeing(scene: Scene, sample: EngineSample) -> Scene:
    """Return the scene with the points whose observations are of one place of the true surface."""
    points, tracks = tracks_of(scene)
    places = true_places(scene, sample)
    off = np.linalg.norm(places - mean_places(scene, places)[tracks.point], axis=1)
    spread = np.bincount(tracks.point, off, minlength=len(points)) / np.bincount(
        tracks.point, minlength=len(points)
    )
    return scene.replace(points=points.observed((spread < AGREE)[tracks.point]))


def seen_from_truth(scene: Scene, sample: EngineSample, noise: float) -> Scene:
    """Return the scene with every pixel where its point's place on the true surface is seen, plus white noise."""
    points, tracks = tracks_of(scene)
    places = mean_places(scene, true_places(scene, sample))
    true = {frame.name: frame for frame in sample.scene.frames}
    pixel = np.full_like(tracks.pixel, np.nan)
    for index in np.unique(tracks.frame).tolist():
        rows = np.flatnonzero(tracks.frame == index)
        frame = true[scene.frames[index].name]
        assert frame.cam_from_world is not None
        camera = sample.scene.camera_of(frame)
        pixel[rows] = camera.project(frame.cam_from_world.apply(places[tracks.point[rows]]))
    pixel += noise * np.random.default_rng(0).normal(size=pixel.shape)
    moved = dataclasses.replace(points, tracks=dataclasses.replace(tracks, pixel=pixel))
    return scene.replace(points=moved.observed(np.isfinite(pixel).all(axis=1)))


def told(name: str, scene: Scene, sample: EngineSample) -> None:
    """Close the circle and print how right it is."""
    result = close_circle(scene, CircularSettings())
    errors = circle_errors(result.scene, sample.scene)
    row(
        name,
        len(tracks_of(scene)[0]),
        f"{100 * np.sqrt(np.mean(errors.position**2)):.2f}",
        f"{np.sqrt(np.mean(errors.rotation_deg**2)):.3f}",
        f"{shared_turn(result.scene, sample.scene):.3f}",
        f"{np.sqrt(np.mean(errors.angle_deg**2)):.3f}",
        "" if result.orientation_sigma is None else f"{result.orientation_sigma:.3f}",
    )


def drift(scene: Scene, database: Path, sample: EngineSample) -> None:
    """Print by how many pixels a frame features of each scale move against the true surface."""
    _, tracks = tracks_of(scene)
    order = np.lexsort([tracks.frame, tracks.point])
    point, frame = tracks.point[order], tracks.frame[order]
    places, scale = true_places(scene, sample)[order], feature_scales(scene, database)[order]
    next_to = np.flatnonzero((point[1:] == point[:-1]) & (frame[1:] == frame[:-1] + 1))
    moved = np.full((len(next_to), 2), np.nan)
    true = {each.name: each for each in sample.scene.frames}
    for index in np.unique(frame[next_to]).tolist():
        rows = np.flatnonzero(frame[next_to] == index)
        seen = true[scene.frames[index + 1].name]
        assert seen.cam_from_world is not None
        camera = sample.scene.camera_of(seen)
        expected = camera.project(seen.cam_from_world.apply(places[next_to[rows]]))
        moved[rows] = tracks.pixel[order][next_to[rows] + 1] - expected
    head("Drift of features against the surface, along the picture's width", "scale (px)", "pairs", "median (px)")
    for low, high in itertools.pairwise(SCALES):
        chosen = (scale[next_to] >= low) & (scale[next_to] < high) & np.isfinite(moved).all(axis=1)
        row(f"{low:g} to {high:g}", int(chosen.sum()), f"{np.median(moved[chosen, 0]):+.4f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--work", type=Path, default=Path("runs/bench-blades"), help="folder of footage and results"
    )
    work = parser.parse_args().work
    sample = engine(work, frames=360, stride=10)
    scene, folder = unknown_lens(masked(sample, work)), work / "circle-found-True"
    pairs = PairSettings(method="sequential", overlap=sample.window, quadratic=False, closed=True)
    database = reconstruct(scene, folder, pairs, sfm=False).database
    found = with_lens_found(scene, database, folder).scene
    all_of_them = circle_tracks(found, database, CircularSettings(max_scale=0.0, min_track=2)).scene
    fine = circle_tracks(found, database, CircularSettings(min_track=2)).scene
    chosen = circle_tracks(found, database, CircularSettings()).scene
    drift(all_of_them, database, sample)
    columns = (
        "points",
        "position (%)",
        "orientation (deg)",
        "of it the mount",
        "angle (deg)",
        "sigma of orientation",
    )
    head("What turns the cameras", "observations", *columns)
    told("all that were found", all_of_them, sample)
    told("fine features", fine, sample)
    told(f"fine, within {1e3 * AGREE:g} mm on the true surface", agreeing(fine, sample), sample)
    told("fine, long tracks", chosen, sample)
    told("fine, exact", seen_from_truth(fine, sample, 0.0), sample)
    told(f"fine, exact and {NOISE} px of white noise", seen_from_truth(fine, sample, NOISE), sample)


if __name__ == "__main__":
    main()
