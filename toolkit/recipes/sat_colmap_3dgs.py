"""Satellite pictures as if they were photos: COLMAP, and a splat of those that it places (section 4.3)."""

from __future__ import annotations

import dataclasses

from toolkit.depth.settings import DepthSettings
from toolkit.metrics.lpips import Lpips
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult
from toolkit.recipes.colmap_3dgs import Colmap3dgsSettings, structure_from_motion
from toolkit.recipes.held_depth import held_depth
from toolkit.recipes.satellite_steps import pictures_stage
from toolkit.recipes.steps import SCENE, PosedStages, sfm_metrics, train_and_measure
from toolkit.scene import Scene
from toolkit.scene.folder import read_scene
from toolkit.scene.photos import start_camera
from toolkit.settings import Group

#: As 3DGS's own script for photos has it: one camera for all pictures of a size.
CAMERA_MODEL = "OPENCV"


class SatColmap3dgsSettings(Colmap3dgsSettings):
    """Settings of COLMAP + 3DGS, with the paper's network for depth."""

    depth = Group(
        DepthSettings(weights="depth-anything/Depth-Anything-V2-Large-hf"),
        doc="Where that depth comes from: the paper took Depth Anything V2",
    )


def run(data: RecipeInput, settings: SatColmap3dgsSettings, context: RecipeContext) -> RecipeResult:
    """Let COLMAP place the pictures without their RPCs, train a splat on those that it placed, and measure."""
    lpips, held = Lpips(), held_depth(settings.depth, settings.depth_loss)
    pictures = pictures_stage(data, context)
    photos = RecipeInput(as_photos(read_scene(pictures.folder / SCENE)), None, pictures.output.key)
    stages = structure_from_motion(photos, settings, context)
    metrics = sfm_metrics(read_scene(stages[-1].folder / SCENE), stages[-1].report)
    posed = PosedStages((pictures, *stages), metrics)
    return train_and_measure(photos, posed, settings.train, context, lpips, held, training_views=True)


def as_photos(scene: Scene) -> Scene:
    """Return pictures as a folder of photos without tags would be opened: with COLMAP's guess of a camera."""
    size_of = {number: (camera.width, camera.height) for number, camera in scene.cameras.items()}
    numbers = {size: i for i, size in enumerate(dict.fromkeys(size_of.values()), start=1)}
    cameras = {i: start_camera(CAMERA_MODEL, *size) for size, i in numbers.items()}
    frames = tuple(
        dataclasses.replace(frame, camera_id=numbers[size_of[frame.camera_id]]) for frame in scene.frames
    )
    return Scene(scene.image_dir, cameras, frames, mask_dir=scene.mask_dir)


RECIPE = Recipe(
    name="sat-colmap-3dgs",
    title="COLMAP + 3DGS on satellite pictures",
    paper="satellite-3d",
    description=(
        "Satellite pictures taken for photos: incremental structure from motion without their RPCs, which places a "
        "few of them, and 3D Gaussian splatting on these, with predicted depth where depth_loss.weight is not 0. "
        "Training pictures are measured, too, because the paper reports nothing else. The baseline that sat-splat "
        "is to be compared with."
    ),
    settings_type=SatColmap3dgsSettings,
    run=run,
)
