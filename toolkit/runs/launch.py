"""Creating, executing and resuming runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from toolkit.errors import CapabilityError, DataError, RunError, SettingsError
from toolkit.progress import Progress, fan_out, silent
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult
from toolkit.runs.cancel import CancelRequests, forget_request
from toolkit.runs.folder import RunFolder, make_folder
from toolkit.runs.journal import Journal, journal
from toolkit.runs.machine import describe_code, describe_machine, describe_threads
from toolkit.runs.names import check_name, new_id
from toolkit.runs.record import RunRecord
from toolkit.runs.result import write_result
from toolkit.runs.status import RunStatus, State, utc_now
from toolkit.scene.dataset import Capture, capture_fingerprint, open_capture
from toolkit.settings import Settings
from toolkit.workspace import Workspace

#: Folder beside the runs in which stages keep what later runs can use again.
WORKSPACE = ".workspace"


def create_run(
    recipe: Recipe,
    data_folder: Path,
    settings: Settings,
    runs_dir: Path,
    *,
    seed: int = 0,
    device: str = "cpu",
    name: str = "",
    threads: Mapping[str, Any] | None = None,
    progress: Progress = silent,
) -> RunFolder:
    """Return a new queued run; nothing is computed yet but the fingerprint of the data.

    Parameters
    ----------
    recipe, settings:
        What to run; the settings are of the recipe's own class.
    data_folder:
        Capture that :func:`toolkit.scene.dataset.open_capture` reads.
    runs_dir:
        Where runs lie, made where it is missing.
    seed:
        Of every random choice, from 0 on.
    device:
        ``"cpu"`` or ``"cuda"``.
    name:
        What the user calls it; may be empty.
    threads:
        With how many it will compute (:func:`~toolkit.runs.machine.describe_threads`); None: as this process.
    progress:
        Told of every picture that is checked and hashed.

    Raises
    ------
    RunError
        For a name that cannot be used, or a runs folder that refuses writing.
    SettingsError
        For settings of another recipe, or a negative seed.
    CapabilityError
        For a device that is not there.
    DataError
        Where the folder holds no capture.
    """
    if name:
        check_name(name)
    if type(settings) is not recipe.settings_type:
        raise SettingsError(
            f"These are no settings of recipe '{recipe.name}'",
            expected=recipe.settings_type.__name__,
            found=type(settings).__name__,
        )
    if seed < 0:
        raise SettingsError("Seed is out of range", expected="a whole number from 0", found=str(seed))
    _check_device(device)
    run_id = new_id(recipe.name)
    capture = open_capture(data_folder, progress=progress)
    record = RunRecord(
        recipe=recipe.name,
        settings=settings.to_dict(),
        seed=seed,
        device=device,
        data=str(data_folder.resolve()),
        data_fingerprint=capture_fingerprint(capture.scene, progress=progress),
        name=name,
        created=utc_now(),
        code=describe_code(),
        machine=describe_machine(device),
        threads=dict(threads) if threads is not None else describe_threads(),
    )
    return make_folder(runs_dir, run_id, record)


def execute(run: RunFolder, progress: Progress = silent, *, recipe: Recipe | None = None) -> RecipeResult:
    """Do the work of a queued run in this process and return its result.

    ``progress`` hears every event after it was written down, and cancels by raising. ``recipe`` serves recipes
    that are not registered.

    Raises
    ------
    RunError
        Where the run was started before, another process holds it, or its folder refuses writing.
    ToolkitError
        Whatever the recipe raises; the run is then ``failed`` or ``cancelled`` and can be resumed.
    """
    return _work(run, progress, recipe, allowed=("queued",))


def resume(run: RunFolder, progress: Progress = silent, *, recipe: Recipe | None = None) -> RecipeResult:
    """Go on with a run that did not finish, from its last checkpoint, and return its result.

    Raises
    ------
    RunError
        Where the run is finished, another process holds it, its recipe or settings no longer fit, or the
        pictures changed since it began.
    ToolkitError
        Whatever the recipe raises.
    """
    return _work(run, progress, recipe, allowed=("queued", "failed", "cancelled", "interrupted"))


def _work(run: RunFolder, progress: Progress, recipe: Recipe | None, *, allowed: tuple[State, ...]) -> RecipeResult:
    record = run.record()
    chosen, settings = _recipe_of(run, record, recipe)
    _check_device(record.device)
    with run.held():
        before = _status_of(run)
        _check_state(run, before, allowed)
        forget_request(run)
        with journal(run) as book:
            if before.state != "queued":
                where = f" in stage '{before.stage}' at {before.done}" if before.stage else ""
                book.log(f"resumed; it was {before.state}{where}" + (f": {before.error}" if before.error else ""))
            _log_changes(book, record)
            tell = fan_out([book, CancelRequests(run), progress])
            capture = _open_same(run, record, book, tell)
            context = RecipeContext(
                workspace=Workspace(run.path.parent / WORKSPACE),
                artifacts=run.artifacts,
                checkpoint=run.checkpoint,
                seed=record.seed,
                device=record.device,
                progress=tell,
            )
            data = RecipeInput(capture.scene, capture.reference, record.data_fingerprint, capture.video)
            result = chosen.run(data, settings, context)
            if capture.warnings:
                told = {"data": {"warnings": list(capture.warnings)}}
                result = dataclasses.replace(result, reports={**told, **result.reports})
            for value in write_result(result, capture.reference, run.artifacts):
                book.log(f"warning: {value} is not finite and is stored as null")
    return result


def _recipe_of(run: RunFolder, record: RunRecord, given: Recipe | None) -> tuple[Recipe, Settings]:
    """Return the run's recipe and its settings, frozen."""
    if given is None:
        from toolkit.recipes.registry import find_recipe

        given = find_recipe(record.recipe)
    elif given.name != record.recipe:
        raise RunError(f"Run {run.id} is of another recipe", expected=f"'{record.recipe}'", found=f"'{given.name}'")
    try:
        settings = given.settings_type.from_dict(record.settings)
    except SettingsError as error:
        raise RunError(
            f"The settings of run {run.id} do not fit this version of recipe '{record.recipe}'",
            found=str(error).rstrip("."),
            todo="Start a new run",
        ) from error
    added = [name for name, _ in settings.items() if name not in record.flat_settings]
    if added:
        raise RunError(
            f"The settings of run {run.id} do not fit this version of recipe '{record.recipe}'",
            found=f"settings that the run does not have: {', '.join(added)}",
            todo="Start a new run",
        )
    return given, settings.frozen()


def _status_of(run: RunFolder) -> RunStatus:
    """Return the run's status; one that cannot be read counts as that of an interrupted run."""
    try:
        return run.status()
    except DataError as error:
        return RunStatus("interrupted", error=str(error))


def _check_state(run: RunFolder, status: RunStatus, allowed: tuple[State, ...]) -> None:
    """Refuse a run that is not in a state to be worked on."""
    state = status.state
    if state == "running" and status.process is not None and status.process.life() == "alive":
        # The lock is ours: that process let go of the run without being able to say so, as on a full disk.
        state = "interrupted"
    if state in allowed:
        return
    todo = {
        "finished": "toolkit show prints its result; start a new run to compute it again",
        "running": "Wait until it ends",
    }.get(state, "Resume it")
    raise RunError(
        f"Run {run.id} cannot be started", expected=" or ".join(allowed), found=f"one that is {state}", todo=todo
    )


def _check_device(device: str) -> None:
    """Refuse a device that is unknown or missing."""
    if device not in ("cpu", "cuda"):
        raise CapabilityError(f"Unknown device '{device}'", expected="cpu or cuda")
    if device == "cuda":
        import torch

        if not torch.cuda.is_available():
            raise CapabilityError(
                "No CUDA device here", expected="a CUDA GPU that PyTorch can use", todo="Choose the device cpu"
            )


def _open_same(run: RunFolder, record: RunRecord, book: Journal, progress: Progress) -> Capture:
    """Return the capture, which must be the one that the run was made for."""
    # Its pictures were decoded when the run was created; the same fingerprint means the same pictures.
    capture = open_capture(Path(record.data), check=False)
    for warning in capture.warnings:
        book.log(f"warning: {warning}")
    require_same_data(run, record, capture_fingerprint(capture.scene, progress=progress))
    return capture


def require_same_data(run: RunFolder, record: RunRecord, fingerprint: str) -> None:
    """Raise :class:`RunError` where the data of a run have another fingerprint now."""
    if fingerprint != record.data_fingerprint:
        raise RunError(
            f"The data of run {run.id} changed since it was created",
            expected=f"{record.data} with fingerprint {record.data_fingerprint[:12]}",
            found=f"fingerprint {fingerprint[:12]}",
            todo="Put the pictures back, or start a new run",
        )


def _log_changes(book: Journal, record: RunRecord) -> None:
    """Warn in the log where code, libraries or threads are others than when the run was created."""
    now: dict[str, Any] = {
        "code version": describe_code(),
        "libraries": describe_machine("cpu")["libraries"],
        "threads": describe_threads(),
    }
    then = {
        "code version": record.code,
        "libraries": record.machine.get("libraries"),
        "threads": record.threads,
    }
    for what, value in now.items():
        if value != then[what]:
            book.log(
                f"warning: {what} changed since the run was created: results may differ "
                f"(then {then[what]}, now {value})"
            )
