"""A finished run whose splat is the small map of hills: for everything that localises photos in a run."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from PIL import Image
from splat_ground import CAMERA, down, ground_map, photo

from toolkit.files import write_json
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.runs.folder import RunFolder, make_folder
from toolkit.runs.names import new_id
from toolkit.runs.record import RunRecord
from toolkit.runs.status import RunStatus, write_status
from toolkit.scene import Frame, Georeference, PosePrior, Scene
from toolkit.scene.folder import write_scene
from toolkit.splat.ply import write_splats

#: Four photos that made the map, three that did not, the last of which has no pose.
POSES = (
    down(-6.0, -4.0),
    down(6.0, -4.0, turn=(0.0, 0.0, 15.0)),
    down(6.0, 4.0),
    down(-6.0, 4.0, turn=(0.0, 0.0, -15.0)),
    down(1.0, -1.0, turn=(1.0, -2.0, 10.0)),
    down(-2.0, 2.0, turn=(-2.0, 1.0, -10.0)),
    down(0.0, 3.0, turn=(1.0, 1.0, 5.0)),
)
NAMES = tuple(f"photo_{number}.png" for number in range(len(POSES)))
TESTS = NAMES[4:]
UNPOSED = NAMES[6]


def make_ground_run(folder: Path, *, kind: str = "2d", recipe: str = "2dgs-sparse") -> RunFolder:
    """Write photos of the map and a run with it below a folder, and return the run."""
    settings = {"train": {"kind": kind}}
    record = RunRecord(
        recipe=recipe,
        settings=settings,
        seed=0,
        device="cpu",
        data=str(folder / "photos"),
        data_fingerprint="0",
        name="hills",
        created="2026-06-01T10:00:00+00:00",
        code={},
        machine={},
        threads={},
    )
    run = make_folder(folder / "runs", new_id(recipe), record)
    ground = ground_map()
    images = folder / "photos"
    if not images.is_dir():
        images.mkdir(parents=True)
        for name, pose in zip(NAMES, POSES, strict=True):
            Image.fromarray(photo(ground, pose).picture).save(images / name)
    write_splats(ground.gaussians, run.splat_file)
    write_scene(ground_scene(images), run.scene_folder)
    write_json(run.result_file, {"metrics": {}, "times": [], "reports": {}, "test_views": []})
    write_status(run.status_file, RunStatus("finished"))
    return run


def ground_scene(images: Path) -> Scene:
    """Return the photos with poses, times a second apart, and sensors that are a metre and a degree off."""
    frames = tuple(
        Frame(
            name,
            1,
            None if name == UNPOSED else pose,
            "test" if name in TESTS else "train",
            float(number),
            _prior(pose, number),
        )
        for number, (name, pose) in enumerate(zip(NAMES, POSES, strict=True))
    )
    camera = ColmapCamera("PINHOLE", CAMERA.width, CAMERA.height, (200.0, 200.0, 120.0, 90.0))
    return Scene(images, {1: camera}, frames, georeference=Georeference(48.0, 11.0, 500.0))


def _prior(pose: RigidTransform, number: int) -> PosePrior:
    off = np.random.default_rng(number).normal(size=3)
    turn = down(turn=(0.0, 0.0, float(off[2]))).rotation @ down().rotation.T
    return PosePrior(pose.centre + off, np.ones(3), turn @ pose.rotation, np.full(3, math.radians(1.0)))
