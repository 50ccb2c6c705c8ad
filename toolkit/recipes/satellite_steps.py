"""Stages that recipes for satellite pictures share: pictures, tie points, cameras that agree, heights."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit import depth, geometry, poses
from toolkit import scene as scenes
from toolkit.depth.height_map import GroundView, HeightMap, match_heights
from toolkit.depth.height_settings import HeightSettings
from toolkit.errors import StageError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.ground_grid import GroundGrid
from toolkit.geometry.rpc_settings import RpcRefinementSettings
from toolkit.matching.features import SiftSettings
from toolkit.matching.match import MatchSettings
from toolkit.matching.match_tracks import match_tracks
from toolkit.matching.pairs import PairSettings
from toolkit.poses.satellite import ground_box, pictures_to_match, refine_satellite, with_affine_cameras
from toolkit.recipes.base import RecipeContext, RecipeInput
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.steps import DATABASE, SCENE, features_and_matches
from toolkit.scene import Frame, Points, Scene
from toolkit.scene.folder import read_scene, write_scene
from toolkit.scene.pictures import load_grey, load_mask, load_picture
from toolkit.settings import Group, Number, Settings

HEIGHTS = "heights.npz"


class SatelliteSettings(Settings):
    """From satellite pictures with RPCs to cameras that agree with each other."""

    sift = Group(SiftSettings(max_features=8192), doc="Features of the tie points")
    pairs = Group(PairSettings(method="exhaustive"), doc="Which pictures are matched with which")
    match = Group(MatchSettings(), doc="Matching and geometric verification")
    refine = Group(RpcRefinementSettings(), doc="Corrections of the RPCs")
    margin = Number(
        15.0, bounds=(0.0, 1000.0), unit="m", doc="Heights go so far below and above those of the tie points."
    )


@dataclass(frozen=True, slots=True)
class SatelliteStages:
    """What all recipes begin with.

    Attributes
    ----------
    stages:
        In order.
    refined:
        With RPC cameras that agree and the tie points, in ``SCENE``.
    local:
        With affine cameras, pictures of eight bits and the tie points, in ``SCENE``.
    box:
        (2, 3) lower and upper corner of the ground that most views see, metres in the scene's world.
    """

    stages: tuple[CachedStage, ...]
    refined: CachedStage
    local: CachedStage
    box: NDArray[np.float64]

    def metrics(self) -> dict[str, float | None]:
        """Return how many views there are, and how well their cameras agree and are fitted."""
        return {
            "sfm.images": float(self.refined.report["images"]),
            "sfm.registered": float(self.refined.report["images"]),
            "rpc.rms_before_px": self.refined.report["rms_before_px"],
            "rpc.rms_px": self.refined.report["rms_px"],
            "affine.rms_px": self.local.report["worst_rms_px"],
        }


def satellite_stages(data: RecipeInput, settings: SatelliteSettings, context: RecipeContext) -> SatelliteStages:
    """Return the stages up to affine cameras that agree on the tie points.

    Test pictures have their cameras corrected, too: without, no render could be compared with them. So tie points
    lie in them, and the range of heights is that of all tie points; heights and splats are made of the others.

    Raises
    ------
    StageError
        Where a picture has no RPC, or pictures do not match.
    """
    pictures = pictures_stage(data, context)
    flat = read_scene(pictures.folder / SCENE)
    features, matches = features_and_matches(
        RecipeInput(flat, None, data.fingerprint), settings.sift, settings.pairs, settings.match, context
    )

    def refined_into(folder: Path) -> dict[str, Any]:
        found = refine_satellite(data.scene, match_tracks(matches.folder / DATABASE, flat), settings.refine)
        assert found.scene.points is not None
        points = dataclasses.replace(found.scene.points, rgb=_colours(found.scene.points, flat))
        write_scene(found.scene.replace(points=points), folder / SCENE)
        return {"images": len(found.scene), **found.to_dict()}

    refined = cached_stage(
        context,
        "refine",
        inputs={"matches": matches.output.key},
        settings=settings.refine,
        code=(geometry, poses, scenes),
        build=refined_into,
    )
    box = ground_box(read_scene(refined.folder / SCENE), margin=settings.margin)

    def local_into(folder: Path) -> dict[str, Any]:
        scene, fitted = with_affine_cameras(read_scene(refined.folder / SCENE), box, flat)
        write_scene(scene, folder / SCENE)
        each = {f.name: local.to_dict() for f, local in zip(scene.frames, fitted, strict=True)}
        worst = max(local.rms_px for local in fitted)
        return {"images": len(scene), "box": box.tolist(), "worst_rms_px": worst, "cameras": each}

    local = cached_stage(
        context,
        "affine",
        inputs={"refine": refined.output.key, "pictures": pictures.output.key, "box": box.tolist()},
        settings=None,
        code=(geometry, poses, scenes),
        build=local_into,
    )
    return SatelliteStages((pictures, features, matches, refined, local), refined, local, box)


def pictures_stage(data: RecipeInput, context: RecipeContext) -> CachedStage:
    """Return the stage pictures: satellite pictures as a scene of eight bits, in ``SCENE``."""

    def pictures_into(folder: Path) -> dict[str, Any]:
        # Below the scene, so that it stays whole when the stage is renamed.
        scene = pictures_to_match(data.scene, folder / SCENE, progress=context.progress)
        write_scene(scene, folder / SCENE)
        return {"images": len(scene)}

    return cached_stage(
        context,
        "pictures",
        inputs={"capture": data.fingerprint},
        settings=None,
        code=(poses, scenes),
        build=pictures_into,
    )


def _colours(points: Points, pictures: Scene) -> NDArray[np.uint8]:
    """Return the colour (P, 3) of each point in the first picture that saw it."""
    tracks = points.tracks
    assert tracks is not None
    _, first = np.unique(tracks.point, return_index=True)
    colours = np.zeros((len(points), 3), np.uint8)
    for number in np.unique(tracks.frame[first]):
        picture = load_picture(pictures.image_path(pictures.frames[number]))
        rows = first[tracks.frame[first] == number]
        x, y = np.clip(tracks.pixel[rows].astype(int), 0, np.array(picture.shape[1::-1]) - 1).T
        colours[tracks.point[rows]] = picture[y, x]
    return colours


def ground_views(scene: Scene, frames: Iterable[Frame]) -> list[GroundView]:
    """Return frames with affine cameras as the matching of heights takes them; what is masked is NaN."""
    views = []
    for frame in frames:
        camera, mask = scene.camera_of(frame), load_mask(scene, frame)
        assert isinstance(camera, AffineCamera)
        assert frame.cam_from_world is not None
        grey = (load_grey(scene.image_path(frame)) / 255).astype(np.float32)
        if mask is not None:
            grey[~mask] = np.nan
        views.append(GroundView(grey, camera, frame.cam_from_world))
    return views


def heights_stage(found: SatelliteStages, settings: HeightSettings, context: RecipeContext) -> CachedStage:
    """Return the stage heights: those matched over the ground in the training pictures, in ``HEIGHTS``."""

    def heights_into(folder: Path) -> dict[str, Any]:
        scene = read_scene(found.local.folder / SCENE)
        views = ground_views(scene, scene.of_split("train"))
        grid = GroundGrid.over(found.box, settings.resolution)
        lowest, highest = float(found.box[0, 2]), float(found.box[1, 2])
        made = match_heights(views, grid, (lowest, highest), settings, seed=context.seed, progress=context.progress)
        np.savez_compressed(folder / HEIGHTS, heights=made.heights, confidence=made.confidence, filled=made.filled)
        return made.to_dict()

    return cached_stage(
        context,
        "heights",
        inputs={"affine": found.local.output.key},
        settings=settings,
        code=(depth, geometry),
        build=heights_into,
    )


def read_heights(stage: CachedStage, box: NDArray[np.float64]) -> HeightMap:
    """Return the heights that :func:`heights_stage` left.

    Raises
    ------
    StageError
        Where the file does not fit to the stage's report.
    """
    report = stage.report
    grid = GroundGrid.over(box, float(report["resolution"]))
    with np.load(stage.folder / HEIGHTS, allow_pickle=False) as file:
        heights, confidence, filled = file["heights"], file["confidence"], file["filled"]
    if heights.shape != (grid.rows, grid.columns):
        raise StageError(
            "Heights do not fit their grid", expected=str((grid.rows, grid.columns)), found=str(heights.shape)
        )
    return HeightMap(grid, heights, confidence, filled, int(report["views"]))
