"""Training a map in normalised units, and what is told of it at the paper's two checkpoints."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from toolkit import splat
from toolkit.depth.dense_folder import open_depth_views
from toolkit.depth.thin_cloud import thin_cloud
from toolkit.files import disk_errors, read_json, write_json
from toolkit.geometry.surface import Cloud
from toolkit.metrics.image import psnr
from toolkit.recipes.base import RecipeContext
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.dense_steps import DENSE, FUSED
from toolkit.recipes.live_view import LIVE, LiveView
from toolkit.recipes.steps import SCENE
from toolkit.scene import Points, Scene
from toolkit.scene.folder import read_scene
from toolkit.scene.mesh_files import read_cloud
from toolkit.scene.normalise import normalised
from toolkit.splat.depth_settings import DepthLossSettings
from toolkit.splat.train_settings import TrainSettings

if TYPE_CHECKING:  # Whoever reads settings does without PyTorch.
    from collections.abc import Iterable

    from toolkit.splat.depth_loss import PredictedDepth
    from toolkit.splat.evaluate import RenderedView
    from toolkit.splat.trainer import Trainer

#: The paper's first checkpoint, 7,000 of 30,000 steps, as a share of the run.
EARLY = 7000 / 30_000
#: In the stage's folder: where each Gaussian began, in world units, as tensor ``origins``.
ORIGINS = "origins.safetensors"
_EARLY_FILE = "early.json"


def map_training(
    flat: CachedStage,
    maps: CachedStage,
    fused: CachedStage,
    start: str,
    most_dense: int,
    settings: TrainSettings,
    held: DepthLossSettings,
    context: RecipeContext,
) -> CachedStage:
    """Return the stage train-map: the map's files (:mod:`toolkit.splat.map_file`) in world units, and ``ORIGINS``.

    Parameters
    ----------
    flat:
        Has the undistorted scene with all poses in ``SCENE``. Test frames are measured, never trained on.
    maps, fused:
        Have stereo's depth maps of the map photos and the dense cloud.
    start:
        ``"sparse"``: from the scene's points; ``"dense"``: from the cloud, thinned to at most ``most_dense``.
    held:
        How much the drawn depth is held to stereo's; with weight 0 not at all.
    """

    def trained_into(folder: Path) -> dict[str, Any]:
        scene, cloud = read_scene(flat.folder / SCENE), read_cloud(fused.folder / FUSED)
        begin, points = start_points(scene, cloud, start, most_dense)
        dense = maps.folder / DENSE if held.weight > 0 else None
        return _train(scene.replace(points=begin), points, settings, (dense, held), context, folder)

    return cached_stage(
        context,
        "train-map",
        inputs={
            "scene": flat.output.key,
            "cloud": fused.output.key,
            "start": start,
            "most_dense": most_dense if start == "dense" else None,
            "device": context.device,
            "held": {"maps": maps.output.key, **held.to_dict()} if held.weight > 0 else None,
        },
        settings=settings,
        code=(splat,),
        build=trained_into,
    )


def start_points(scene: Scene, cloud: Cloud, start: str, most: int) -> tuple[Points | None, dict[str, float]]:
    """Return the points that Gaussians start from, and how many there are of each kind.

    Returns
    -------
    points, counts:
        ``sparse`` and ``dense`` points, ``dense_per_sparse``, how many times more; for a dense start also
        ``thinned``, what is left of them, and the ``voxel`` of the thinning in scene units.
    """
    sparse = 0 if scene.points is None else len(scene.points)
    counts = {"sparse": float(sparse), "dense": float(len(cloud)), "dense_per_sparse": len(cloud) / max(sparse, 1)}
    if start == "sparse":
        return scene.points, counts
    thin = thin_cloud(cloud, most)
    rgb = np.full((len(thin.cloud), 3), 128, np.uint8) if thin.cloud.rgb is None else thin.cloud.rgb
    return Points(thin.cloud.xyz, rgb), {**counts, "thinned": float(len(thin.cloud)), "voxel": thin.voxel}


def stereo_depth_of(scene: Scene, dense: Path, scale: float, settings: DepthLossSettings) -> PredictedDepth:
    """Return stereo's depth of the map photos as the training is held to it, divided by ``scale``.

    Parameters
    ----------
    dense:
        COLMAP's dense folder with the maps.
    scale:
        Scene units in one unit of the training.
    """
    from toolkit.splat.depth_loss import PredictedDepth

    values = {}
    known = {frame.name for frame in scene.of_split("train")}
    for view in open_depth_views(dense):
        if view.name in known:
            depth = view.depth.astype(np.float32) / np.float32(scale)
            values[view.name] = np.where(view.depth > 0, depth, np.float32(np.nan))
    return PredictedDepth(values, "depth", settings)


def _train(
    scene: Scene,
    points: dict[str, float],
    settings: TrainSettings,
    held: tuple[Path | None, DepthLossSettings],
    context: RecipeContext,
    folder: Path,
) -> dict[str, Any]:
    import torch
    from safetensors.torch import save_file

    from toolkit.splat.evaluate import render_test_views, render_training_views
    from toolkit.splat.map_file import StoredMap, write_map
    from toolkit.splat.similar import scaled
    from toolkit.splat.train import train_splats

    unit = normalised(scene)
    watch = _EarlyLook(unit.scene, settings, context)
    dense, how = held
    scale = unit.world_from_normalised.scale
    trained = train_splats(
        unit.scene,
        settings,
        seed=context.seed,
        device=context.device,
        progress=context.progress,
        checkpoint_dir=context.checkpoint,
        observer=watch,
        predicted_depth=None if dense is None else stereo_depth_of(scene, dense, scale, how),
    )
    world = unit.world_from_normalised
    counts = {**points, "initial": float(trained.initial_gaussians), "gaussians": float(len(trained.gaussians))}
    gaussians = scaled(trained.gaussians, world).to(device="cpu")
    write_map(StoredMap(gaussians, settings.kind, world, scene.georeference, settings.to_dict(), counts), folder)
    origins = torch.from_numpy(world.apply(trained.origins.cpu().numpy()).astype(np.float32))
    with disk_errors(folder / ORIGINS, "writing"):
        save_file({"origins": origins}, folder / ORIGINS)
    late = _look(
        trained.steps,
        len(trained.gaussians),
        render_test_views(trained.gaussians, unit.scene, settings, device=context.device),
        render_training_views(trained.gaussians, unit.scene, settings, trained.exposures, device=context.device),
        training_seconds(trained.seconds),
    )
    return {**trained.to_dict(), "points": counts, "checkpoints": [*watch.seen(), late]}


def training_seconds(seconds: Mapping[str, float]) -> float:
    """Return the wall time of training alone: kernels are compiled once a machine, and looking on is for people."""
    return sum(value for part, value in seconds.items() if part not in ("compile", "observer"))


class _EarlyLook:
    """Watches a training: its live view, and PSNR and number of Gaussians at the paper's first checkpoint.

    What was seen then is kept beside the run's checkpoints, for a run that is resumed later does not pass there.
    """

    def __init__(self, scene: Scene, settings: TrainSettings, context: RecipeContext) -> None:
        self._scene, self._settings, self._device = scene, settings, context.device
        self._live = LiveView(context.artifacts / LIVE, scene)
        self._at, self._path = max(1, round(EARLY * settings.steps)), context.checkpoint / _EARLY_FILE

    def __call__(self, training: Trainer) -> dict[str, float]:
        values = self._live(training)
        state = training.state
        if state.step == self._at:
            from toolkit.splat.evaluate import render_test_views, render_training_views

            gaussians = state.optimiser.gaussians.detach()
            exposures = {} if state.exposure is None else _by_name(training.photos.names, state.exposure.affine)
            row = _look(
                state.step,
                len(gaussians),
                render_test_views(gaussians, self._scene, self._settings, device=self._device),
                render_training_views(gaussians, self._scene, self._settings, exposures, device=self._device),
                training_seconds(state.seconds),
            )
            with disk_errors(self._path, "writing"):
                self._path.parent.mkdir(parents=True, exist_ok=True)
            write_json(self._path, row)
        return dict(values)

    def seen(self) -> list[dict[str, Any]]:
        """Return what was seen at the first checkpoint, nothing where the run is shorter."""
        row = read_json(self._path) if self._path.is_file() else None
        return [row] if isinstance(row, dict) and row.get("step") == self._at < self._settings.steps else []


def _by_name(names: Any, affine: Any) -> dict[str, list[list[float]]]:
    return {name: rows.tolist() for name, rows in zip(names, affine.detach().cpu(), strict=True)}


def _look(
    step: int,
    gaussians: int,
    test: Iterable[RenderedView],
    training: Iterable[RenderedView],
    seconds: float,
) -> dict[str, Any]:
    """Return a checkpoint's row: mean PSNR of queries, held out, and of the map's own photos, in dB."""
    begun = time.perf_counter()
    row = {
        "step": step,
        "gaussians": gaussians,
        "psnr_test": _mean_psnr(test),
        "psnr_training": _mean_psnr(training),
        "seconds": seconds,
    }
    return {**row, "looking_seconds": time.perf_counter() - begun}


def _mean_psnr(views: Iterable[RenderedView]) -> float | None:
    ratios = [psnr(v.photo, v.render, None if v.weights is None else v.weights > 0) for v in views]
    return float(np.mean(ratios)) if ratios else None
