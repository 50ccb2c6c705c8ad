"""Poses and points of a map from its own photos, and the poses of query photos in it.

The split tells them apart: ``train`` are photos of the map, ``test`` are queries. Queries have no part in the map:
neither in its points, nor in its poses, nor in its cameras.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit import matching, poses
from toolkit.errors import StageError
from toolkit.matching.database import copy_database
from toolkit.matching.features import SiftSettings
from toolkit.matching.match import MatchSettings
from toolkit.matching.pairs import ChosenPairs, PairSettings, choose_pairs
from toolkit.poses.resection import place_by_tracks
from toolkit.poses.sfm import SfmSettings, incremental_sfm
from toolkit.recipes.base import RecipeContext, RecipeInput
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.steps import DATABASE, SCENE, features_and_matches
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene, write_scene

Array = NDArray[np.float64]


def map_pairs(scene: Scene, settings: PairSettings) -> ChosenPairs:
    """Return the pairs of map photos that the settings choose, and of each query with map photos.

    A query is matched with as many of the nearest map photos, by position or by order of capture, as a map photo is
    by the same method; never with another query.

    Raises
    ------
    StageError
        As :func:`toolkit.matching.pairs.choose_pairs`, for the map photos.
    """
    roles = np.array([frame.split for frame in scene.frames])
    mine, queries = np.flatnonzero(roles == "train"), np.flatnonzero(roles == "test")
    chosen = choose_pairs(scene.replace(frames=tuple(scene.frames[i] for i in mine), points=None), settings)
    index = [mine[chosen.index]]
    for query in queries:
        partners = _partners(scene, int(query), mine, settings)
        index.append(np.stack([np.full(len(partners), query), partners], axis=1))
    pairs = np.unique(np.sort(np.concatenate(index), axis=1), axis=0)
    return ChosenPairs(settings.method, len(scene), pairs)


def _partners(scene: Scene, query: int, mine: NDArray[np.int64], settings: PairSettings) -> NDArray[np.int64]:
    """Return the map photos that a query is matched with."""
    if settings.method == "exhaustive":
        return mine
    if settings.method == "sequential":
        order = np.argsort(np.abs(mine - query), kind="stable")
        return mine[order[: 2 * settings.overlap]]
    place = _position(scene, query)
    places = [_position(scene, int(i)) for i in mine]
    if place is None or any(other is None for other in places):
        return mine
    apart = np.linalg.norm(np.array(places) - place, axis=1)
    order = np.argsort(apart, kind="stable")[: settings.neighbours]
    if settings.max_distance > 0:
        order = order[apart[order] <= settings.max_distance]
    return mine[order]


def _position(scene: Scene, index: int) -> Array | None:
    prior = scene.frames[index].prior
    return None if prior is None else prior.position


def map_matches(
    data: RecipeInput,
    features: SiftSettings,
    pairs: PairSettings,
    match: MatchSettings,
    context: RecipeContext,
) -> tuple[CachedStage, CachedStage]:
    """Return the stages features, of all photos, and matches, of the pairs of :func:`map_pairs`."""
    split = {"split": _split(data.scene)}
    return features_and_matches(data, features, pairs, match, context, choose=map_pairs, chosen_by=split)


def map_sfm(data: RecipeInput, matches: CachedStage, settings: SfmSettings, context: RecipeContext) -> CachedStage:
    """Return the stage sfm of the map photos alone; its scene, queries without pose, is in ``SCENE``."""
    scene = data.scene
    names = [frame.name for frame in scene.frames if frame.split == "train"]

    def poses_into(folder: Path) -> dict[str, Any]:
        found = incremental_sfm(
            scene,
            matches.folder / DATABASE,
            settings,
            seed=context.seed,
            progress=context.progress,
            work_dir=folder / "work",
            only=names,
        )
        write_scene(found.scene, folder / SCENE)
        return {**found.to_dict(), "position_residuals": position_residuals(found.scene)}

    return cached_stage(
        context,
        "map-sfm",
        inputs={"matches": matches.output.key, "split": _split(scene)},
        settings=settings,
        code=(matching, poses),
        build=poses_into,
    )


def placed_queries(
    mapped: CachedStage, matches: CachedStage, settings: SfmSettings, context: RecipeContext
) -> CachedStage:
    """Return the stage queries: the map's scene with the query photos placed by its points, in ``SCENE``.

    Inliers miss their keypoint by at most ``max_error`` and are at least ``min_inliers``, as when the map's photos
    were placed.
    """
    scene = read_scene(mapped.folder / SCENE)
    queries = [frame.name for frame in scene.frames if frame.split == "test"]

    def queries_into(folder: Path) -> dict[str, Any]:
        copy = folder / DATABASE
        copy_database(matches.folder / DATABASE, copy)
        found = place_by_tracks(
            scene,
            copy,
            only=queries,
            max_error=settings.max_error,
            least=settings.min_inliers,
            seed=context.seed,
        )
        copy.unlink()
        write_scene(found.scene, folder / SCENE)
        return {"queries": len(queries), "placed": len(found.placed), "reasons": dict(found.reasons)}

    return cached_stage(
        context,
        "queries",
        inputs={"map": mapped.output.key, "matches": matches.output.key},
        settings=settings,
        code=(poses,),
        build=queries_into,
    )


def position_residuals(scene: Scene) -> dict[str, float] | None:
    """Return how far the poses of the map photos are from their measured positions, in metres; None for none.

    Returns
    -------
    ``median``, ``rms``, ``max`` of the distances, ``median_horizontal`` and ``median_vertical``, and ``frames``.
    """
    if scene.georeference is None:
        return None
    apart = [
        frame.cam_from_world.centre - frame.prior.position
        for frame in scene.of_split("train")
        if frame.cam_from_world is not None and frame.prior is not None and frame.prior.position is not None
    ]
    if not apart:
        return None
    moved = np.array(apart)
    lengths = np.linalg.norm(moved, axis=1)
    return {
        "frames": float(len(moved)),
        "median": float(np.median(lengths)),
        "rms": float(np.sqrt(np.mean(lengths**2))),
        "max": float(lengths.max()),
        "median_horizontal": float(np.median(np.linalg.norm(moved[:, :2], axis=1))),
        "median_vertical": float(np.median(np.abs(moved[:, 2]))),
    }


def require_queries_and_map(scene: Scene) -> None:
    """Raise :class:`StageError` for a scene without photos of the map, or without queries."""
    count = {split: sum(frame.split == split for frame in scene.frames) for split in ("train", "test")}
    if min(count.values()) == 0 or count["train"] < 2:
        raise StageError(
            "A map and its queries need photos of both kinds",
            expected="at least 2 frames of the split 'train' and 1 of 'test'",
            found=f"{count['train']} and {count['test']}",
            todo="Tell in scene.json which frames are of the map",
        )


def _split(scene: Scene) -> list[str]:
    return [frame.split for frame in scene.frames]
