"""A pose graph of camera paths without a common scale, held in the world by positions and attitudes.

Nodes are cameras (orientation and centre in the world); each path has one unknown scale. Factors are the motions
from a camera to the next one of its path (Grisetti et al. 2010, "A tutorial on graph-based SLAM"), measured centres
and measured attitudes. Measurements of sensors have a Cauchy loss, motions a quadratic one. Solved by
Levenberg-Marquardt on the manifold with sparse normal equations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scipy import sparse

Array = NDArray[np.float64]
Index = NDArray[np.int64]

#: Measurements this many standard deviations off have half their weight.
_CAUCHY = 3.0
_STEPS = 100
_STEP_TOLERANCE = 1e-10
_COST_TOLERANCE = 1e-12
_FIRST_DAMPING, _MOST_DAMPING = 1e-6, 1e12


@dataclass(frozen=True, slots=True, eq=False)
class GraphState:
    """What is unknown.

    Attributes
    ----------
    rotations:
        (N, 3, 3) ``world_from_cam``.
    centres:
        (N, 3) in metres.
    log_scales:
        (S,) logarithm of the metres in a unit of each path.
    """

    rotations: Array
    centres: Array
    log_scales: Array


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraph:
    """What was measured.

    Attributes
    ----------
    first, second:
        (M,) nodes of each motion; ``path`` (M,) is the path that it belongs to.
    turn:
        (M, 3, 3) ``first_from_second`` rotations.
    shift:
        (M, 3) centre of the second in the first camera's axes, in the path's unit.
    turn_sigma, shift_sigma:
        (M,) standard deviation of an axis, in radians and in metres.
    placed:
        (P,) nodes with a position; ``position`` and ``position_sigma`` (P, 3) in metres.
    turned:
        (A,) nodes with an attitude; ``attitude`` (A, 3, 3) is ``cam_from_world``, ``attitude_sigma`` (A, 3) radians
        about the camera's axes.
    """

    first: Index
    second: Index
    path: Index
    turn: Array
    shift: Array
    turn_sigma: Array
    shift_sigma: Array
    placed: Index
    position: Array
    position_sigma: Array
    turned: Index
    attitude: Array
    attitude_sigma: Array


@dataclass(frozen=True, slots=True, eq=False)
class GraphSolution:
    """The state of least cost.

    Attributes
    ----------
    state:
        As found.
    position_weight:
        (P,) from 0 to 1: how much of each position was believed.
    steps:
        That lowered the cost.
    converged:
        Whether the solver stopped by its tolerance and not by its number of steps.
    """

    state: GraphState
    position_weight: Array
    steps: int
    converged: bool


def solve(
    graph: PoseGraph, start: GraphState, *, check: Callable[[int], None] = lambda step: None
) -> GraphSolution:
    """Return the state that fits the measurements best.

    Parameters
    ----------
    graph:
        Every path must be held by positions (and attitudes where it is straight), or the equations are singular.
    start:
        Near enough for rotations to converge: tens of degrees.
    check:
        Told the number of each step; raises to stop.
    """
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    state, damping, steps, converged = start, _FIRST_DAMPING, 0, False
    left = _residuals(graph, state)
    cost = _cost(left)
    for number in range(_STEPS):
        check(number)
        design, residual = _linearised(graph, state, left)
        normal, gradient = (design.T @ design).tocsc(), design.T @ residual
        scaling = diags_array(np.maximum(normal.diagonal(), 1e-12))
        while damping < _MOST_DAMPING:
            step = -splu((normal + damping * scaling).tocsc()).solve(gradient)
            trial = _moved(state, step)
            trial_left = _residuals(graph, trial)
            trial_cost = _cost(trial_left)
            if trial_cost <= cost:
                break
            damping *= 10.0
        else:
            # No step lowers the cost any more: rounding is all that is left.
            converged = True
            break
        converged = float(np.abs(step).max()) < _STEP_TOLERANCE or cost - trial_cost <= _COST_TOLERANCE * cost
        state, left, cost, damping, steps = trial, trial_left, trial_cost, max(damping / 10.0, 1e-12), steps + 1
        if converged:
            break
    return GraphSolution(state, _weights(left[2]), steps, converged)


def _residuals(graph: PoseGraph, state: GraphState) -> tuple[Array, Array, Array, Array]:
    """Return what is left of turns (M, 3), shifts (M, 3), positions (P, 3), attitudes (A, 3), in sigmas."""
    a, b = state.rotations[graph.first], state.rotations[graph.second]
    turns = _vectors(np.swapaxes(graph.turn, 1, 2) @ np.swapaxes(a, 1, 2) @ b)
    moved = np.einsum("nji,nj->ni", a, state.centres[graph.second] - state.centres[graph.first])
    shifts = moved - np.exp(state.log_scales[graph.path])[:, None] * graph.shift
    return (
        turns / graph.turn_sigma[:, None],
        shifts / graph.shift_sigma[:, None],
        (state.centres[graph.placed] - graph.position) / graph.position_sigma,
        _vectors(graph.attitude @ state.rotations[graph.turned]) / graph.attitude_sigma,
    )


def _cost(left: tuple[Array, Array, Array, Array]) -> float:
    robust = sum(_CAUCHY**2 * float(np.log1p(np.square(part).sum(axis=1) / _CAUCHY**2).sum()) for part in left[2:])
    return robust + sum(float(np.square(part).sum()) for part in left[:2])


def _weights(left: Array) -> Array:
    weights: Array = 1.0 / (1.0 + np.square(left).sum(axis=1) / _CAUCHY**2)
    return weights


def _linearised(
    graph: PoseGraph, state: GraphState, left: tuple[Array, Array, Array, Array]
) -> tuple[sparse.csr_array, Array]:
    """Return the weighted design (rows, 6 N + S) and residuals (rows,) of a small change of the state.

    Columns 6 n to 6 n + 2 turn node n about its own axes, 6 n + 3 to 6 n + 5 move it in the world; the last ones
    are the logarithms of the scales.
    """
    from scipy.sparse import csr_array

    count = len(state.centres)
    eye = np.eye(3)
    a, b = state.rotations[graph.first], state.rotations[graph.second]
    to_a = np.swapaxes(a, 1, 2)
    moved = np.einsum("nij,nj->ni", to_a, state.centres[graph.second] - state.centres[graph.first])
    sizes = [len(part) for part in left]
    start = 3 * np.concatenate([[0], np.cumsum(sizes)])
    per_turn, per_shift = 1.0 / graph.turn_sigma[:, None, None], 1.0 / graph.shift_sigma[:, None, None]
    whole = np.broadcast_to(eye, (len(a), 3, 3))
    scaled = np.exp(state.log_scales[graph.path])[:, None] * graph.shift
    heavy = [np.sqrt(_weights(part))[:, None] for part in left[2:]]
    blocks = [
        # Log(M^T A^T B): to first order its derivative by B's turn is the identity, by A's -(A^T B)^T.
        _block(start[0], 6 * graph.second, whole * per_turn),
        _block(start[0], 6 * graph.first, -np.swapaxes(to_a @ b, 1, 2) * per_turn),
        _block(start[1], 6 * graph.first, _cross(moved) * per_shift),
        _block(start[1], 6 * graph.second + 3, to_a * per_shift),
        _block(start[1], 6 * graph.first + 3, -to_a * per_shift),
        _block(start[1], 6 * count + graph.path, -scaled[:, :, None] * per_shift),
        _block(start[2], 6 * graph.placed + 3, eye * (heavy[0] / graph.position_sigma)[:, :, None]),
        _block(start[3], 6 * graph.turned, eye * (heavy[1] / graph.attitude_sigma)[:, :, None]),
    ]
    rows, columns, values = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    shape = (int(start[-1]), 6 * count + len(state.log_scales))
    residual = np.concatenate(
        [*(part.ravel() for part in left[:2]), *(h * p for h, p in zip(heavy, left[2:], strict=True))], axis=None
    )
    return csr_array((values, (rows, columns)), shape=shape), residual


def _block(row: int, columns: Index, values: Array) -> tuple[Index, Index, Array]:
    """Return rows, columns and values of blocks (n, 3, k), one below the other from ``row`` on."""
    count, high, wide = values.shape
    rows = row + np.arange(count * high).reshape(count, high, 1) + np.zeros((1, 1, wide), dtype=np.int64)
    places = columns[:, None, None] + np.arange(wide)[None, None] + np.zeros((1, high, 1), dtype=np.int64)
    return rows.ravel(), places.ravel(), values.ravel()


def _moved(state: GraphState, step: Array) -> GraphState:
    from scipy.spatial.transform import Rotation

    count = len(state.centres)
    nodes = step[: 6 * count].reshape(count, 6)
    turned = state.rotations @ Rotation.from_rotvec(nodes[:, :3]).as_matrix()
    return replace(
        state,
        rotations=turned,
        centres=state.centres + nodes[:, 3:],
        log_scales=state.log_scales + step[6 * count :],
    )


def _cross(vectors: Array) -> Array:
    """Return the matrices (N, 3, 3) of ``v x`` for vectors (N, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _vectors(rotations: Array) -> Array:
    from scipy.spatial.transform import Rotation

    if not len(rotations):
        return np.zeros((0, 3))
    return np.asarray(Rotation.from_matrix(rotations).as_rotvec())
