"""How far a surface is from the true one: accuracy, completeness, precision, recall, F-score, normals.

Distances go both ways. From what was found to the truth: accuracy (Jensen et al., 2014, "Large scale multi-view
stereopsis evaluation", DTU); from the truth to what was found: completeness. The shares of both below a
threshold are precision and recall, and their harmonic mean is the F-score (Knapitsch et al., 2017, "Tanks and
Temples", section 5). Meshes are sampled evenly by area first, so that the sizes of triangles do not weigh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError, StageError
from toolkit.geometry.cameras import Camera
from toolkit.geometry.ray_casting import MeshCaster
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.surface import Cloud, Mesh
from toolkit.geometry.triangles import sample_surface
from toolkit.progress import Progress, silent, track

Array = NDArray[np.float64]
Seer = tuple[Camera, RigidTransform]
"""A camera and its ``cam_from_world``."""

#: Thresholds where none are given, in parts of the diagonal of the box around the truth that counts.
SHARES = (0.001, 0.002, 0.005, 0.01)
#: Points that are measured on either surface where no other number is given.
SAMPLES = 100_000

#: How many times more samples of a truth are tried where the cameras see little of it.
_MOST_TRIES = 10
_SLACK = 1e-3  # of the distance from the camera: a sample in the seen surface is not hidden by it


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceErrors:
    """Distances between a surface and the true one, in the truth's units.

    Attributes
    ----------
    found:
        (n, 3) points of the surface that were measured.
    accuracy:
        (n,) their distances to the truth.
    truth:
        (m, 3) points of the truth that were looked for.
    completeness:
        (m,) their distances to what was found.
    normal_angle_deg:
        (n,) angles of 0 to 90 degrees between the found surface's normals and those of the truth at the nearest
        place, whichever way both point; None where one of them has no normals.
    thresholds:
        At which precision, recall and F-score are told.
    scope:
        Which parts of both count, in words.
    left_out:
        Shares of the samples of the found surface and of the truth that do not count.
    """

    found: Array
    accuracy: Array
    truth: Array
    completeness: Array
    normal_angle_deg: Array | None
    thresholds: tuple[float, ...]
    scope: str
    left_out: tuple[float, float]

    def precision(self, threshold: float) -> float:
        """Return the share of the found points nearer to the truth than ``threshold``."""
        return float(np.mean(self.accuracy < threshold))

    def recall(self, threshold: float) -> float:
        """Return the share of the truth's points nearer to what was found than ``threshold``."""
        return float(np.mean(self.completeness < threshold))

    def f_score(self, threshold: float) -> float:
        """Return the harmonic mean of precision and recall, 0 where both are."""
        precision, recall = self.precision(threshold), self.recall(threshold)
        return 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the measures, ready for JSON."""
        return {
            "scope": self.scope,
            "left_out": {"found": self.left_out[0], "truth": self.left_out[1]},
            "samples": {"found": len(self.accuracy), "truth": len(self.completeness)},
            "accuracy": _summary(self.accuracy),
            "completeness": _summary(self.completeness),
            "normal_angle_deg": None if self.normal_angle_deg is None else _summary(self.normal_angle_deg),
            "thresholds": [
                {
                    "threshold": threshold,
                    "precision": self.precision(threshold),
                    "recall": self.recall(threshold),
                    "f_score": self.f_score(threshold),
                }
                for threshold in self.thresholds
            ],
        }


def compare_surfaces(
    found: Mesh | Cloud,
    truth: Mesh | Cloud,
    *,
    thresholds: Sequence[float] = (),
    seen_from: Sequence[Seer] = (),
    far: float = np.inf,
    samples: int = SAMPLES,
    seed: int = 0,
    progress: Progress = silent,
) -> SurfaceErrors:
    """Return the distances between a surface and the truth; both are in one world.

    Parameters
    ----------
    found, truth:
        A mesh is sampled evenly by area, and distances to it are to its triangles; distances to a cloud are to its
        nearest point, so it should be denser than the thresholds.
    thresholds:
        In the truth's units; ``SHARES`` of the truth's box where there are none.
    seen_from:
        Cameras that saw the scene. With a true mesh, the truth that counts is what one of them sees (by casting
        rays), and of the found surface what is in a picture and not behind the true surface there by more than
        the largest threshold: nobody can know what is there. With a true cloud, found points count in the box of
        the cloud grown by the largest threshold, and cameras are not asked. Without cameras, with a true mesh, all
        counts.
    far:
        What is farther than this from each camera in whose picture it is does not count.
    samples:
        Points on either side; a larger cloud is thinned by chance.

    Raises
    ------
    DataError
        For an empty cloud, a mesh without faces, or a threshold that is not positive.
    StageError
        Where the cameras see nothing of the truth, or nothing that was found counts.
    MissingDependencyError
        When Open3D is missing.
    """
    if any(not threshold > 0 for threshold in thresholds):
        raise DataError("A threshold is no distance", expected="numbers above 0", found=str(tuple(thresholds)))
    ours = _points_of(found, "found", samples, seed)
    theirs = _points_of(truth, "true", samples, seed + 1)
    if isinstance(truth, Mesh):
        caster = MeshCaster(truth)
        view = _Sight(caster, seen_from, far)
        sees = view.of(theirs.xyz, 0.0, progress)
        if 0 < sees.mean() < 0.5:
            # A truth may be far larger than what was seen: enough of its samples are to count.
            tries = int(samples / max(float(sees.mean()), 1 / _MOST_TRIES))
            theirs = sample_surface(truth, tries, seed=seed + 1)
            sees = view.of(theirs.xyz, 0.0, progress)
        limits = _limits(thresholds, theirs.xyz[sees])
        counts = view.of(ours.xyz, max(limits), progress)
        scope = "what the cameras see, by casting rays against the truth" if seen_from else "all"
    else:
        caster = None
        sees = np.ones(len(theirs), bool)
        limits = _limits(thresholds, theirs.xyz)
        low, high = theirs.xyz.min(axis=0) - max(limits), theirs.xyz.max(axis=0) + max(limits)
        counts = np.all((ours.xyz >= low) & (ours.xyz <= high), axis=1)
        scope = "the box of the true cloud"
    if not counts.any():
        raise StageError(
            "Nothing that was found is where the truth can be told",
            expected="a surface before the true one, in view of the cameras or in its box",
            found=f"none of {len(ours)} points",
            todo="See that both are in one world: align the poses first",
        )
    measured = Cloud(ours.xyz[counts], None, None if ours.normals is None else ours.normals[counts])
    accuracy, normals = _distances(measured.xyz, truth if caster is None else caster)
    completeness, _ = _distances(theirs.xyz[sees], MeshCaster(found) if isinstance(found, Mesh) else found)
    return SurfaceErrors(
        measured.xyz,
        accuracy,
        theirs.xyz[sees],
        completeness,
        _angles(measured.normals, normals),
        limits,
        scope,
        (float((~counts).mean()), float((~sees).mean())),
    )


def _summary(values: Array) -> dict[str, float]:
    return {
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "rms": float(np.sqrt(np.mean(values**2))),
        "p90": float(np.percentile(values, 90)),
        "max": float(values.max()),
    }


def _points_of(surface: Mesh | Cloud, which: str, samples: int, seed: int) -> Cloud:
    """Return points of a surface, at most ``samples``."""
    if isinstance(surface, Mesh):
        return sample_surface(surface, samples, seed=seed)
    if not len(surface):
        raise DataError(f"The {which} cloud is empty", expected="points to measure", found="none")
    if len(surface) <= samples:
        return surface
    rows = np.sort(np.random.default_rng(seed).choice(len(surface), samples, replace=False))
    return Cloud(surface.xyz[rows], None, None if surface.normals is None else surface.normals[rows])


def _limits(thresholds: Sequence[float], truth: Array) -> tuple[float, ...]:
    if not len(truth):
        raise StageError(
            "The cameras see nothing of the true surface",
            expected="cameras in the truth's world",
            found="no sample in any picture",
            todo="Align the poses to the truth first",
        )
    if thresholds:
        return tuple(sorted(float(threshold) for threshold in thresholds))
    diagonal = float(np.linalg.norm(np.ptp(truth, axis=0)))
    return tuple(share * diagonal for share in SHARES)


@dataclass(frozen=True, slots=True)
class _Sight:
    """What cameras see of a true mesh; without cameras all of it."""

    caster: MeshCaster
    seen_from: Sequence[Seer]
    far: float

    def of(self, points: Array, behind: float, progress: Progress) -> NDArray[np.bool_]:
        """Return which points (n,) are in a picture, near enough and at most so far ``behind`` the mesh."""
        if not self.seen_from:
            return np.ones(len(points), dtype=bool)
        seen = np.zeros(len(points), dtype=bool)
        for camera, cam_from_world in track(self.seen_from, "metrics.visible", progress):
            rows = np.flatnonzero(~seen)
            in_camera = cam_from_world.apply(points[rows])
            apart = np.linalg.norm(in_camera, axis=1)
            near = apart <= self.far
            rows, in_camera, apart = rows[near], in_camera[near], apart[near]
            pixels = camera.project(in_camera)
            with np.errstate(invalid="ignore"):
                inside = np.all((pixels >= 0) & (pixels <= (camera.width, camera.height)), axis=1)
            rows, apart = rows[inside], apart[inside]
            reach = self.caster.reach(cam_from_world.centre, points[rows]) * apart
            seen[rows] = reach >= apart * (1 - _SLACK) - behind
        return seen


def _distances(points: Array, surface: MeshCaster | Mesh | Cloud) -> tuple[Array, Array | None]:
    """Return distances (n,) to a surface, and its normals (n, 3) at the nearest place where it has any."""
    if isinstance(surface, MeshCaster):
        return surface.nearest(points)
    from scipy.spatial import cKDTree

    assert isinstance(surface, Cloud)
    apart, nearest = cKDTree(surface.xyz).query(points, workers=-1)
    return apart, None if surface.normals is None else surface.normals[nearest]


def _angles(ours: Array | None, theirs: Array | None) -> Array | None:
    if ours is None or theirs is None:
        return None
    cosine = np.abs(np.einsum("ni,ni->n", ours, theirs))
    angles: Array = np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0)))
    return angles
