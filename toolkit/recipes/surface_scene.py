"""A scene with poses, points and pinhole cameras, for recipes that reconstruct its surface."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from toolkit import matching, poses
from toolkit.errors import StageError
from toolkit.matching.features import SiftSettings
from toolkit.matching.match import MatchSettings
from toolkit.matching.pairs import PairSettings
from toolkit.poses.sfm import SfmSettings
from toolkit.poses.slam.points import SlamPointSettings, slam_points
from toolkit.recipes.base import RecipeContext, RecipeInput
from toolkit.recipes.blades import faint_features, small_step_sfm
from toolkit.recipes.blades_stages import (
    LensSettings,
    MaskSettings,
    find_poses,
    masked_capture,
    match_frames,
    start_capture,
)
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.colmap_3dgs import structure_from_motion
from toolkit.recipes.steps import SCENE, undistorted
from toolkit.scene.folder import write_scene
from toolkit.settings import Choice, Group, Settings


class ColmapWaySettings(Settings):
    """Incremental structure from motion."""

    sift = Group(SiftSettings(), doc="Features")
    pairs = Group(PairSettings(), doc="Which photos are matched with which")
    match = Group(MatchSettings(), doc="Matching and geometric verification")
    sfm = Group(SfmSettings(), doc="Structure from motion")


class BladesWaySettings(Settings):
    """Neighbouring frames of a video around an axis."""

    lens = Group(LensSettings(), doc="What is known of the lens")
    features = Group(faint_features(), doc="Features")
    pairs = Group(PairSettings(method="sequential", overlap=15, quadratic=False), doc="Which frames are matched")
    sfm = Group(small_step_sfm(), doc="Structure from motion")


class SurfaceSceneSettings(Settings):
    """Where the poses and points come from, under which a surface is reconstructed."""

    way = Choice(
        "colmap",
        choices=("colmap", "blades", "given"),
        doc="colmap: incremental structure from motion; blades: the same for neighbouring frames around an axis; "
        "given: the capture's own poses (true, surveyed or of a model in its folder), which stay as they are.",
    )
    masks = Group(MaskSettings(find=False), doc="What does not move with the scene")
    colmap = Group(ColmapWaySettings(), doc="For way=colmap")
    blades = Group(BladesWaySettings(), doc="For way=blades")
    points = Group(
        SlamPointSettings().replace({"pairs.method": "exhaustive", "sift.max_features": 4096}),
        doc="Triangulation under the given poses, where the capture has poses and no points",
    )


def surface_scene(
    data: RecipeInput,
    settings: SurfaceSceneSettings,
    context: RecipeContext,
    *,
    flat: bool = True,
    tracks: bool = False,
) -> tuple[CachedStage, ...]:
    """Return the stages up to a scene with poses, points and pinhole cameras, which the last one has in ``SCENE``.

    Parameters
    ----------
    data, settings, context:
        As every recipe has them.
    flat:
        False leaves the pictures and their cameras as they are.
    tracks:
        Points are triangulated under given poses also where there are some, but not which frames saw them.

    Raises
    ------
    StageError
        For ``way=given`` where the capture has no poses.
    """
    data, masks = masked_capture(data, settings.masks, context)
    stages: tuple[CachedStage, ...]
    if settings.way == "colmap":
        stages = structure_from_motion(data, settings.colmap, context)
    elif settings.way == "blades":
        blades = settings.blades
        matched = match_frames(start_capture(data, blades.lens), blades.features, blades.pairs, None, context)
        stages = (
            *matched.stages,
            find_poses(matched, blades.lens, blades.sfm, blades.features, blades.pairs, context),
        )
    else:
        stages = (_given(data, settings.points, context, tracks),)
    return (*masks, *stages, *((undistorted(stages[-1], context),) if flat else ()))


def _given(data: RecipeInput, settings: SlamPointSettings, context: RecipeContext, tracks: bool) -> CachedStage:
    reference = data.reference
    if reference is None or not reference.registered:
        raise StageError(
            "The capture has no poses of its own",
            expected="true or surveyed poses, or a model in its folder, for way=given",
            found="none",
            todo="Set scene.way=colmap",
        )
    scene = reference.replace(mask_dir=data.scene.mask_dir or reference.mask_dir)

    def given_into(folder: Path) -> dict[str, Any]:
        found = scene
        if scene.points is None or len(scene.points) == 0 or (tracks and scene.points.tracks is None):
            found = slam_points(
                scene, settings, seed=context.seed, progress=context.progress, work_dir=folder / "work"
            )
        write_scene(found, folder / SCENE)
        assert found.points is not None
        return {"images": len(found.registered), "points": len(found.points)}

    return cached_stage(
        context,
        "given",
        inputs={
            "capture": data.fingerprint,
            "poses": [_pose(frame) for frame in scene.frames],
            # Points that are triangulated anyway have tracks.
            "tracks": tracks and scene.points is not None,
        },
        settings=settings,
        code=(matching, poses),
        build=given_into,
    )


def _pose(frame: Any) -> list[list[float]] | None:
    pose = frame.cam_from_world
    return None if pose is None else pose.matrix.tolist()
