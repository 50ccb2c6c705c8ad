"""How well a trained map lies on the surface: against the dense cloud, and against the truth where there is one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from toolkit import localize, metrics
from toolkit.depth.dense_folder import open_depth_views
from toolkit.errors import StageError
from toolkit.files import disk_errors
from toolkit.geometry.alignment import Similarity
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.ray_casting import MeshCaster
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.settings import ReliabilitySettings
from toolkit.metrics.splat_geometry import (
    DepthBias,
    cloud_distances,
    depth_bias,
    displacements,
    distance_summary,
    ray_errors,
)
from toolkit.metrics.trajectory import trajectory_errors
from toolkit.progress import Progress, track
from toolkit.recipes.base import RecipeContext, RecipeInput
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.dense_steps import DENSE, FUSED
from toolkit.recipes.map_train import ORIGINS
from toolkit.recipes.steps import SCENE
from toolkit.samples.surfaces import sample_folder, true_surface
from toolkit.scene import Frame, Scene
from toolkit.scene.folder import read_scene
from toolkit.scene.mesh_files import read_cloud

if TYPE_CHECKING:
    from toolkit.localize.splat_map import MapView, SplatMap

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Distances and displacements of single Gaussians, for figures, in a file of tensors; and its names.
GEOMETRY: Final = "map_geometry.safetensors"
#: Views that are rendered and compared, evenly among the map's photos, and rows and columns of each that count.
_MOST_VIEWS: Final = 40
_STRIDE: Final = 3


def map_geometry(
    data: RecipeInput,
    flat: CachedStage,
    maps: CachedStage,
    fused: CachedStage,
    trained: CachedStage,
    max_side: int,
    reliable: ReliabilitySettings,
    context: RecipeContext,
) -> CachedStage:
    """Return the stage map-geometry, whose report has the measures and whose folder ``GEOMETRY``.

    Parameters
    ----------
    flat, maps, fused, trained:
        Undistorted scene, stereo's depth maps, dense cloud, and the map.
    max_side:
        Of the renders in pixels, as in the training.
    reliable:
        Which pixels may be back-projected.
    """

    def measured_into(folder: Path) -> dict[str, Any]:
        from toolkit.localize.splat_map import SplatMap
        from toolkit.splat.map_file import read_map

        scene, stored = read_scene(flat.folder / SCENE), read_map(trained.folder)
        cloud = read_cloud(fused.folder / FUSED).xyz
        truth = Truth.of(scene, data)
        map_ = SplatMap(stored.gaussians, stored.kind)
        report: dict[str, Any] = _of_centres(map_, trained.folder, cloud, folder)
        views = _views(map_, scene, max_side, reliable, context.progress)
        report |= _of_depth(views, cloud, truth)
        if isinstance(truth, Truth):
            report["stereo"] = _of_stereo(maps.folder / DENSE, truth, context.progress)
        else:
            report["reason"] = truth
        return report

    return cached_stage(
        context,
        "map-geometry",
        inputs={
            "scene": flat.output.key,
            "maps": maps.output.key,
            "map": trained.output.key,
            "max_side": max_side,
            "truth": None if data.reference is None else str(sample_folder(data.reference)),
        },
        settings=reliable,
        code=(localize, metrics),
        build=measured_into,
    )


@dataclass(frozen=True, slots=True)
class Truth:
    """The true surface of a sample, and how the map's world lies in its world.

    Attributes
    ----------
    true_from_map:
        Similarity that lays the camera centres of the map's photos onto the true ones.
    """

    caster: MeshCaster
    true_from_map: Similarity

    @classmethod
    def of(cls, scene: Scene, data: RecipeInput) -> Truth | str:
        """Return the truth, or why there is none."""
        folder = None if data.reference is None else sample_folder(data.reference)
        if data.reference is None or folder is None:
            return "the data have no true surface"
        own = scene.replace(frames=scene.of_split("train"), points=None)
        try:
            errors = trajectory_errors(own, data.reference, "sim3")
        except StageError as error:
            return str(error)
        return cls(MeshCaster(true_surface(folder)), errors.reference_from_estimate)

    def errors(self, depth: NDArray[np.floating], camera: ColmapCamera, cam_from_map: RigidTransform) -> Array:
        """Return by how much a depth map (H, W) is too deep along its rays, in true units; NaN where unknown."""
        true = self.caster.depth(camera, self.true_from_map.apply_to_pose(cam_from_map))
        return ray_errors(self.true_from_map.scale * depth.astype(np.float64), true, camera)


def chosen_views(scene: Scene) -> tuple[Frame, ...]:
    """Return at most so many photos of the map as are measured, evenly among all."""
    frames = scene.of_split("train")
    rows = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), _MOST_VIEWS)).round().astype(int))
    return tuple(frames[row] for row in rows)


def _of_centres(map_: SplatMap, trained: Path, cloud: Array, folder: Path) -> dict[str, Any]:
    """Return distances of the Gaussians' centres to the dense cloud and their displacement; write them down."""
    import torch
    from safetensors.torch import load_file, save_file

    centres = map_.gaussians.means.numpy().astype(np.float64)
    opacities = torch.sigmoid(map_.gaussians.opacity_logits).numpy()
    origins = load_file(trained / ORIGINS)["origins"].numpy().astype(np.float64)
    apart, moved = cloud_distances(centres, cloud), displacements(origins, centres, opacities)
    tensors = {
        "centres": centres,
        "distance": apart,
        "horizontal": moved.horizontal,
        "vertical": moved.vertical,
        "opacity": opacities,
    }
    with disk_errors(folder / GEOMETRY, "writing"):
        save_file(
            {name: torch.from_numpy(values.astype(np.float32)) for name, values in tensors.items()},
            folder / GEOMETRY,
        )
    distances = {"all": distance_summary(apart)}
    if moved.opaque.any():
        distances["opaque"] = distance_summary(apart[moved.opaque])
    return {"centres_to_cloud": distances, "displacement": moved.to_dict()}


def _views(
    map_: SplatMap, scene: Scene, max_side: int, reliable: ReliabilitySettings, progress: Progress
) -> Iterable[MapView]:
    for frame in track(chosen_views(scene), "map.geometry", progress):
        camera = scene.camera_of(frame)
        assert isinstance(camera, ColmapCamera)
        assert frame.cam_from_world is not None
        shrink = max(camera.width, camera.height) / max_side
        if shrink > 1:
            camera = camera.scaled(max(1, round(camera.width / shrink)), max(1, round(camera.height / shrink)))
        yield map_.render(camera, frame.cam_from_world, reliable)


def _of_depth(views: Iterable[MapView], cloud: Array, truth: Truth | str) -> dict[str, Any]:
    """Return distances of rendered depth to the cloud, and its errors against the truth where there is one."""
    distances: list[Array] = []
    errors: list[Array] = []
    kept: list[Mask] = []
    whole, sound = 0, 0
    for view in views:
        height, width = view.depth.shape
        rows, columns = np.mgrid[_STRIDE // 2 : height : _STRIDE, _STRIDE // 2 : width : _STRIDE].reshape(2, -1)
        points, drawn = view.points(np.stack([columns, rows], axis=1) + 0.5, all_depths=True)
        whole, sound = whole + view.reliable.size, sound + int(view.reliable.sum())
        kept.append(view.reliable[rows, columns][drawn])
        distances.append(cloud_distances(points[drawn], cloud))
        if isinstance(truth, Truth):
            found = truth.errors(view.depth, view.camera, view.cam_from_world)
            errors.append(found[rows, columns][drawn])
    reliable, apart = np.concatenate(kept), np.concatenate(distances)
    report: dict[str, Any] = {
        "depth_to_cloud": _of_groups(apart, reliable, distance_summary),
        "reliable_share": sound / max(whole, 1),
    }
    if errors:
        report["depth"] = _of_groups(np.concatenate(errors), reliable, _bias)
    return report


def _of_stereo(dense: Path, truth: Truth, progress: Progress) -> dict[str, float] | None:
    """Return the errors of stereo's own depth, from which the dense cloud came."""
    errors = []
    views = list(open_depth_views(dense))
    for view in track(views[:: max(1, len(views) // _MOST_VIEWS)], "map.stereo", progress):
        found = truth.errors(view.depth, view.camera, view.cam_from_world)
        errors.append(found[::_STRIDE, ::_STRIDE].reshape(-1))
    return _bias(np.concatenate(errors)) if errors else None


def _of_groups(values: Array, reliable: Mask, summary: Any) -> dict[str, Any]:
    groups = {"all": values, "reliable": values[reliable]}
    return {name: summary(group) for name, group in groups.items() if np.isfinite(group).any()}


def _bias(errors: Array) -> dict[str, float]:
    found: DepthBias = depth_bias(errors)
    return found.to_dict()


def geometry_metrics(report: dict[str, Any]) -> dict[str, float | None]:
    """Return the flat table of a geometry report, in scene units, errors of depth in true units."""

    def at(*keys: str) -> float | None:
        value: Any = report
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        return None if value is None else float(value)

    table = {
        "map.c2c_median": at("centres_to_cloud", "all", "median"),
        "map.depth_c2c_median": at("depth_to_cloud", "all", "median"),
        "map.reliable_share": at("reliable_share"),
        "map.moved_horizontal": at("displacement", "all", "horizontal", "median"),
        "map.moved_vertical": at("displacement", "all", "vertical", "median"),
        "map.depth_bias": at("depth", "reliable", "bias"),
        "map.depth_spread": at("depth", "reliable", "spread"),
        "map.depth_std": at("depth", "reliable", "std"),
        "map.depth_bias_all": at("depth", "all", "bias"),
        "map.depth_spread_all": at("depth", "all", "spread"),
        "map.depth_std_all": at("depth", "all", "std"),
        "map.stereo_bias": at("stereo", "bias"),
        "map.stereo_spread": at("stereo", "spread"),
    }
    return {name: value for name, value in table.items() if value is not None}
