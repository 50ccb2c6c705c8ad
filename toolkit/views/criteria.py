r"""What a set of viewing directions tells: the Fisher information matrix and its criteria.

Of unit directions :math:`u_i` it is :math:`F = \sum_i u_i u_i^T` (satellite paper, section 4.2). With its
eigenvalues :math:`a \ge b \ge c` the criteria are

- D: the determinant :math:`abc`, the sum over all triples of views of their squared volume;
- A: :math:`1 / \mathrm{tr} F^{-1} = abc / (ab + ac + bc)`;
- E: :math:`c`.

All three are larger the more the views spread. They are zero for fewer than three views and for views in one
plane. What then still tells sets apart is :math:`ab + ac + bc`, the sum over all pairs of views of the squared sine
of their angle, here ``pair_angles``: of two views the one with the largest angle. It is the order in which D and A
put such sets when :math:`\epsilon I` is added to :math:`F`, the smaller the :math:`\epsilon` the more exactly; as
the trace is the number of views, the second eigenvalue gives the same one.

A view more or less is a rank-one update. In three dimensions the matrix determinant lemma is taken with the
adjugate, :math:`\det(F + uu^T) = \det F + u^T \mathrm{adj}(F) u`, which holds where :math:`F` has no inverse, too:
for the first two picks, and for views in a plane. The adjugate has closed form, so that the inverse that Sherman
and Morrison would update is not needed, and nothing is divided by a determinant that may be zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Measure = Literal["D", "A", "E", "pair_angles"]

#: Directions lie in a plane (on a line) where their root mean square distance from it is at most this, in radians.
FLAT = 1e-6
#: How often the entries xx, yy, zz, xy, xz, yz of a symmetric matrix stand in it.
_TWICE = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])
#: Matrices whose eigenvalues are found at once.
_BATCH = 200_000


def squares(directions: Array) -> Array:
    """Return xx, yy, zz, xy, xz, yz (n, 6) of vectors (n, 3): their outer products, each entry once."""
    x, y, z = directions.T
    return np.stack([x * x, y * y, z * z, x * y, x * z, y * z], axis=1)


def determinant(packed: Array) -> Array:
    """Return determinants (...) of symmetric matrices (..., 6) packed as by :func:`squares`."""
    xx, yy, zz, xy, xz, yz = np.moveaxis(packed, -1, 0)
    value: Array = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return value


def adjugate(packed: Array) -> Array:
    """Return adjugates (..., 6) of packed symmetric matrices (..., 6)."""
    xx, yy, zz, xy, xz, yz = np.moveaxis(packed, -1, 0)
    return np.stack(
        [
            yy * zz - yz * yz,
            xx * zz - xz * xz,
            xx * yy - xy * xy,
            xz * yz - xy * zz,
            xy * yz - xz * yy,
            xy * xz - yz * xx,
        ],
        axis=-1,
    )


def pair_angles(packed: Array) -> Array:
    """Return the sum of the principal 2 x 2 minors (...) of packed matrices (..., 6): see the module's text."""
    xx, yy, zz, xy, xz, yz = np.moveaxis(packed, -1, 0)
    value: Array = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    return value


def eigenvalues(packed: Array) -> Array:
    """Return eigenvalues (m, 3), ascending, of packed symmetric matrices (m, 6)."""
    found = [
        np.linalg.eigvalsh(packed[i : i + _BATCH][:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(-1, 3, 3))
        for i in range(0, len(packed), _BATCH)
    ]
    return np.concatenate(found) if found else np.zeros((0, 3))


def rank(directions: Array) -> int:
    """Return how many dimensions unit directions (n, 3) span, to within :data:`FLAT`: 0 to 3."""
    if not len(directions):
        return 0
    # Of the mean outer product, whose eigenvalues are squared distances, exact to 1e-16: enough for FLAT squared.
    spread = np.linalg.eigvalsh(directions.T @ directions / len(directions))
    return int(np.sum(spread > FLAT**2))


@dataclass(frozen=True, eq=False)
class Information:
    """Candidate views, made ready for the criteria of their subsets.

    Attributes
    ----------
    directions:
        (n, 3) unit.
    outer:
        (n, 6) their outer products, packed as by :func:`squares`.
    white:
        (n, 6) those of the directions scaled along the principal axes of all of them, so that their mean outer
        product is the unit matrix. That multiplies all determinants by the same number; it keeps them, and so the
        order of sets, exact where all views look nearly the same way.
    scale:
        What a determinant of sums of ``white`` must be multiplied by to be one of sums of ``outer``.
    """

    directions: Array
    outer: Array
    white: Array
    scale: float

    @classmethod
    def of(cls, directions: Array, usable: NDArray[np.bool_] | None = None) -> Information:
        """Prepare unit directions (n, 3); axes and scale are those of the ``usable`` (n,) ones."""
        outer = squares(directions)
        chosen = directions if usable is None else directions[usable]
        spread, axes = np.linalg.eigh(chosen.T @ chosen / max(1, len(chosen)))
        # Directions in a plane are left unscaled across it: what is there is rounding.
        lengths = np.where(spread > FLAT**2, np.sqrt(np.abs(spread)), 1.0)
        white = squares(directions @ axes / lengths)
        return cls(directions, outer, white, float(np.prod(lengths) ** 2))

    def __len__(self) -> int:
        return len(self.directions)

    def value(self, measure: Measure, outer: Array, white: Array) -> Array:
        """Return the measure (...) of sets from the sums (..., 6) of their ``outer`` and ``white`` products."""
        if measure == "D":
            return self.scale * determinant(white)
        if measure == "pair_angles":
            return pair_angles(outer)
        if measure == "E":
            return eigenvalues(outer.reshape(-1, 6))[:, 0].reshape(outer.shape[:-1])
        return _ratio(self.scale * determinant(white), pair_angles(outer))

    def of_set(self, measure: Measure, chosen: list[int]) -> float:
        """Return the measure of the set of these candidates."""
        return float(self.value(measure, self.outer[chosen].sum(axis=0), self.white[chosen].sum(axis=0)))

    def with_one_more(self, measure: Measure, outer: Array, white: Array) -> Array:
        """Return the measure (m, n) of m sets, of sums (m, 6), each with one of the n candidates added."""
        if measure == "E":
            sums = outer[:, None, :] + self.outer[None, :, :]
            return self.value("E", sums, sums)
        angles = np.zeros(0)
        if measure != "D":
            # The same lemma for the sum of minors, of a unit vector: + tr F - u'Fu.
            constant = pair_angles(outer) + outer[:, :3].sum(axis=1)
            angles = constant[:, None] - (outer * _TWICE) @ self.outer.T
            if measure == "pair_angles":
                return angles
        volumes = determinant(white)[:, None] + (adjugate(white) * _TWICE) @ self.white.T
        volumes *= self.scale
        return volumes if measure == "D" else _ratio(volumes, angles)


def _ratio(above: Array, below: Array) -> Array:
    """Return the quotient, zero where the divisor is not positive."""
    return np.divide(above, below, out=np.zeros_like(np.asarray(above, float)), where=np.asarray(below) > 0)
