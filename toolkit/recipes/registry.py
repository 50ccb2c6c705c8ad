"""All recipes by their names."""

from __future__ import annotations

import difflib

from toolkit.errors import CapabilityError, SettingsError
from toolkit.optional import RECIPES, added_by_packages
from toolkit.recipes.base import Recipe


def all_recipes() -> dict[str, Recipe]:
    """Return every recipe by its name in the order in which they are listed, those of other packages last.

    Raises
    ------
    MissingDependencyError, CapabilityError
        Where a recipe of another package cannot be loaded, is none, or has the name of one that is there.
    """
    recipes = built_in_recipes()
    for name, recipe in added_by_packages(RECIPES, Recipe).items():
        if name in recipes:
            raise CapabilityError(
                f"A package adds the recipe '{name}', which the toolkit has already",
                expected="another name",
                todo="Rename it there, or uninstall that package",
            )
        recipes[name] = recipe
    return recipes


def built_in_recipes() -> dict[str, Recipe]:
    """Return the toolkit's own recipes by their names, in the order in which they are listed."""
    from toolkit.recipes.blades import CIRCULAR, EXHAUSTIVE, SEQUENTIAL
    from toolkit.recipes.cf_3dgs import RECIPE as CF_3DGS
    from toolkit.recipes.colmap_3dgs import RECIPE as COLMAP_3DGS
    from toolkit.recipes.depth_fusion import RECIPE as DEPTH_FUSION
    from toolkit.recipes.dust3r_views import RECIPE as DUST3R_VIEWS
    from toolkit.recipes.mvs_poisson import RECIPE as MVS_POISSON
    from toolkit.recipes.nerf import DS_NERF, NERF
    from toolkit.recipes.noposegs import RECIPE as NOPOSEGS
    from toolkit.recipes.sat_colmap_3dgs import RECIPE as SAT_COLMAP_3DGS
    from toolkit.recipes.sat_heights import RECIPE as SAT_HEIGHTS
    from toolkit.recipes.sat_splat import RECIPE as SAT_SPLAT
    from toolkit.recipes.sensor_3dgs import RECIPE as SENSOR_3DGS
    from toolkit.recipes.sensor_depth import SENSOR_DEPTH, SENSOR_DPT, SENSOR_GROUND
    from toolkit.recipes.sensor_fused import RECIPE as SENSOR_FUSED
    from toolkit.recipes.slam_noposegs import ORB_PNP, ORBSLAM
    from toolkit.recipes.splat_mesh import RECIPE as SPLAT_MESH
    from toolkit.recipes.uav_maps import DENSE as MAP_DENSE
    from toolkit.recipes.uav_maps import DENSE_POS as MAP_DENSE_POS
    from toolkit.recipes.uav_maps import HELD as MAP_HELD
    from toolkit.recipes.uav_maps import SPARSE as MAP_SPARSE
    from toolkit.recipes.vggt_ba import RECIPE as VGGT_BA

    recipes = (
        *(COLMAP_3DGS, CF_3DGS, NOPOSEGS, ORBSLAM, ORB_PNP),
        *(SENSOR_DPT, SENSOR_DEPTH, SENSOR_GROUND, SENSOR_3DGS, SENSOR_FUSED),
        *(EXHAUSTIVE, SEQUENTIAL, CIRCULAR),
        *(NERF, DS_NERF),
        *(MVS_POISSON, DEPTH_FUSION),
        SPLAT_MESH,
        *(SAT_COLMAP_3DGS, SAT_HEIGHTS, SAT_SPLAT, VGGT_BA, DUST3R_VIEWS),
        *(MAP_SPARSE, MAP_DENSE, MAP_DENSE_POS, MAP_HELD),
    )
    return {recipe.name: recipe for recipe in recipes}


def find_recipe(name: str) -> Recipe:
    """Return the recipe of this name.

    Raises
    ------
    SettingsError
        Where there is none; the message lists those that there are.
    """
    recipes = all_recipes()
    if name not in recipes:
        close = difflib.get_close_matches(name, recipes, n=1)
        raise SettingsError(
            f"Unknown recipe '{name}'",
            expected="one of " + ", ".join(recipes),
            todo=f"Did you mean '{close[0]}'?" if close else "toolkit recipes lists them",
        )
    return recipes[name]
