"""Bundle adjustment in which all cameras share one axis and one radius and turn about it: the circle is closed.

Incremental structure from motion of a camera that circles an engine's rotor ends in a spiral (paper
blade-inspection-sfm, section 4.3, figures 9 and 12): errors of the camera model and of the poses add up over
thousands of frames that only see their neighbours. The paper's conclusion asks for the circular motion as a
constraint. Here it is one, hard or with slack for the shake of the borescope, and the intrinsics are free, for the
closed circle is what determines them.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.poses.circular_constraints import ring_constraints, turn_coefficients
from toolkit.poses.circular_model import LOOSE, Observations, Ring, Unknowns, free_parameters, residuals
from toolkit.poses.circular_result import CircularResult
from toolkit.poses.circular_scene import Adjusted, circular_result
from toolkit.poses.circular_settings import CircularSettings
from toolkit.poses.circular_solver import Constraints, Solution, covariance, noise_of, pixel_cost, solve
from toolkit.poses.circular_start import (
    Chain,
    chain_of,
    first_ring,
    ray_angles,
    triangulate,
    turn_of_seam,
)
from toolkit.poses.circular_tracks import observations_of, sequence_of
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene import Scene

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# More frames make a dense system of more than 9,000 unknowns: minutes and a gigabyte a step.
_MOST_FRAMES = 1500
# Rounds before the last need not converge as far. The noise of their start is far too large: what they would settle
# on is the best for wrong weights, so they are short.
_COARSE, _COARSE_STEPS = 10.0, 12
# Slacks of the rounds in soft mode, as multiples of the declared ones: from stiff to as asked, then for the noise.
_SLACKS = (0.3, 1.0, 1.0)


def close_circle(
    scene: Scene,
    settings: CircularSettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
) -> CircularResult:
    """Adjust poses, cameras and points so that all cameras lie on one circle and turn about its axis.

    The start does not trust the drifted world: axis, mount and angles come from the motion between neighbours, the
    chain of angles is stretched to a turn that is known (by the settings, or by tracks that join both ends, see
    :func:`toolkit.poses.circular_seam.seam_tracks`), and points are triangulated anew. Then a robust adjustment on
    the hard circle, and, in soft mode, one with the slacks.

    Parameters
    ----------
    scene:
        With poses, cameras of COLMAP's models, points and tracks, frames in order of capture. Frames of one camera
        share one mount on the ring. Frames without pose stay without.
    settings:
        As declared.
    seed:
        Has no effect: nothing is random.
    progress:
        Told each step with its cost; raises to cancel.

    Raises
    ------
    StageError
        For too few frames with pose or points with tracks; a camera that does not turn about one axis; a known turn
        told by frames without pose; more than 1,500 frames with pose.
    CapabilityError
        For cameras that are none of COLMAP's.
    """
    start = time.perf_counter()
    frames = sequence_of(scene)
    if len(frames.index) > _MOST_FRAMES:
        raise StageError(
            "Too many frames for one adjustment on a circle",
            expected=f"at most {_MOST_FRAMES}",
            found=str(len(frames.index)),
            todo="Take every nth frame",
        )
    seen, points = observations_of(scene, frames, settings.max_points)
    chain = chain_of(frames)
    turn, joined = turn_of_seam(seen, chain.angle)
    stretch = _stretch(settings, frames.index, chain, turn)
    spread = float(np.std(stretch * np.diff(chain.angle) / np.diff(frames.index)))
    ring, sound = first_ring(frames, chain, stretch, seen)
    seen, ring, points, offered = *_kept(seen, ring, points, sound[seen.point]), len(seen)
    free = tuple(free_parameters(model, settings) for model in frames.models)
    costs: dict[str, tuple[float, ...]] = {}
    for name, unknowns, slack in _rounds(settings, free):
        if name == "last":
            seen, ring, points = _filtered(seen, ring, points, frames.camera, settings)
        constraints = ring_constraints(settings, frames.index, frames.models, slack=slack, step_spread=spread)
        solution = _adjusted(seen, ring, unknowns, constraints, settings, name, progress)
        ring, costs[name] = solution.ring, solution.costs
        if name == "circle":
            ring = _placed_again(ring, seen, frames.camera)
    noise = noise_of(residuals(ring, seen))
    known = covariance(ring, seen, unknowns, constraints, noise)
    adjusted = Adjusted(
        frames, chain, seen, points, ring, unknowns, known, noise, joined, offered, costs, solution.converged
    )
    return circular_result(scene, settings, adjusted, time.perf_counter() - start)


def _stretch(settings: CircularSettings, index: Index, chain: Chain, turn: float | None) -> float:
    """Return the factor that takes the chained angles to the known turn; 1 where none is known."""
    if settings.full_turn:
        turned = float(turn_coefficients(settings, index) @ chain.angle)
        if turned <= 0:
            raise StageError(
                "The known turn runs against the camera",
                expected="turn_last after turn_first in the order of capture",
                found=f"{math.degrees(turned):.1f} degrees between them",
            )
        return math.radians(settings.turn_angle) / turned
    if turn is not None:
        return 2 * math.pi * max(1, round(turn / (2 * math.pi))) / turn
    return 1.0


def _rounds(settings: CircularSettings, free: tuple[tuple[int, ...], ...]) -> Iterator[tuple[str, Unknowns, float]]:
    """Yield name, unknowns and slack of each round: coarse to fine."""
    yield "circle", Unknowns(1, free), 1.0
    hard = settings.mode == "hard"
    if hard:
        yield "circle again", Unknowns(1, free), 1.0
    else:
        for number, slack in enumerate(_SLACKS):
            again = " again" if slack in _SLACKS[:number] else ""
            yield f"slack x {slack:g}{again}", Unknowns(LOOSE, free), slack
    yield "last", Unknowns(1 if hard else LOOSE, free), 1.0


def _adjusted(
    seen: Observations,
    ring: Ring,
    unknowns: Unknowns,
    constraints: Constraints,
    settings: CircularSettings,
    name: str,
    progress: Progress,
) -> Solution:
    """Run one round of the solver under the noise that the residuals show at its start."""
    noise = noise_of(residuals(ring, seen))

    def tell(step: int, cost: float) -> None:
        values = {"cost": cost, "noise": noise}
        progress(ProgressEvent("circle", step, settings.max_steps, name, values))

    return solve(
        ring,
        seen,
        unknowns,
        constraints,
        noise=noise,
        steps=settings.max_steps if name == "last" else min(_COARSE_STEPS, settings.max_steps),
        tolerance=settings.tolerance if name == "last" else _COARSE * settings.tolerance,
        tell=tell,
    )


def _kept(
    seen: Observations, ring: Ring, points: Index, keep: NDArray[np.bool_]
) -> tuple[Observations, Ring, Index]:
    """Drop observations, and the points that have none left."""
    seen, left = seen.kept(keep)
    return seen, dataclasses.replace(ring, points=ring.points[left]), points[left]


def _placed_again(ring: Ring, seen: Observations, camera_of_frame: Index) -> Ring:
    """Take the triangulated place of each point where it fits better than the adjusted one, which may be stuck."""
    fresh, sound = triangulate(ring, seen, camera_of_frame)
    other = dataclasses.replace(ring, points=np.where(sound[:, None], fresh, ring.points))
    noise = noise_of(residuals(ring, seen))
    costs = [np.add.reduceat(pixel_cost(residuals(each, seen) / noise), seen.starts) for each in (ring, other)]
    return dataclasses.replace(ring, points=np.where((costs[1] < costs[0])[:, None], other.points, ring.points))


def _filtered(
    seen: Observations, ring: Ring, points: Index, camera_of_frame: Index, settings: CircularSettings
) -> tuple[Observations, Ring, Index]:
    """Drop wrong observations, points seen under small angles, and points that fewer than two frames still see."""
    error = np.linalg.norm(residuals(ring, seen), axis=1)
    angles = ray_angles(ring, seen, camera_of_frame)
    keep = (error <= settings.max_error) & (angles >= math.radians(settings.min_angle))[seen.point]
    keep &= np.bincount(seen.point[keep], minlength=len(ring.points))[seen.point] >= 2
    if not keep.any():
        raise StageError(
            "No observation is left on the circle",
            expected=f"errors below max_error = {settings.max_error:g} px",
            found=f"a median error of {float(np.nanmedian(error)):.1f} px",
            todo="Look whether the camera circles one axis and frames are in order; raise max_error",
        )
    return _kept(seen, ring, points, keep)
