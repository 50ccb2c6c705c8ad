"""From a capture to a trained, georeferenced and measured splat map, and query photos placed in it."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from toolkit.depth.stereo_settings import FusionSettings, StereoSettings
from toolkit.files import disk_errors
from toolkit.localize.settings import ReliabilitySettings
from toolkit.matching.features import SiftSettings
from toolkit.matching.match import MatchSettings
from toolkit.matching.pairs import PairSettings
from toolkit.poses.sfm import SfmSettings
from toolkit.recipes.base import RecipeContext, RecipeInput
from toolkit.recipes.cached import CachedStage
from toolkit.recipes.dense_steps import FUSED, fusion_stage, stereo_stage
from toolkit.recipes.map_geometry import GEOMETRY, geometry_metrics, map_geometry
from toolkit.recipes.map_poses import map_matches, map_sfm, placed_queries, require_queries_and_map
from toolkit.recipes.map_train import map_training
from toolkit.recipes.measure import measure_poses
from toolkit.recipes.steps import SCENE, undistorted
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene
from toolkit.scene.scene import Split
from toolkit.settings import Choice, Group, Integer, Settings
from toolkit.splat.depth_settings import DepthLossSettings
from toolkit.splat.train_settings import TrainSettings

if TYPE_CHECKING:  # Whoever reads settings does without PyTorch.
    from toolkit.splat.gaussians import Gaussians
    from toolkit.splat.map_file import StoredMap


class MapSettings(Settings):
    """Settings of every stage from photos to a splat map."""

    features = Group(SiftSettings(), doc="Features of all photos")
    pairs = Group(
        PairSettings(method="spatial", neighbours=16),
        doc="Which map photos are matched with which; queries are matched with map photos only",
    )
    match = Group(MatchSettings(), doc="Matching and geometric verification")
    sfm = Group(SfmSettings(use_positions=True), doc="Structure from motion of the map photos, in metres")
    stereo = Group(StereoSettings(), doc="Depth maps of the map photos")
    fusion = Group(FusionSettings(), doc="From depth maps to the dense cloud")
    start = Choice(
        "sparse",
        choices=("sparse", "dense"),
        doc="What Gaussians are started from: the points of structure from motion, or the dense cloud.",
    )
    most_dense = Integer(
        80_000,
        bounds=(4, 50_000_000),
        unit="points",
        doc="Dense start: the cloud is thinned on a grid to at most so many.",
    )
    train = Group(TrainSettings(kind="2d"), doc="Gaussian splats, in units in which the scene fills -1 to 1")
    depth_loss = Group(
        DepthLossSettings(kind="absolute"), doc="How much their depth is held to stereo's, where weight is not 0"
    )


@dataclass(frozen=True, slots=True, eq=False)
class BuiltMap:
    """A map, and the photos that it is of and that are asked for in it.

    Attributes
    ----------
    stages:
        In order, with their times and reports.
    scene:
        Poses of the map photos by structure from motion, and of those queries that could be placed by its points,
        in metres where the capture has positions; cameras as the photos have them; sparse points.
    flat_scene:
        The same frames, where they have a pose, with pinhole cameras and undistorted photos.
    stored:
        The Gaussians in the scene's world, with their kind and how they were trained.
    metrics, reports:
        Flat measures; what each stage and measure has to say.
    """

    stages: tuple[CachedStage, ...]
    scene: Scene
    flat_scene: Scene
    stored: StoredMap
    metrics: dict[str, float | None]
    reports: dict[str, Any]

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians in the scene's world."""
        return self.stored.gaussians

    @property
    def trained(self) -> dict[str, Any]:
        """What the training reported."""
        report: dict[str, Any] = self.reports["train-map"]
        return report


def map_stages(
    data: RecipeInput,
    settings: MapSettings,
    context: RecipeContext,
    *,
    reliable: ReliabilitySettings | None = None,
) -> BuiltMap:
    """Build a map of the frames of the split ``train``, and place those of the split ``test`` in it.

    Features and matches, structure from motion of the map photos with their positions as priors, queries placed by
    its points, stereo and the dense cloud, training in normalised units, measures. Each stage is taken from the
    workspace where it is there. The map's files are written into the artifacts.

    Parameters
    ----------
    reliable:
        Which pixels of a render count as reliable where its depth is measured; the defaults where None.

    Raises
    ------
    StageError
        For a capture without map photos or queries, and as the stages do.
    """
    require_queries_and_map(data.scene)
    features, matches = map_matches(data, settings.features, settings.pairs, settings.match, context)
    mapped = map_sfm(data, matches, settings.sfm, context)
    queries = placed_queries(mapped, matches, settings.sfm, context)
    # Stereo knows the map's photos only; the training measures the queries, too.
    own, flat = undistorted(mapped, context), undistorted(queries, context)
    maps = stereo_stage(own, settings.stereo, context)
    fused = fusion_stage(maps, settings.fusion, context)
    trained = map_training(
        flat, maps, fused, settings.start, settings.most_dense, settings.train, settings.depth_loss, context
    )
    measured = map_geometry(
        data, flat, maps, fused, trained, settings.train.max_side, reliable or ReliabilitySettings(), context
    )
    _artifacts(trained, measured, fused, context)
    return _built(data, (features, matches, mapped, queries, flat, maps, fused, trained, measured))


def _artifacts(trained: CachedStage, measured: CachedStage, fused: CachedStage, context: RecipeContext) -> None:
    from toolkit.splat.map_file import MAP, SPLAT

    files = [(trained, SPLAT), (trained, MAP), (measured, GEOMETRY), (fused, FUSED)]
    with disk_errors(context.artifacts, "writing to"):
        context.artifacts.mkdir(parents=True, exist_ok=True)
        for stage, name in files:
            shutil.copyfile(stage.folder / name, context.artifacts / name)


def _built(data: RecipeInput, stages: tuple[CachedStage, ...]) -> BuiltMap:
    from toolkit.splat.map_file import read_map

    by_name = {stage.time.name: stage for stage in stages}
    reports = {name: stage.report for name, stage in by_name.items()}
    scene, flat = (read_scene(by_name[name].folder / SCENE) for name in ("queries", "undistort"))
    metrics = {**_map_metrics(reports), **geometry_metrics(reports["map-geometry"])}
    splits: tuple[Split, ...] = ("train", "test")
    for split in splits:
        own, true = (_of_split(which, split) for which in (scene, data.reference))
        assert own is not None
        poses, report = measure_poses(own, true, name=f"poses.{split}")
        metrics |= poses
        reports[f"poses.{split}"] = report
    return BuiltMap(stages, scene, flat, read_map(by_name["train-map"].folder), metrics, reports)


def _of_split(scene: Scene | None, split: Split) -> Scene | None:
    if scene is None:
        return None
    return scene.replace(frames=tuple(frame for frame in scene.frames if frame.split == split), points=None)


def _map_metrics(reports: dict[str, Any]) -> dict[str, float | None]:
    sfm, queries, train = (reports[name] for name in ("map-sfm", "queries", "train-map"))
    residuals = sfm["position_residuals"] or {}
    metrics: dict[str, float | None] = {
        "sfm.images": float(sfm["images"]),
        "sfm.registered": float(sfm["registered"]),
        "sfm.points": float(sfm["points"]),
        "sfm.reprojection_error_px": float(sfm["mean_reprojection_error"]),
        "sfm.position_residual": residuals.get("median"),
        "queries": float(queries["queries"]),
        "queries.placed": float(queries["placed"]),
        "fused.points": float(reports["fusion"]["points"]),
        "fused.per_sparse": float(train["points"]["dense_per_sparse"]),
        "splat.initial": float(train["initial_gaussians"]),
        "splat.gaussians": float(train["gaussians"]),
    }
    for row, name in zip(reversed(train["checkpoints"]), ("", ".early"), strict=False):
        metrics[f"test.psnr{name}"] = row["psnr_test"]
        metrics[f"training.psnr{name}"] = row["psnr_training"]
        metrics[f"splat.gaussians{name}"] = float(row["gaussians"])
        metrics[f"train.seconds{name}"] = row["seconds"]
    return metrics
