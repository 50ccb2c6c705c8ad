"""Pictures without distortion before there are poses, for methods that render from the first step on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from toolkit import poses
from toolkit.poses.undistort import flatten
from toolkit.recipes.base import RecipeContext, RecipeInput
from toolkit.recipes.cached import CachedStage, cached_stage
from toolkit.recipes.steps import SCENE
from toolkit.scene.folder import write_scene


def flat_capture(data: RecipeInput, context: RecipeContext) -> CachedStage:
    """Return the stage flatten: the capture with pinhole cameras, no poses and no points, in ``SCENE``.

    The intrinsics are those of the capture: known, as the papers take them.
    """

    def flat_into(folder: Path) -> dict[str, Any]:
        flat = flatten(data.scene, folder / SCENE, progress=context.progress)
        write_scene(flat, folder / SCENE)
        return {"images": len(flat)}

    return cached_stage(
        context, "flatten", inputs={"capture": data.fingerprint}, settings=None, code=(poses,), build=flat_into
    )
