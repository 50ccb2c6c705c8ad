"""A quick recipe that needs no reconstruction: for everything around runs.

As a program, ``python fake_recipe.py resume|execute RUN_FOLDER`` works on a run in a process of its own.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from PIL import Image

from toolkit.errors import StageError
from toolkit.files import read_json, write_json
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.progress import ProgressEvent
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult, StageTime, TestView
from toolkit.runs.folder import RunFolder, open_run
from toolkit.runs.launch import execute, resume
from toolkit.scene import Frame, Scene
from toolkit.settings import Group, Integer, Number, Settings
from toolkit.workspace import fingerprint

CHECKPOINT_EVERY = 10


class LoopSettings(Settings):
    """Of the pretended training."""

    steps = Integer(30, bounds=(1, 100000), doc="How many steps.")
    rate = Number(0.5, bounds=(0, 10), unit="1/step", doc="How fast the loss falls.")


class FakeSettings(Settings):
    """Of the fake recipe."""

    loop = Group(LoopSettings(), doc="Training")
    pause = Number(0.0, bounds=(0, 60), unit="s", doc="Time that each step takes.")
    fail_at = Integer(0, bounds=(0, 100000), doc="Step at which it fails for good; 0: never.")
    test_every = Integer(2, bounds=(1, 100), doc="Every how many pictures one is a test picture.")


def run(data: RecipeInput, settings: FakeSettings, context: RecipeContext) -> RecipeResult:
    """Prepare once for all runs, then count steps from the last checkpoint."""
    prepared = context.workspace.stage(
        "prepare",
        inputs={"capture": data.fingerprint},
        settings=None,
        code="1",
        build=lambda folder: write_json(folder / "made.json", 1),
    )
    context.progress(ProgressEvent("prepare", 1, 1, "reused" if prepared.reused else ""))
    began = time.perf_counter()
    total = _train(settings, context)
    scene = posed(data.scene)
    views = _views(scene, settings, context)
    return RecipeResult(
        scene=scene,
        gaussians=None,
        times=(
            StageTime("prepare", prepared.seconds, prepared.reused),
            StageTime("train", time.perf_counter() - began),
        ),
        metrics={
            "test.psnr": float(np.mean([view.psnr for view in views])),
            "test.ssim": 0.5,
            "test.lpips_vgg": None,
            "loop.total": total,
            "poses.sim3.ate": settings.loop.rate,
        },
        reports={"train": {"total": np.float64(total), "steps": np.int64(settings.loop.steps)}},
        test_views=views,
    )


def _train(settings: FakeSettings, context: RecipeContext) -> float:
    """Return a sum that depends on every step and on the seed, from the checkpoint where there is one."""
    steps, state = settings.loop.steps, {"step": 0, "total": 0.0}
    saved = context.checkpoint / "state.json"
    if saved.is_file():
        state = read_json(saved)
    for step in range(int(state["step"]) + 1, steps + 1):
        if step == settings.fail_at:
            raise StageError("The fake recipe fails here", found=f"step {step}")
        time.sleep(settings.pause)
        state["total"] += float(np.random.default_rng([context.seed, step]).random())
        if step % CHECKPOINT_EVERY == 0:
            write_json(saved, {**state, "step": step})
        loss = float(np.exp(-settings.loop.rate * step / steps))
        context.progress(ProgressEvent("train", step, steps, "", {"loss": loss, "total": state["total"]}))
    return state["total"]


def posed(scene: Scene) -> Scene:
    """Return the scene with cameras on a bent line, all looking at one point."""
    camera = ColmapCamera.pinhole(48, 32, 40.0)
    frames = tuple(
        Frame(frame.name, 1, RigidTransform.look_at((i, 0.1 * i * i, 5.0), (2.0, 8.0, 0.0)), frame.split)
        for i, frame in enumerate(scene.frames)
    )
    return scene.replace(cameras={1: camera}, frames=frames)


def _views(scene: Scene, settings: FakeSettings, context: RecipeContext) -> tuple[TestView, ...]:
    views = []
    (context.artifacts / "test").mkdir(exist_ok=True)
    for number, frame in enumerate(scene.frames[:: settings.test_every]):
        photo = np.asarray(Image.open(scene.image_path(frame)).convert("RGB"))
        render = np.clip(photo.astype(float) + 10 + number + 10 * settings.loop.rate, 0, 255).astype(np.uint8)
        names = f"test/{number}_photo.png", f"test/{number}_render.png"
        for name, picture in zip(names, (photo, render), strict=True):
            Image.fromarray(picture).save(context.artifacts / name)
        error = float(np.mean((photo.astype(float) - render) ** 2))
        views.append(TestView(frame.name, *names, psnr=10 * float(np.log10(255**2 / error)), ssim=0.5))
    return tuple(views)


RECIPE = Recipe(
    name="fake",
    title="A fake recipe",
    paper="",
    description="Counts steps.",
    settings_type=FakeSettings,
    run=run,
)


class MakeRun(Protocol):
    """What the fixtures that make runs are."""

    def __call__(self, *, name: str = "", seed: int = 0, data: Path | None = None, **changes: Any) -> RunFolder: ...


def write_photos(folder: Path, count: int = 6, *, seed: int = 0) -> Path:
    """Write small coloured pictures and return the folder."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    for number in range(count):
        coarse = Image.fromarray(rng.integers(0, 255, (4, 6, 3), dtype=np.uint8))
        coarse.resize((48, 32), Image.Resampling.BICUBIC).save(folder / f"photo_{number}.png")
    return folder


if __name__ == "__main__":
    result = {"execute": execute, "resume": resume}[sys.argv[1]](open_run(Path(sys.argv[2])), recipe=RECIPE)
    print(json.dumps(result.metrics), fingerprint(result.metrics))
