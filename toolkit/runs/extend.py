"""Going on with a finished run: a new run with more steps that begins where the other one ended."""

from __future__ import annotations

import shutil
from pathlib import Path

from toolkit.errors import RunError, SettingsError
from toolkit.files import disk_errors, write_text
from toolkit.progress import Progress, silent
from toolkit.recipes.base import Recipe
from toolkit.runs.estimate import STEPS
from toolkit.runs.folder import RunFolder
from toolkit.runs.launch import create_run, require_same_data
from toolkit.runs.record import RunRecord


def extend_run(
    run: RunFolder, steps: int, *, name: str = "", progress: Progress = silent, recipe: Recipe | None = None
) -> RunFolder:
    """Return a new queued run as a finished one, with more training steps, that goes on from its last checkpoint.

    The finished run stays as it is. What a new run of ``steps`` steps does after its first N, the new run does: it
    takes the N steps of the finished one in place of its own first N. What is a share of the steps or decays over
    them belongs to the longer run from there on. So

    - learning rates, which had fallen to their last values at step N, rise again to what the longer run has there
      and fall to the same last values at its end (a warm restart; the loss may rise for a while);
    - densification, opacity resets, coarse pictures and the learning of poses begin again where step N lies in the
      longer run's share of them, and stay ended where it does not;
    - Adam's moments, densification statistics, the order of the photos and the random numbers go on;
    - degrees of the spherical harmonics that were reached are not given up.

    Stages before the training are found in the workspace. Where they are not, or the code changed and they come out
    otherwise, the training refuses to go on and the run fails. Its stage ``train`` counts the time of all steps.

    The result is therefore neither that of N steps with some more at the last rate, nor that of a run with
    ``steps`` steps from the start. The run's settings tell ``steps``; its log says where it began; its curves begin
    with those of the finished run.

    Parameters
    ----------
    run:
        Finished, of a recipe that trains with ``train.steps`` and keeps checkpoints.
    steps:
        In all, more than the finished run had.
    name:
        Of the new run; may be empty.
    progress:
        As in :func:`~toolkit.runs.launch.create_run`.
    recipe:
        For recipes that are not registered.

    Raises
    ------
    RunError
        For a run that is not finished or kept no checkpoint of its last step, or whose data changed.
    SettingsError
        For too few steps, too many, or settings that do not fit this version.
    DataError
        Where checkpoint, record or data are damaged.
    CapabilityError
        Where its device is not there.
    """
    from toolkit.checkpoint import Checkpoint, load_newest, save_checkpoint

    record = run.record()
    before = finished_steps(run, record)
    if steps <= before:
        raise SettingsError(
            f"Run {run.id} cannot be made shorter", expected=f"more than {before} steps", found=str(steps)
        )
    if recipe is None:
        from toolkit.recipes.registry import find_recipe

        recipe = find_recipe(record.recipe)
    settings = recipe.settings_type.from_dict(record.settings).replace({STEPS: steps})
    last, _ = load_newest(run.checkpoint)
    if last is None or last.step != before:
        raise RunError(
            f"Run {run.id} kept no checkpoint of its last step",
            expected=f"one of step {before}",
            found="none" if last is None else f"one of step {last.step}",
            todo="Start a new run with more steps",
        )
    made = create_run(
        recipe,
        Path(record.data),
        settings,
        run.path.parent,
        seed=record.seed,
        device=record.device,
        name=name,
        progress=progress,
    )
    try:
        require_same_data(run, record, made.record().data_fingerprint)
        made_with = {**last.state["made_with"]}
        made_with["settings"] = {**made_with["settings"], "steps": steps}
        save_checkpoint(
            made.checkpoint, Checkpoint(last.step, last.tensors, {**last.state, "made_with": made_with})
        )
        with disk_errors(made.path, "writing"):
            shutil.copyfile(run.metrics_file, made.metrics_file)
        write_text(made.log_file, f"{made.record().created} goes on from step {before} of run {run.id}\n")
    except BaseException:
        shutil.rmtree(made.path, ignore_errors=True)
        raise
    return made


def finished_steps(run: RunFolder, record: RunRecord | None = None) -> int:
    """Return how many steps a finished run trained.

    Raises
    ------
    RunError
        For a run that cannot be extended: it is not finished, or its recipe does not train with ``train.steps``.
    DataError
        Where its record or status is damaged.
    """
    state = run.status().state
    if state != "finished":
        raise RunError(
            f"Run {run.id} cannot be extended",
            expected="a finished run",
            found=f"one that is {state}",
            todo="Resume it" if state in ("failed", "cancelled", "interrupted") else "Wait until it ends",
        )
    steps = (record or run.record()).flat_settings.get(STEPS)
    if not isinstance(steps, int) or not any(run.checkpoint.glob("step-*")):
        raise RunError(
            f"Run {run.id} cannot be extended",
            expected=f"a recipe with the setting {STEPS} that keeps checkpoints",
            found=(record or run.record()).recipe,
            todo="Start a new run with more steps",
        )
    return steps
