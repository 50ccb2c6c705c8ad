"""Least squares over corrections of RPC cameras and places of tie points: equations, one step, and sigmas.

The places are eliminated (Schur complement), so that only the pictures' unknowns, two or six each, are solved for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from toolkit.geometry.ellipsoid import geodetic_slopes
from toolkit.geometry.rpc_camera import RpcCamera

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Determinant, as part of the product of the diagonal, below which a place is not determined.
_SINGULAR = 1e-13
#: Points at a time whose sigmas are found.
_POINTS_AT_ONCE = 4096


@dataclass(frozen=True, eq=False)
class Observations:
    """Where points are seen, sorted by point.

    Attributes
    ----------
    camera, point:
        (M,) indices.
    pixel:
        (M, 2) pixels.
    """

    camera: Indices
    point: Indices
    pixel: Array

    def by_point(self, values: Array) -> Array:
        """Return sums (P, ...) of values (M, ...) over each point's observations; every point has one."""
        starts = np.flatnonzero(np.diff(self.point, prepend=-1))
        return np.add.reduceat(values, starts, axis=0)

    def by_camera(self, values: Array, count: int) -> Array:
        """Return sums (C, ...) of values (M, ...) over each camera's observations."""
        return np.stack([values[self.camera == index].sum(axis=0) for index in range(count)])


@dataclass(frozen=True, eq=False)
class Ground:
    """What is known beforehand of the points' places.

    Attributes
    ----------
    place:
        (P, 3) metres; zero where nothing is known.
    weight:
        (P, 3) one over the variance; zero where nothing is known.
    """

    place: Array
    weight: Array


@dataclass(frozen=True, eq=False)
class Linear:
    """The observations at given corrections and places.

    Attributes
    ----------
    miss:
        (M, 2) observed minus computed pixels.
    basis:
        (M, B) what each of the B coefficients in x, and as many in y, is multiplied with.
    slopes:
        (M, 2, 3) derivatives by the places.
    """

    miss: Array
    basis: Array
    slopes: Array


def linearise(
    cameras: Sequence[RpcCamera], corrections: Array, places: Array, seen: Observations, terms: int
) -> Linear:
    """Return residuals and derivatives; ``terms`` is 1 for shifts and 3 for affine corrections (C, 6)."""
    miss = np.empty((len(seen.point), 2))
    basis = np.empty((len(seen.point), terms))
    slopes = np.empty((len(seen.point), 2, 3))
    for index, camera in enumerate(cameras):
        rows = np.flatnonzero(seen.camera == index)
        bare = camera.with_correction(np.zeros(6).tolist())
        there = bare.geodetic(places[seen.point[rows]])
        own = bare.rpc.project(there, extrapolate=camera.extrapolate)
        away = np.concatenate([np.ones((len(rows), 1)), (own - camera.centre) / camera.half_side], axis=1)
        table = corrections[index].reshape(2, 3)
        miss[rows] = seen.pixel[rows] - own - away @ table.T
        basis[rows] = away[:, :terms]
        stretch = np.eye(2) + table[:, 1:] / camera.half_side
        by_geodetic = bare.rpc.jacobian(there, extrapolate=camera.extrapolate)
        slopes[rows] = stretch @ by_geodetic @ geodetic_slopes(there, camera.origin)
    return Linear(miss, basis, slopes)


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations with the places eliminated.

    Attributes
    ----------
    reduced:
        (U, U) matrix of the corrections' unknowns.
    right:
        (U,) right side.
    inverse:
        (P, 3, 3) inverses of the places' blocks.
    place_right:
        (P, 3) the places' right side.
    coupling:
        (U, 3 P) corrections by places.
    """

    reduced: Array
    right: Array
    inverse: Array
    place_right: Array
    coupling: sparse.csr_matrix

    def step(self) -> tuple[Array, Array]:
        """Return the steps of the corrections' unknowns (U,) and of the places (P, 3)."""
        unknowns: Array = np.asarray(np.linalg.solve(self.reduced, self.right), dtype=np.float64)
        rest = self.place_right - (self.coupling.T @ unknowns).reshape(-1, 3)
        return unknowns, np.einsum("pij,pj->pi", self.inverse, rest)

    def sigmas(self) -> tuple[Array, Array, Array]:
        """Return standard deviations of the unknowns (U,), the places (P, 3) and the places' mean (3,)."""
        covariance = np.linalg.inv(self.reduced)
        count = len(self.inverse)
        variance = np.einsum("pii->pi", self.inverse).copy()
        mean = np.zeros((3, len(covariance)))
        for start in range(0, count, _POINTS_AT_ONCE):
            stop = min(start + _POINTS_AT_ONCE, count)
            piece = self.coupling[:, 3 * start : 3 * stop].toarray().T.reshape(stop - start, 3, -1)
            carried = self.inverse[start:stop] @ piece
            variance[start:stop] += np.einsum("piu,uv,piv->pi", carried, covariance, carried, optimize=True)
            mean += carried.sum(axis=0)
        mean /= count
        mean_covariance = self.inverse.sum(axis=0) / count**2 + mean @ covariance @ mean.T
        return np.sqrt(np.diag(covariance)), np.sqrt(variance), np.sqrt(np.diag(mean_covariance))


def normal_equations(
    linear: Linear, seen: Observations, weight: Array, prior: Array, values: Array, ground: Ground, places: Array
) -> Normal:
    """Return the normal equations of one step.

    Parameters
    ----------
    linear, seen:
        Residuals, derivatives and which picture and point they belong to.
    weight:
        (M,) one over the variance of each image coordinate, robust factor included.
    prior:
        (C, 2 B) one over the variance of the corrections about zero.
    values:
        (C, 2 B) their present values.
    ground, places:
        What is known of the places, and where they are now (P, 3).
    """
    pictures, unknowns = prior.shape
    terms = unknowns // 2
    by_correction = np.zeros((len(weight), 2, unknowns))
    by_correction[:, 0, :terms] = by_correction[:, 1, terms:] = linear.basis
    weighted = by_correction * weight[:, None, None]
    blocks = seen.by_camera(weighted.transpose(0, 2, 1) @ by_correction, pictures)
    right = seen.by_camera(np.einsum("mij,mi->mj", weighted, linear.miss), pictures) - prior * values
    inverse, place_right = place_blocks(linear, seen, weight, ground, places)
    count = len(places)
    cross = weighted.transpose(0, 2, 1) @ linear.slopes
    rows = np.broadcast_to((seen.camera[:, None] * unknowns + np.arange(unknowns))[:, :, None], cross.shape)
    columns = np.broadcast_to((seen.point[:, None] * 3 + np.arange(3))[:, None, :], cross.shape)
    shape = (pictures * unknowns, 3 * count)
    carried = cross @ inverse[seen.point]
    coupling = sparse.csr_matrix((cross.ravel(), (rows.ravel(), columns.ravel())), shape=shape)
    solved = sparse.csr_matrix((carried.ravel(), (rows.ravel(), columns.ravel())), shape=shape)
    reduced = -(solved @ coupling.T).toarray()
    for index in range(pictures):
        own = slice(index * unknowns, (index + 1) * unknowns)
        reduced[own, own] += blocks[index] + np.diag(prior[index])
    return Normal(reduced, right.ravel() - solved @ place_right.ravel(), inverse, place_right, coupling)


def place_blocks(
    linear: Linear, seen: Observations, weight: Array, ground: Ground, places: Array
) -> tuple[Array, Array]:
    """Return the inverses (P, 3, 3) of the places' blocks, NaN where they are not determined, and right sides."""
    weighted = linear.slopes * weight[:, None, None]
    matrix = seen.by_point(weighted.transpose(0, 2, 1) @ linear.slopes)
    matrix += ground.weight[:, :, None] * np.eye(3)
    right = seen.by_point(np.einsum("mij,mi->mj", weighted, linear.miss))
    right += ground.weight * (ground.place - places)
    first, second, third = matrix.transpose(1, 0, 2)
    cofactors = np.stack([np.cross(second, third), np.cross(third, first), np.cross(first, second)], axis=-1)
    determinant = (first * cofactors[:, :, 0]).sum(axis=1)
    # Points seen along one line only have a matrix of rank two.
    sizes = np.einsum("pii->pi", matrix).prod(axis=1)
    determinant[~(determinant > _SINGULAR * sizes)] = np.nan
    return cofactors / determinant[:, None, None], right
