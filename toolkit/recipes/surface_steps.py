"""What every recipe with a surface does in the end: it writes the mesh and measures it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import StageError
from toolkit.geometry.decimate import decimate
from toolkit.geometry.ray_casting import MeshCaster
from toolkit.geometry.surface import Mesh
from toolkit.geometry.triangles import moved
from toolkit.metrics.geometry import SAMPLES, Seer, SurfaceErrors, compare_surfaces
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.progress import Progress, silent
from toolkit.recipes.base import RecipeContext, RecipeInput
from toolkit.recipes.surface_files import MESH_FILE, MOST_FACES
from toolkit.samples.surfaces import sample_folder, true_surface
from toolkit.scene import Scene
from toolkit.scene.mesh_files import write_mesh

#: Which of the thresholds the metrics tell: half a percent of the box around the truth that was seen.
_TOLD = 2
#: Median distances from the camera beyond which nothing counts, and rays on a side of a picture to find the median.
_FAR, _GRID = 3.0, 16


def mesh_artifacts(
    mesh: Mesh, data: RecipeInput, context: RecipeContext, *, scene: Scene
) -> tuple[dict[str, float | None], dict[str, Any]]:
    """Write ``mesh.ply`` into the artifacts, and measure the mesh against the true surface where the data have one.

    The file is decimated below ``MOST_FACES``; what is measured is the mesh as it came.

    Parameters
    ----------
    scene:
        With the poses that the mesh was made with: its world is the mesh's.

    Returns
    -------
    metrics, report:
        ``mesh.faces`` and ``mesh.<measure>`` in units of the truth, degrees and shares; what the entry ``mesh`` of
        the reports takes. Where the mesh could not be measured the report says why in ``reason``.

    Raises
    ------
    DataError
        For a mesh without faces.
    """
    small = decimate(mesh, MOST_FACES)
    write_mesh(context.artifacts / MESH_FILE, small)
    metrics: dict[str, float | None] = {"mesh.faces": float(len(mesh.faces))}
    report: dict[str, Any] = {
        "file": MESH_FILE,
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "faces_in_file": len(small.faces),
        "box": [mesh.vertices.min(axis=0).tolist(), mesh.vertices.max(axis=0).tolist()],
    }
    try:
        errors = surface_errors(mesh, data, scene=scene, seed=context.seed, progress=context.progress)
    except StageError as error:
        return metrics, {**report, "reason": str(error)}
    threshold = errors.thresholds[_TOLD]
    metrics |= {
        "mesh.accuracy": float(errors.accuracy.mean()),
        "mesh.completeness": float(errors.completeness.mean()),
        "mesh.precision": errors.precision(threshold),
        "mesh.recall": errors.recall(threshold),
        "mesh.f_score": errors.f_score(threshold),
        "mesh.threshold": threshold,
    }
    if errors.normal_angle_deg is not None:
        metrics["mesh.normal_angle_deg"] = float(errors.normal_angle_deg.mean())
    return metrics, {**report, "errors": errors.to_dict()}


def surface_errors(
    mesh: Mesh,
    data: RecipeInput,
    *,
    scene: Scene,
    samples: int = SAMPLES,
    seed: int = 0,
    progress: Progress = silent,
) -> SurfaceErrors:
    """Return the errors of a mesh against the true surface of a sample, in its world and units.

    The mesh is laid onto the truth by the similarity that aligns the camera centres of ``scene`` with the true
    ones. What is farther than three times the median distance of what the pictures show does not count: plains up
    to the horizon have most of a town's area.

    Raises
    ------
    StageError
        Where the data have no true surface, poses cannot be aligned, or mesh and truth have nothing in common.
    """
    folder = None if data.reference is None else sample_folder(data.reference)
    if data.reference is None or folder is None:
        raise StageError(
            "The data have no true surface", expected="a sample: the engine, or a flight over the town"
        )
    aligned = moved(mesh, trajectory_errors(scene, data.reference, "sim3").reference_from_estimate)
    cameras: list[Seer] = [
        (data.reference.camera_of(frame), frame.cam_from_world)
        for frame in data.reference.registered
        if frame.cam_from_world is not None
    ]
    truth = true_surface(folder)
    far = _FAR * _median_distance(MeshCaster(truth), cameras)
    return compare_surfaces(
        aligned, truth, seen_from=cameras, far=far, samples=samples, seed=seed, progress=progress
    )


def _median_distance(caster: MeshCaster, cameras: list[Seer]) -> float:
    """Return how far what the cameras see is from them, over a coarse grid of rays in each picture."""
    distances = []
    for camera, cam_from_world in cameras:
        column, row = np.meshgrid(
            (np.arange(_GRID) + 0.5) * camera.width / _GRID, (np.arange(_GRID) + 0.5) * camera.height / _GRID
        )
        rays = camera.ray(np.stack([column.ravel(), row.ravel()], axis=1))[1]
        rays = rays[np.isfinite(rays).all(axis=1)]
        distances.append(caster.cast(cam_from_world.centre, rays @ cam_from_world.rotation))
    met = np.concatenate(distances)
    met = met[np.isfinite(met)]
    if not len(met):
        raise StageError("The reference's cameras see nothing of the true surface", expected="true poses")
    return float(np.median(met))


def sparse_points(scene: Scene) -> NDArray[np.float64]:
    """Return the scene's points (n, 3).

    Raises
    ------
    StageError
        Where it has none.
    """
    if scene.points is None or not len(scene.points):
        raise StageError(
            "The scene has no sparse points",
            expected="those of structure from motion",
            found="poses alone",
            todo="Triangulate points first, or leave out what needs them",
        )
    return scene.points.xyz
