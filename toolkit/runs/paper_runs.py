"""Runs of a paper's table: each method on each data set in a run folder of its own, finished ones taken again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from toolkit.errors import Cancelled, DataError, ToolkitError, WeightsMissingError
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.recipes.base import Recipe, RecipeResult
from toolkit.runs.folder import RunFolder
from toolkit.runs.index import run_folders, summarise
from toolkit.runs.launch import create_run, execute, resume
from toolkit.runs.paper_rows import PaperRow
from toolkit.scene.dataset import capture_fingerprint, open_capture
from toolkit.settings import Settings

_Identity = tuple[str, dict[str, Any], int, str, str]
Outcome = Literal["finished", "failed", "not applicable", "weights missing", "not there"]

#: What a method may raise where data or machine are too much for it. Errors of programming (TypeError,
#: AttributeError, ...) end the table.
_FAILURES = (ToolkitError, RuntimeError, ValueError, ArithmeticError, MemoryError, OSError)


@dataclass(frozen=True, slots=True)
class TableOptions:
    """How the runs of a table are made.

    Attributes
    ----------
    runs_dir:
        Where they lie.
    changes:
        Settings by dotted names, for every recipe that has them: ``{"train.steps": 300}``.
    seed, device:
        Of every run. On ``"cuda"`` splats are trained with the cuda backend.
    force:
        Whether finished runs are made again.
    """

    runs_dir: Path
    changes: Mapping[str, Any]
    seed: int = 0
    device: str = "cpu"
    force: bool = False


@dataclass(frozen=True, slots=True)
class Attempt:
    """A method on a data set.

    Attributes
    ----------
    row, data:
        The method and the name of the data set.
    outcome:
        How it ended.
    reason:
        The first line of why, empty where it finished.
    run:
        The run's folder, None where there is none.
    """

    row: PaperRow
    data: str
    outcome: Outcome
    reason: str = ""
    run: RunFolder | None = None

    @property
    def text(self) -> str:
        """The outcome with its reason."""
        if self.reason.lower().startswith(self.outcome):  # "weights missing: Weights missing: ..." says it twice
            return self.reason[0].lower() + self.reason[1:]
        return f"{self.outcome}: {self.reason}" if self.reason else self.outcome

    @property
    def brief(self) -> str:
        """The same without what was expected and found, for a narrow cell."""
        return self.text.split("; ")[0]


def make_attempts(
    rows: Sequence[PaperRow],
    data: Mapping[str, Path],
    recipes: Mapping[str, Recipe],
    options: TableOptions,
    *,
    progress: Progress = silent,
) -> list[Attempt]:
    """Run every method on every data set, one after the other, and return how each ended.

    A finished run with the same recipe, settings, seed, device and pictures is taken as it is; one that was
    stopped goes on; one that failed is tried again from where it was. What fails is recorded and the next one is
    run.

    Parameters
    ----------
    rows:
        The methods.
    data:
        Folders that :func:`toolkit.scene.dataset.open_capture` reads, by the name in the table.
    recipes:
        Those that there are.
    options:
        How runs are made.

    Raises
    ------
    Cancelled
        Where ``progress`` says so.
    DataError
        Where a data folder cannot be opened.
    """
    opened = [_open(name, folder, progress) for name, folder in data.items()]
    identities = _Identities()
    attempts: list[Attempt] = []
    total = len(rows) * len(data)
    for each in opened:
        for row in rows:
            progress(ProgressEvent("table", len(attempts), total, f"{row.title}, {each.name}"))
            attempts.append(_attempt(row, each, recipes.get(row.recipe), options, identities, progress))
    progress(ProgressEvent("table", total, total))
    return attempts


def _attempt(
    row: PaperRow,
    data: _Data,
    recipe: Recipe | None,
    options: TableOptions,
    identities: _Identities,
    progress: Progress,
) -> Attempt:
    name = data.name
    if recipe is None:
        return Attempt(row, name, "not there", f"no recipe '{row.recipe}'")
    missing = [what for what in row.needs.split(" and ") if what and what not in data.has]
    if missing:
        return Attempt(row, name, "not applicable", f"the data have no {' and no '.join(missing)}")
    run: RunFolder | None = None
    try:
        settings = row_settings(row, recipe, options)
        run, work = _work(row, recipe, settings, data, options, identities, progress)
        if work is not None:
            work(run, progress, recipe=recipe)
    except Cancelled:
        raise
    except WeightsMissingError as error:
        return Attempt(row, name, "weights missing", first_line(error), run)
    except _FAILURES as error:
        return Attempt(row, name, "failed", first_line(error), run)
    return Attempt(row, name, "finished", run=run)


def row_settings(row: PaperRow, recipe: Recipe, options: TableOptions) -> Settings:
    """Return the settings of a method: the recipe's, with the row's and the table's changes.

    Raises
    ------
    SettingsError
        For a change of the row's that the recipe does not have, and for values out of range.
    """
    plain = recipe.settings_type()
    values = dict(plain.items())
    changes: dict[str, Any] = {**row.changes}
    changes |= {name: value for name, value in options.changes.items() if name in values}
    if options.device == "cuda" and "train.backend" in values:
        changes["train.backend"] = "cuda"
    return plain.replace(changes)


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, with the type of one that is none of ours."""
    lines = str(error).strip().splitlines()
    line = lines[0] if lines else "no message"
    return line if isinstance(error, ToolkitError) else f"{type(error).__name__}: {line}"


@dataclass(frozen=True, slots=True)
class _Data:
    """A data set: what it has beside pictures (gps, gimbal, video), and the hash of its pictures and priors."""

    name: str
    folder: Path
    has: frozenset[str]
    fingerprint: str


def _open(name: str, folder: Path, progress: Progress) -> _Data:
    capture = open_capture(folder, check=False)
    scene = capture.scene
    priors = [frame.prior for frame in scene.frames if frame.prior is not None]
    there = {
        "gps": any(prior.position is not None for prior in priors),
        "gimbal": any(prior.rotation is not None for prior in priors),
        "video": capture.video is not None,
    }
    has = frozenset(what for what, given in there.items() if given)
    return _Data(name, folder, has, capture_fingerprint(scene, progress=progress))


def _work(
    row: PaperRow,
    recipe: Recipe,
    settings: Settings,
    data: _Data,
    options: TableOptions,
    identities: _Identities,
    progress: Progress,
) -> tuple[RunFolder, Callable[..., RecipeResult] | None]:
    """Return a run and what is left to do with it: nothing for a finished one."""
    if not options.force:
        wanted = (recipe.name, settings.to_dict(), options.seed, options.device, data.fingerprint)
        same = [run for run in run_folders(options.runs_dir) if identities.of(run) == wanted]
        by_state = {_state(run): run for run in same}  # of several the newest
        if "finished" in by_state:
            return by_state["finished"], None
        for state in ("interrupted", "cancelled", "failed", "queued"):
            if state in by_state:
                return by_state[state], resume
    made = create_run(
        recipe,
        data.folder,
        settings,
        options.runs_dir,
        seed=options.seed,
        device=options.device,
        name=f"{row.key} {data.name}",
        progress=progress,
    )
    return made, execute


class _Identities:
    """What makes two runs the same. Each record is read once: it never changes, and a table asks at every cell."""

    def __init__(self) -> None:
        self._known: dict[RunFolder, _Identity | None] = {}

    def of(self, run: RunFolder) -> _Identity | None:
        """Return recipe, settings, seed, device and data of a run, None for a damaged one."""
        if run not in self._known:
            try:
                record = run.record()
            except DataError:
                self._known[run] = None
            else:
                data = record.data_fingerprint
                self._known[run] = record.recipe, record.settings, record.seed, record.device, data
        return self._known[run]


def _state(run: RunFolder) -> str:
    return summarise(run).state
