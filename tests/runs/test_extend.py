"""A finished run is made longer by a new one that begins where it ended."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_recipe import RECIPE as FAKE
from fake_recipe import MakeRun, posed

from toolkit.checkpoint import load_newest
from toolkit.errors import RunError, SettingsError
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult, StageTime
from toolkit.runs.extend import extend_run, finished_steps
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import create_run, execute
from toolkit.scene import Points
from toolkit.settings import Group, Settings
from toolkit.splat.train import train_splats
from toolkit.splat.train_settings import TrainSettings

TINY = {"train.steps": 12, "train.background": "black", "train.sh_degree": 1, "train.checkpoint_every": 5}


class TinySettings(Settings):
    """A training and nothing else."""

    train = Group(TrainSettings(), doc="Training")


def tiny_run(data: RecipeInput, settings: TinySettings, context: RecipeContext) -> RecipeResult:
    """Train some points before cameras on a line."""
    rng = np.random.default_rng(0)
    points = Points(rng.normal((2, 8, 0), 2.0, (40, 3)), np.full((40, 3), 128, np.uint8))
    scene = posed(data.scene).replace(points=points)
    trained = train_splats(
        scene,
        settings.train,
        seed=context.seed,
        progress=context.progress,
        checkpoint_dir=context.checkpoint,
    )
    times = (StageTime("train", sum(trained.seconds.values())),)
    return RecipeResult(scene, trained.gaussians, times, {}, {"train": trained.to_dict()})


RECIPE = Recipe("tiny", "A tiny training", "", "Trains.", TinySettings, tiny_run)


@pytest.fixture
def done(photos: Path, runs_dir: Path) -> RunFolder:
    run = create_run(RECIPE, photos, TinySettings().replace(TINY), runs_dir, seed=3, name="short")
    execute(run, recipe=RECIPE)
    return run


def history(run: RunFolder) -> list[dict[str, Any]]:
    return list(run.result().reports["train"]["history"])


def test_it_goes_on_from_the_last_step_with_the_longer_schedule(done: RunFolder) -> None:
    made = extend_run(done, 30, name="long", recipe=RECIPE)
    record = made.record()
    assert made.status().state == "queued"
    assert (record.name, record.seed, record.device) == ("long", 3, "cpu")
    assert record.flat_settings == {**done.record().flat_settings, "train.steps": 30}
    assert f"goes on from step 12 of run {done.id}" in made.log_file.read_text()
    execute(made, recipe=RECIPE)
    told = made.result().reports["train"]
    assert (told["resumed_at"], told["steps"]) == (12, 30)
    assert history(made)[:12] == history(done)
    loss = made.curves().find("splat.train", "loss")
    assert loss is not None
    assert loss.steps.tolist() == list(range(1, 31))
    # The finished run is as it was.
    assert done.status().state == "finished"
    last, _ = load_newest(done.checkpoint)
    assert last is not None
    assert last.step == 12


def test_an_extended_run_can_be_extended(done: RunFolder) -> None:
    made = extend_run(done, 14, recipe=RECIPE)
    execute(made, recipe=RECIPE)
    again = extend_run(made, 16, recipe=RECIPE)
    execute(again, recipe=RECIPE)
    assert history(again)[:14] == history(made)


def test_it_cannot_be_made_shorter(done: RunFolder) -> None:
    with pytest.raises(SettingsError, match="cannot be made shorter; expected more than 12 steps; found 12"):
        extend_run(done, 12, recipe=RECIPE)
    with pytest.raises(SettingsError, match="'steps' is out of range"):
        extend_run(done, 10_000_000, recipe=RECIPE)


def test_only_finished_trainings_with_a_checkpoint_go_on(
    done: RunFolder, queued: MakeRun, finished: MakeRun, photos: Path, runs_dir: Path
) -> None:
    waits = create_run(RECIPE, photos, TinySettings().replace(TINY), runs_dir)
    with pytest.raises(RunError, match="cannot be extended; expected a finished run; found one that is queued"):
        finished_steps(waits)
    with pytest.raises(RunError, match=r"expected a recipe with the setting train.steps that keeps checkpoints"):
        extend_run(finished(loop__steps=2), 50, recipe=FAKE)
    assert finished_steps(done) == 12
    newest = max(done.checkpoint.glob("step-*"))
    newest.unlink()
    with pytest.raises(
        RunError, match="no checkpoint of its last step; expected one of step 12; found one of step 10"
    ):
        extend_run(done, 50, recipe=RECIPE)


def test_data_that_changed_are_refused_and_no_run_is_left(done: RunFolder, photos: Path, runs_dir: Path) -> None:
    (photos / "photo_0.png").write_bytes((photos / "photo_1.png").read_bytes())
    with pytest.raises(RunError, match=r"The data of run .* changed since it was created"):
        extend_run(done, 50, recipe=RECIPE)
    assert [path for path in runs_dir.iterdir() if not path.name.startswith(".")] == [done.path]
