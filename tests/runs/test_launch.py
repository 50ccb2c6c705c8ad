"""Runs are created, executed and resumed; a resumed run equals one that was never stopped."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from fake_recipe import RECIPE, FakeSettings, LoopSettings, MakeRun, posed, write_photos
from PIL import Image

from toolkit.errors import Cancelled, CapabilityError, DataError, RunError, SettingsError, StageError
from toolkit.files import read_json
from toolkit.progress import CancelToken, ProgressEvent
from toolkit.recipes import registry
from toolkit.recipes.base import RecipeContext, RecipeInput, RecipeResult
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import WORKSPACE, create_run, execute, resume
from toolkit.runs.process import ProcessMark
from toolkit.runs.status import RunStatus, read_status, utc_now, write_status
from toolkit.runs.trajectories import read_trajectories
from toolkit.scene.dataset import open_capture
from toolkit.scene.folder import write_scene
from toolkit.settings import Settings


def stop_at(step: int) -> CancelToken:
    class Stop(CancelToken):
        def __call__(self, event: ProgressEvent) -> None:
            if event.stage == "train" and event.done == step:
                self.cancel()
            super().__call__(event)

    return Stop()


def values(run: RunFolder, name: str) -> list[float]:
    curve = run.curves().find("train", name)
    assert curve is not None
    assert curve.steps.tolist() == list(range(1, len(curve.steps) + 1))
    return list(curve.values)


def test_a_run_goes_from_queued_to_finished(queued: MakeRun) -> None:
    run = queued()
    events: list[ProgressEvent] = []
    result = execute(run, events.append, recipe=RECIPE)
    assert run.status().state == "finished"
    assert run.result().metrics == result.metrics
    assert [event.done for event in events if event.stage == "train"] == list(range(1, 31))
    assert len(values(run, "loss")) == 30
    assert run.scene_folder.is_dir()
    assert not run.splat_file.exists()  # the fake recipe makes none


def test_found_and_reference_poses_are_kept_for_plots(queued: MakeRun) -> None:
    run = queued()
    result = execute(run, recipe=RECIPE)
    stored = read_trajectories(run.trajectory_file)
    assert stored.reference is None
    for frame in result.scene.frames:
        assert frame.cam_from_world is not None
        # JSON keeps all digits; the way over the quaternion costs a few of the last.
        np.testing.assert_allclose(stored.found.poses[frame.name].matrix, frame.cam_from_world.matrix, atol=1e-12)


def test_true_poses_of_the_data_are_kept_beside_the_found_ones(
    queued: MakeRun, photos: Path, tmp_path: Path
) -> None:
    truth = posed(open_capture(photos).scene)
    write_scene(truth, tmp_path / "scene", copy_images=True)
    run = queued(data=tmp_path / "scene")
    execute(run, recipe=RECIPE)
    stored = read_trajectories(run.trajectory_file)
    assert stored.reference is not None
    for frame in truth.frames:
        assert frame.cam_from_world is not None
        np.testing.assert_allclose(
            stored.reference.poses[frame.name].matrix, frame.cam_from_world.matrix, atol=1e-12
        )


def test_the_recipe_gets_frozen_settings_and_its_own_folders(queued: MakeRun) -> None:
    seen: list[tuple[RecipeInput, Settings, RecipeContext]] = []

    def spy(data: RecipeInput, settings: FakeSettings, context: RecipeContext) -> RecipeResult:
        seen.append((data, settings, context))
        return RECIPE.run(data, settings, context)

    run = queued(seed=5)
    execute(run, recipe=dataclasses.replace(RECIPE, run=spy))
    data, settings, context = seen[0]
    with pytest.raises(SettingsError, match="belongs to a started job"):
        settings.pause = 1.0
    assert context.seed == 5
    assert context.device == "cpu"
    assert context.artifacts == run.artifacts
    assert context.checkpoint == run.checkpoint
    assert context.workspace.root == run.path.parent / WORKSPACE
    assert data.fingerprint == run.record().data_fingerprint


def test_runs_reuse_the_stages_of_earlier_runs(finished: MakeRun) -> None:
    assert [time.reused for time in finished().result().times] == [False, False]
    assert [time.reused for time in finished(loop__steps=5).result().times] == [True, False]


def test_a_registered_recipe_is_found_by_its_name(queued: MakeRun, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "all_recipes", lambda: {"fake": RECIPE})
    run = queued()
    execute(run)
    assert run.status().state == "finished"


def test_a_cancelled_run_goes_on_from_its_checkpoint_to_the_same_result(queued: MakeRun, finished: MakeRun) -> None:
    whole = finished(seed=3)
    run = queued(seed=3)
    with pytest.raises(Cancelled, match="Cancelled in stage train at 17 of 30"):
        execute(run, stop_at(17), recipe=RECIPE)
    assert run.status().state == "cancelled"
    assert not run.result_file.exists()
    assert len(values(run, "total")) == 17

    events: list[ProgressEvent] = []
    resume(run, events.append, recipe=RECIPE)
    assert next(event.done for event in events if event.stage == "train") == 11  # the checkpoint was at 10
    assert run.result().metrics == whole.result().metrics  # to the bit
    assert values(run, "total") == values(whole, "total")  # no step twice, none missing
    assert "resumed; it was cancelled in stage 'train' at 17: Cancelled in stage train" in run.log_file.read_text()


def test_ctrl_c_leaves_a_run_that_can_be_resumed(queued: MakeRun) -> None:
    def interrupt(event: ProgressEvent) -> None:
        if event.done == 12:
            raise KeyboardInterrupt

    run = queued()
    with pytest.raises(KeyboardInterrupt):
        execute(run, interrupt, recipe=RECIPE)
    assert run.status().state == "cancelled"
    resume(run, recipe=RECIPE)
    assert run.status().state == "finished"


def test_a_failed_run_keeps_its_reason_and_can_be_resumed(queued: MakeRun) -> None:
    run = queued(fail_at=15)
    with pytest.raises(StageError, match="The fake recipe fails here; found step 15"):
        execute(run, recipe=RECIPE)
    assert run.status().state == "failed"
    assert run.status().error == "The fake recipe fails here; found step 15."
    with pytest.raises(StageError, match="step 15"):
        resume(run, recipe=RECIPE)
    assert run.log_file.read_text().count("Traceback") == 2


def test_a_queued_run_can_be_resumed_as_well_as_executed(queued: MakeRun) -> None:
    run = queued()
    resume(run, recipe=RECIPE)
    assert run.status().state == "finished"
    assert "resumed" not in run.log_file.read_text()


def test_a_finished_run_is_neither_executed_nor_resumed(finished: MakeRun) -> None:
    run = finished()
    before = run.log_file.read_text()
    for attempt in (execute, resume):
        with pytest.raises(
            RunError, match=f"Run {run.id} cannot be started; .*found one that is finished"
        ) as caught:
            attempt(run, recipe=RECIPE)
        assert "start a new run to compute it again" in str(caught.value)
    assert run.log_file.read_text() == before


def test_a_stopped_run_is_not_executed_but_resumed(queued: MakeRun) -> None:
    run = queued()
    with pytest.raises(Cancelled):
        execute(run, stop_at(5), recipe=RECIPE)
    with pytest.raises(RunError, match=r"expected queued; found one that is cancelled. Resume it\."):
        execute(run, recipe=RECIPE)


def test_a_run_at_work_elsewhere_is_left_alone(queued: MakeRun) -> None:
    run = queued()
    elsewhere = dataclasses.replace(ProcessMark.current(), host="elsewhere")
    write_status(run.status_file, RunStatus("running", heartbeat=utc_now(), started=utc_now(), process=elsewhere))
    with pytest.raises(RunError, match="found one that is running. Wait until it ends"):
        resume(run, recipe=RECIPE)


def test_a_run_that_its_process_let_go_without_a_word_can_be_resumed(queued: MakeRun) -> None:
    run = queued()
    mark = ProcessMark.current()  # alive, but it does not hold the lock
    write_status(run.status_file, RunStatus("running", heartbeat=utc_now(), started=utc_now(), process=mark))
    resume(run, recipe=RECIPE)
    assert run.status().state == "finished"


@pytest.mark.parametrize("text", ["", "{}", None])
def test_a_stopped_run_with_a_damaged_status_can_be_resumed(queued: MakeRun, text: str | None) -> None:
    run = queued()
    with pytest.raises(Cancelled):
        execute(run, stop_at(12), recipe=RECIPE)
    run.status_file.unlink()
    if text is not None:
        run.status_file.write_text(text)
    with pytest.raises(RunError, match="expected queued; found one that is interrupted"):
        execute(run, recipe=RECIPE)
    resume(run, recipe=RECIPE)
    assert run.status().state == "finished"
    assert "resumed; it was interrupted: " in run.log_file.read_text()
    assert "status.json" in run.log_file.read_text()


def test_changed_pictures_are_refused(queued: MakeRun, photos: Path) -> None:
    run = queued()
    with pytest.raises(Cancelled):
        execute(run, stop_at(12), recipe=RECIPE)
    picture = photos / "photo_0.png"
    original = picture.read_bytes()
    Image.new("RGB", (48, 32), "red").save(picture)
    with pytest.raises(RunError, match="The data of run .* changed since it was created; expected .*fingerprint"):
        resume(run, recipe=RECIPE)
    picture.write_bytes(original)
    resume(run, recipe=RECIPE)
    assert run.status().state == "finished"


def test_settings_that_this_version_does_not_know_are_refused(queued: MakeRun) -> None:
    run = queued()
    record = json.loads(run.record_file.read_text())
    record["settings"]["old_name"] = 1
    run.record_file.write_text(json.dumps(record))
    with pytest.raises(
        RunError, match="do not fit this version of recipe 'fake'; found .*Unknown setting 'old_name'"
    ):
        execute(run, recipe=RECIPE)
    assert run.status().state == "queued"


def test_settings_that_the_run_does_not_have_are_refused(queued: MakeRun) -> None:
    run = queued()
    record = json.loads(run.record_file.read_text())
    del record["settings"]["loop"]["rate"]
    run.record_file.write_text(json.dumps(record))
    with pytest.raises(RunError, match=r"settings that the run does not have: loop\.rate. Start a new run"):
        resume(run, recipe=RECIPE)


def test_another_recipe_is_refused(queued: MakeRun) -> None:
    other = dataclasses.replace(RECIPE, name="other")
    with pytest.raises(RunError, match="is of another recipe; expected 'fake'; found 'other'"):
        execute(queued(), recipe=other)


def test_a_recipe_that_is_gone_is_told(queued: MakeRun, monkeypatch: pytest.MonkeyPatch) -> None:
    other = dataclasses.replace(RECIPE, name="other")
    monkeypatch.setattr(registry, "all_recipes", lambda: {"other": other})
    with pytest.raises(SettingsError, match="Unknown recipe 'fake'; expected one of other"):
        execute(queued())


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        ("code", {"version": "0.0.1", "sources": "0123456789abcdef"}, "warning: code version changed"),
        ("threads", {"torch": 64, "numba": 64, "OMP_NUM_THREADS": None}, "warning: threads changed"),
        ("machine", {"libraries": {"torch": "1.0"}}, "warning: libraries changed"),
    ],
)
def test_other_code_threads_or_libraries_are_a_warning_in_the_log(
    queued: MakeRun, field: str, value: object, told: str
) -> None:
    run = queued()
    record = json.loads(run.record_file.read_text())
    run.record_file.write_text(json.dumps({**record, field: value}))
    resume(run, recipe=RECIPE)
    assert told in run.log_file.read_text()


def test_unchanged_code_is_no_warning(finished: MakeRun) -> None:
    assert "changed since" not in finished().log_file.read_text()


def test_measures_that_are_not_finite_become_null_with_a_warning(queued: MakeRun) -> None:
    def endless(data: RecipeInput, settings: FakeSettings, context: RecipeContext) -> RecipeResult:
        result = RECIPE.run(data, settings, context)
        return dataclasses.replace(result, metrics={**result.metrics, "test.psnr": float("inf")})

    run = queued()
    execute(run, recipe=dataclasses.replace(RECIPE, run=endless))
    assert run.result().metrics["test.psnr"] is None
    assert "warning: result.metrics.test.psnr is not finite and is stored as null" in run.log_file.read_text()


def test_settings_of_another_recipe_are_refused(photos: Path, runs_dir: Path) -> None:
    with pytest.raises(
        SettingsError, match="no settings of recipe 'fake'; expected FakeSettings; found LoopSettings"
    ):
        create_run(RECIPE, photos, LoopSettings(), runs_dir)
    assert not runs_dir.exists()


def test_a_negative_seed_is_refused(queued: MakeRun) -> None:
    with pytest.raises(SettingsError, match="Seed is out of range; expected a whole number from 0; found -1"):
        queued(seed=-1)


def test_devices_that_are_not_there_are_refused(
    photos: Path, runs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(CapabilityError, match="No CUDA device here; .*Choose the device cpu"):
        create_run(RECIPE, photos, FakeSettings(), runs_dir, device="cuda")
    with pytest.raises(CapabilityError, match="Unknown device 'tpu'; expected cpu or cuda"):
        create_run(RECIPE, photos, FakeSettings(), runs_dir, device="tpu")


def test_a_harmful_name_is_refused_before_anything_is_written(queued: MakeRun, runs_dir: Path) -> None:
    with pytest.raises(RunError, match="cannot be used"):
        queued(name="../escape")
    assert not runs_dir.exists()


def test_a_folder_without_pictures_makes_no_run(tmp_path: Path, queued: MakeRun, runs_dir: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="empty"):
        queued(data=tmp_path / "empty")
    assert not runs_dir.exists()


def test_data_that_vanish_before_the_start_are_a_failure_with_a_reason(queued: MakeRun, photos: Path) -> None:
    run = queued()
    photos.rename(photos.with_name("moved"))
    with pytest.raises(DataError, match="photos"):
        execute(run, recipe=RECIPE)
    assert run.status().state == "failed"
    assert "photos" in run.status().error


def test_the_same_data_elsewhere_have_the_same_fingerprint(tmp_path: Path, queued: MakeRun) -> None:
    one, two = write_photos(tmp_path / "one"), write_photos(tmp_path / "two")
    other = write_photos(tmp_path / "three", seed=1)
    prints = [queued(data=folder).record().data_fingerprint for folder in (one, two, other)]
    assert prints[0] == prints[1] != prints[2]


def test_status_names_this_process_while_it_works(queued: MakeRun) -> None:
    run = queued()
    seen: list[RunStatus] = []
    execute(run, lambda event: seen.append(read_status(run.status_file)), recipe=RECIPE)
    assert {status.state for status in seen} == {"running"}
    assert {status.process for status in seen} == {ProcessMark.current()}


def test_the_stored_result_is_whole_json(finished: MakeRun) -> None:
    content = read_json(finished().result_file)
    assert set(content) == {"metrics", "times", "reports", "test_views"}
