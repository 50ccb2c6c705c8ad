"""An observer sees a training after each step and changes nothing of it."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_scene import make_scene
from tiny_training import same, settings, stop_after

from toolkit.errors import Cancelled
from toolkit.progress import ProgressEvent
from toolkit.recipes.live_view import LiveView
from toolkit.scene import Scene
from toolkit.splat.train import train_splats
from toolkit.splat.trainer import Trainer


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_scene(tmp_path_factory.mktemp("scene"))


@pytest.mark.parametrize(
    "changes",
    [{"background": "random"}, {"refine_poses": True, "density": "mcmc", "background": "random"}],
    ids=["adaptive", "poses, mcmc"],
)
def test_the_result_is_the_same_to_the_bit_with_and_without(
    scene: Scene, tmp_path: Path, changes: dict[str, object]
) -> None:
    chosen = settings(steps=30, **changes)
    plain = train_splats(scene, chosen, seed=0)
    # It looks after every step here: nothing is spared for the time that it takes.
    view = LiveView(tmp_path / "live", scene, every=0.0, share=1.0)
    watched = train_splats(scene, chosen, seed=0, observer=view)
    assert same(plain.gaussians, watched.gaussians)
    assert plain.history == watched.history
    assert {name: pose.matrix.tolist() for name, pose in plain.poses.items()} == {
        name: pose.matrix.tolist() for name, pose in watched.poses.items()
    }
    assert (tmp_path / "live" / "render.jpg").is_file()
    assert (tmp_path / "live" / "poses.json").is_file() == ("refine_poses" in changes)
    with pytest.raises(Cancelled):
        train_splats(
            scene, chosen, seed=0, progress=stop_after(13), checkpoint_dir=tmp_path / "checkpoint", observer=view
        )
    resumed = train_splats(scene, chosen, seed=0, checkpoint_dir=tmp_path / "checkpoint")
    assert resumed.resumed_at == 13
    assert same(plain.gaussians, resumed.gaussians)
    assert plain.history == resumed.history


def test_what_it_measures_is_told_with_the_step(scene: Scene) -> None:
    seen: list[int] = []

    def look(training: Trainer) -> dict[str, float]:
        seen.append(training.state.step)
        return {"psnr_live": 40.0 + training.state.step} if training.state.step == 3 else {}

    events: list[ProgressEvent] = []
    trained = train_splats(scene, settings(steps=4, eval_every=4), seed=0, progress=events.append, observer=look)
    assert seen == [1, 2, 3, 4]
    told = [event.values.get("psnr_live") for event in events if event.stage == "splat.train"][1:]
    assert told == [None, None, 43.0, None]
    # The history has what every run of these settings has, whoever looks.
    assert [row.psnr_test is not None for row in trained.history] == [False, False, False, True]
    assert "observer" in trained.seconds
