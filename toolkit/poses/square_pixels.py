"""Pinhole cameras whose two focal lengths are one unknown, because their pixels are square."""

from __future__ import annotations

import dataclasses
from contextlib import closing
from pathlib import Path

import pycolmap

from toolkit.geometry.cameras import ColmapCamera
from toolkit.scene import Scene


def with_one_focal(scene: Scene, database_path: Path) -> Scene:
    """Return the scene with SIMPLE_PINHOLE in place of PINHOLE cameras with equal focal lengths.

    COLMAP wants the same models in the scene and in the database; the database is changed, too.
    """
    single = {
        camera_id: dataclasses.replace(camera, model="SIMPLE_PINHOLE", params=camera.params[1:])
        for camera_id, camera in scene.cameras.items()
        if isinstance(camera, ColmapCamera) and camera.model == "PINHOLE" and camera.params[0] == camera.params[1]
    }
    with closing(pycolmap.Database.open(database_path)) as database:
        for camera_id, camera in single.items():
            database.update_camera(camera.to_pycolmap(camera_id))
    return scene.replace(cameras={**scene.cameras, **single})


def with_models_of(scene: Scene, like: Scene) -> Scene:
    """Return the scene with PINHOLE in place of SIMPLE_PINHOLE cameras where ``like`` has it."""
    pinhole = {
        camera_id
        for camera_id, camera in like.cameras.items()
        if isinstance(camera, ColmapCamera) and camera.model == "PINHOLE"
    }
    double = {
        camera_id: dataclasses.replace(camera, model="PINHOLE", params=(camera.params[0], *camera.params))
        for camera_id, camera in scene.cameras.items()
        if isinstance(camera, ColmapCamera) and camera.model == "SIMPLE_PINHOLE" and camera_id in pinhole
    }
    return scene.replace(cameras={**scene.cameras, **double})
