"""Stages of the recipes for blades: lens, features and pairs, poses, the closed circle, and their measures."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from toolkit import capture, matching, poses
from toolkit.capture.static_mask import StaticMaskSettings
from toolkit.capture.still_structure import mask_what_stands_still
from toolkit.capture.temporal import TemporalSettings
from toolkit.errors import StageError
from toolkit.matching.feature_choice import FeatureSettings, extract_features, match_features
from toolkit.matching.pairs import PairSettings, choose_pairs
from toolkit.matching.wrong_pairs import WrongPairSettings, drop_pairs, find_wrong_pairs
from toolkit.poses.arc_sigma import arc_sigma
from toolkit.poses.camera_models import MODELS
from toolkit.poses.camera_start import counted_as_measured, plain_cameras, with_cameras
from toolkit.poses.circular import close_circle
from toolkit.poses.circular_selection import circle_tracks
from toolkit.poses.circular_settings import CircularSettings
from toolkit.poses.sfm import SfmSettings, incremental_sfm
from toolkit.poses.triangulation import triangulate, triangulation_options
from toolkit.poses.two_step import MATCHES, PassResult, one_step, two_step
from toolkit.recipes.base import RecipeContext, RecipeInput
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.steps import DATABASE, SCENE, features_and_matches
from toolkit.scene import Scene, scene_from_pycolmap
from toolkit.scene.colmap import colmap_camera
from toolkit.scene.folder import read_scene, write_scene
from toolkit.settings import Boolean, Choice, Group, Number, Settings

# How far a ray may miss a point under the poses of a circle.
_RAY_DEGREES = 1.0


class LensSettings(Settings):
    """What is known of the lens, and how its distortion is found."""

    way = Choice(
        "one-step",
        choices=("one-step", "two-step", "known"),
        doc="one-step: the model is part of the reconstruction; two-step: it is found first, the pictures are "
        "undistorted, and all begins again with a fixed PINHOLE; known: the capture's own cameras are kept.",
    )
    model = Choice("OPENCV_FISHEYE", choices=MODELS, doc="Camera model that is to be found, starting undistorted.")
    simple_first = Boolean(
        True,
        doc="A model of more than two coefficients gets its poses from one of two, and is refined from there; no: "
        "it is in the mapper from the beginning, as COLMAP does it, which may lose it.",
    )
    start_focal = Number(
        0.0,
        bounds=(0.0, 10.0),
        unit="widths",
        doc="Focal length to start from, in widths of the picture, with the principal point in its middle; 0: what "
        "the capture's cameras say.",
    )


class MaskSettings(Settings):
    """Icons and structure that do not turn with the blades, found in the frames themselves."""

    find = Boolean(True, doc="Find and leave out what does not move, where the capture has no masks of its own.")
    temporal = Group(TemporalSettings(), doc="Statistics over time that tell it")
    static = Group(StaticMaskSettings(), doc="How it is told from what moves")


@dataclass(frozen=True, slots=True)
class Matched:
    """Features and verified matches: the stages, the last of which has ``DATABASE``, and their capture."""

    data: RecipeInput
    stages: tuple[CachedStage, ...]

    @property
    def database(self) -> Path:
        """COLMAP's database with the matches that are left."""
        return self.stages[-1].folder / DATABASE


def masked_capture(
    data: RecipeInput, settings: MaskSettings, context: RecipeContext
) -> tuple[RecipeInput, tuple[CachedStage, ...]]:
    """Return the capture with a mask of what does not move, and its stage. Masks that are there stay."""
    scene = data.scene
    if scene.mask_dir is not None or not settings.find:
        return data, ()

    def masks_into(folder: Path) -> dict[str, Any]:
        _, found = mask_what_stands_still(
            scene,
            folder / "masks",
            settings.temporal,
            settings.static,
            seed=context.seed,
            progress=context.progress,
        )
        return found.to_dict()

    made = cached_stage(
        context,
        "masks",
        inputs={"capture": data.fingerprint},
        settings=settings,
        code=(capture,),
        build=masks_into,
    )
    masks = made.folder / "masks"
    if not masks.is_dir():  # nothing stands still
        return data, (made,)
    masked = scene.replace(mask_dir=masks)
    return dataclasses.replace(data, scene=masked, fingerprint=f"{data.fingerprint}-{made.output.key}"), (made,)


def start_capture(data: RecipeInput, lens: LensSettings) -> RecipeInput:
    """Return the capture as it is matched: with its own cameras where they are known, else with plain ones."""
    if lens.way == "known":
        return data
    scene = data.scene
    width = max(camera.width for camera in scene.cameras.values())
    bare = plain_cameras(scene, "SIMPLE_RADIAL", lens.start_focal * width)
    told = f"{data.fingerprint}-unknown-{lens.start_focal:g}"
    return dataclasses.replace(data, scene=with_cameras(scene, counted_as_measured(bare, False)), fingerprint=told)


def match_frames(
    data: RecipeInput,
    features: FeatureSettings,
    pairs: PairSettings,
    wrong: WrongPairSettings | None,
    context: RecipeContext,
) -> Matched:
    """Return features and matches, without pairs that contradict the sequence where ``wrong`` says how to tell."""
    stages = features_and_matches(data, features, pairs, None, context)
    if wrong is None:
        return Matched(data, stages)
    matches = stages[-1]

    def dropped_into(folder: Path) -> dict[str, Any]:
        database = matches.folder / DATABASE
        found = find_wrong_pairs(database, data.scene, wrong, seed=context.seed, progress=context.progress)
        dropped = drop_pairs(database, found.wrong, folder / DATABASE)
        return {**found.to_dict(), "dropped": dropped}

    checked = cached_stage(
        context,
        "pairs",
        inputs={"matches": matches.output.key},
        settings=wrong,
        code=(matching,),
        build=dropped_into,
    )
    return Matched(data, (*stages, checked))


def find_poses(
    matched: Matched,
    lens: LensSettings,
    sfm: SfmSettings,
    features: FeatureSettings,
    pairs: PairSettings,
    context: RecipeContext,
) -> CachedStage:
    """Return the stage sfm, with the poses in ``SCENE``, by one or two steps or with the lens as it is known."""
    scene = matched.data.scene
    if lens.way != "known":
        # It is refined all the same. Frames a small turn apart do not tell it, and the mapper would not begin.
        started = {number: colmap_camera(scene, number) for number in scene.cameras}
        scene = with_cameras(scene, counted_as_measured(started, True))
    two = lens.way == "two-step"
    fixed = {"refine_focal": False, "refine_distortion": False, "refine_principal_point": False}
    settings = sfm.replace(fixed) if lens.way == "known" else sfm

    def rematch(flat: Scene, database: Path) -> None:
        chosen = choose_pairs(flat, pairs)
        seed, progress, device = context.seed, context.progress, context.device
        extract_features(flat, database, features.chosen_features, seed=seed, progress=progress, device=device)
        match_features(
            database, flat, chosen, features.chosen_matching, seed=seed, progress=progress, device=device
        )

    def poses_into(folder: Path) -> dict[str, Any]:
        seed, progress, work = context.seed, context.progress, folder / "work"
        if lens.way == "known":
            found = incremental_sfm(scene, matched.database, settings, seed=seed, progress=progress, work_dir=work)
            write_scene(found.scene, folder / SCENE)
            return {**found.to_dict(), "arc": _known_arc(found.scene)}
        if lens.way == "one-step":
            one = one_step(
                scene,
                matched.database,
                lens.model,
                sfm,
                simple_first=lens.simple_first,
                seed=seed,
                progress=progress,
                work_dir=work,
            )
            write_scene(one.scene, folder / SCENE)
            return {**one.sfm.to_dict(), "arc": _arc(one, None if one.arc is None else one.arc.sigma)}
        both = two_step(
            scene,
            matched.database,
            lens.model,
            sfm,
            rematch=rematch,
            # The scene's own folder, so that it finds its pictures when the stage's folder is renamed.
            folder=folder / SCENE,
            simple_first=lens.simple_first,
            seed=seed,
            progress=progress,
            work_dir=work,
        )
        if both.two_step is None:
            raise StageError("The undistorted pictures give no poses", found=both.failure)
        write_scene(both.two_step.scene, folder / SCENE)
        return {
            **both.two_step.sfm.to_dict(),
            "arc": _arc(both.two_step, both.sigma),
            "first_pass": both.one_step.to_dict(),
            "two_step": dict(both.seconds),
        }

    return cached_stage(
        context,
        "sfm",
        inputs={
            "matches": matched.stages[-1].output.key,
            "lens": lens.to_dict(),
            **({"features": features.to_dict(), "pairs": pairs.to_dict()} if two else {}),
        },
        settings=settings,
        code=(matching, poses),
        build=poses_into,
    )


def _known_arc(scene: Scene) -> dict[str, Any]:
    try:
        sigma = arc_sigma(scene, refine_focal=False, refine_distortion=False).sigma_fixed
    except StageError as error:
        return {"sigma": None, "reason": str(error)}
    return {"sigma": sigma, "reason": ""}


def _arc(found: PassResult, sigma: float | None) -> dict[str, Any]:
    return {"sigma": sigma, "reason": found.arc_failure}


def on_a_circle(
    matched: Matched, posed: CachedStage, settings: CircularSettings, context: RecipeContext
) -> CachedStage:
    """Return the stage circle: tracks joined across the seam where matches are, and all cameras on one circle."""

    def circle_into(folder: Path) -> dict[str, Any]:
        scene = read_scene(posed.folder / SCENE)
        # Of undistorted pictures those that were made from them.
        again = posed.folder / SCENE / MATCHES
        database = again if again.is_file() else matched.database
        chosen = circle_tracks(scene, database, settings)
        closed = close_circle(chosen.scene, settings, seed=context.seed, progress=context.progress)
        # Few observations close the circle; under its poses all of them give points.
        options = triangulation_options(
            degrees=_RAY_DEGREES, pixels=settings.max_error, min_angle=settings.min_angle, seed=context.seed
        )
        model = triangulate(closed.scene, database, options, progress=context.progress, work_dir=folder / "work")
        write_scene(scene_from_pycolmap(model, closed.scene.image_dir, like=closed.scene), folder / SCENE)
        return {**closed.to_dict(), **chosen.to_dict()}

    return cached_stage(
        context,
        "circle",
        inputs={"sfm": posed.output.key, "matches": matched.stages[-1].output.key},
        settings=settings,
        code=(poses,),
        build=circle_into,
    )
