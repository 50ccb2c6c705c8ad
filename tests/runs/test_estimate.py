"""How long a run will take is judged by finished runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from fake_recipe import MakeRun

from toolkit.files import write_json
from toolkit.recipes.base import StageTime
from toolkit.runs.estimate import Estimator
from toolkit.runs.folder import RunFolder, make_folder
from toolkit.runs.record import RunRecord
from toolkit.settings import Choice, Group, Integer, Settings


class Train(Settings):
    """Of a pretended training."""

    steps = Integer(1000, bounds=(1, 100_000), doc="How many.")
    kind = Choice("3d", choices=("3d", "2d"), doc="Which.")


class Method(Settings):
    """Of a pretended recipe."""

    train = Group(Train(), doc="Training")


TIMES = (StageTime("match", 8.0), StageTime("compile", 3.0), StageTime("train", 10.0), StageTime("measure", 2.0))


def record(recipe: str, settings: dict[str, Any], name: str, **changes: Any) -> RunRecord:
    fields: dict[str, Any] = {
        "recipe": recipe,
        "settings": settings,
        "seed": 0,
        "device": "cpu",
        "data": "/data/flight",
        "data_fingerprint": "0" * 64,
        "name": name,
        "created": "2026-01-01T00:00:00+00:00",
        "code": {},
        "machine": {},
        "threads": {},
    }
    return RunRecord(**{**fields, **changes})


def finished(
    runs_dir: Path, number: int, *, steps: int = 1000, kind: str = "3d", photos: int = 20, **changes: Any
) -> RunFolder:
    settings = Method().replace({"train.steps": steps, "train.kind": kind}).to_dict()
    run_id = f"20260101-0000{number:02d}-method-{number:04x}"
    run = make_folder(runs_dir, run_id, record("method", settings, f"run {number}", **changes))
    times = [{"name": time.name, "seconds": time.seconds, "reused": False} for time in TIMES]
    write_json(run.result_file, {"metrics": {}, "times": times, "reports": {}, "test_views": []})
    write_json(run.scene_folder / "scene.json", {"frames": [{}] * photos})
    return run


def test_without_a_finished_run_it_says_so(runs_dir: Path, queued: MakeRun) -> None:
    assert Estimator(runs_dir).estimate("method", Method(), photos=20).seconds is None
    queued()
    found = Estimator(runs_dir).estimate("method", Method(), photos=20)
    assert found.seconds is None
    assert found.basis == "There is no finished run of method on cpu here to judge from."


def test_training_grows_with_steps_and_the_rest_with_photos(runs_dir: Path) -> None:
    run = finished(runs_dir, 1)
    judge = Estimator(runs_dir)
    same = judge.estimate("method", Method(), photos=20)
    assert same.seconds == pytest.approx(23.0, rel=1e-12)
    assert same.run_id == run.id
    assert same.basis == "From run run 1: 23 s with 20 photos and 1000 steps."
    longer = judge.estimate("method", Method().replace({"train.steps": 3000}), photos=40)
    assert longer.seconds == pytest.approx(2 * 8 + 3 + 3 * 10 + 2 * 2, rel=1e-12)
    assert "Scaled: training by steps (1000 to 3000), the other stages by photos (20 to 40)." in longer.basis


def test_the_run_with_the_nearest_settings_is_taken_then_that_with_the_nearest_number_of_photos(
    runs_dir: Path,
) -> None:
    disks = finished(runs_dir, 1, kind="2d", photos=5)
    few = finished(runs_dir, 2, photos=5)
    many = finished(runs_dir, 3, photos=50)
    judge = Estimator(runs_dir)
    assert judge.estimate("method", Method(), photos=6).run_id == few.id
    assert judge.estimate("method", Method(), photos=60).run_id == many.id
    wanted = Method().replace({"train.kind": "2d"})
    found = judge.estimate("method", wanted, photos=60)
    assert found.run_id == disks.id
    assert "the nearest of 3 finished ones" in found.basis
    assert "other settings" not in found.basis
    disks.result_file.unlink()
    assert (
        "It had other settings, which is not counted: train.kind."
        in judge.estimate("method", wanted, photos=6).basis
    )


def test_runs_elsewhere_and_damaged_ones_do_not_count(runs_dir: Path) -> None:
    finished(runs_dir, 1, device="cuda")
    finished(runs_dir, 2).result_file.write_text("{")
    judge = Estimator(runs_dir)
    assert judge.estimate("method", Method(), photos=20).seconds is None
    assert judge.estimate("method", Method(), photos=20, device="cuda").seconds is not None


def test_a_run_is_read_again_when_its_result_changed(runs_dir: Path) -> None:
    run = finished(runs_dir, 1)
    judge = Estimator(runs_dir)
    judge.estimate("method", Method(), photos=20)
    content = json.loads(run.result_file.read_text())
    content["times"][2]["seconds"] = 110.0
    write_json(run.result_file, content)
    assert judge.estimate("method", Method(), photos=20).seconds == pytest.approx(123.0, rel=1e-12)


def test_the_same_data_may_have_stages_done(runs_dir: Path) -> None:
    finished(runs_dir, 1)
    judge = Estimator(runs_dir)
    assert "take no time again" in judge.estimate("method", Method(), photos=20, data="/data/flight").basis
    assert "take no time again" not in judge.estimate("method", Method(), photos=20, data="/data/other").basis
