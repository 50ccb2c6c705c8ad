"""How long a run will take, judged by finished runs of the same recipe."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from toolkit.errors import DataError, RunError
from toolkit.files import read_json
from toolkit.recipes.base import StageTime
from toolkit.runs.folder import RunFolder
from toolkit.runs.index import run_folders
from toolkit.runs.measures import format_seconds
from toolkit.runs.names import recipe_of_id
from toolkit.scene.folder import SCENE_FILE
from toolkit.settings import Settings

#: The setting that the time of stage ``train`` grows with.
STEPS: Final = "train.steps"
_MOST_RUNS = 20
_MOST_NAMED = 4


@dataclass(frozen=True, slots=True)
class Estimate:
    """A guess and what it rests on.

    Attributes
    ----------
    seconds:
        Wall time of all stages, None where there is nothing to judge from.
    basis:
        A sentence or two for a person.
    run_id:
        The run that was scaled, empty where there is none.
    """

    seconds: float | None
    basis: str
    run_id: str = ""


@dataclass(frozen=True, slots=True)
class _Done:
    run: RunFolder
    label: str
    device: str
    data: str
    settings: dict[str, Any]
    times: tuple[StageTime, ...]
    photos: int

    @property
    def seconds(self) -> float:
        return sum(time.seconds for time in self.times)


class Estimator:
    """Reads finished runs once, and judges by them.

    Parameters
    ----------
    runs_dir:
        Folder of the runs; the newest 20 finished ones of a recipe are looked at.
    """

    def __init__(self, runs_dir: Path) -> None:
        self._runs_dir = runs_dir
        self._read: dict[str, tuple[int, _Done | None]] = {}

    def estimate(
        self, recipe: str, settings: Settings, *, photos: int, data: str = "", device: str = "cpu"
    ) -> Estimate:
        """Return how long a run with these settings would take.

        The finished run with the fewest other settings is taken, of several the one with the nearest number of
        photos, of several the newest. Its stage ``train`` is scaled by the number of steps, kernels compile as long
        as they did, and every other stage is scaled by the number of photos: matching all pairs grows faster than
        that, so the guess is low for many more photos.

        Parameters
        ----------
        recipe, settings:
            What would run.
        photos:
            How many there are.
        data:
            Folder of the capture; where the run that is taken had the same, stages may be found done.
        device:
            Runs on others do not count.

        Raises
        ------
        RunError
            Where the runs may not be listed.
        """
        wanted = dict(settings.items())
        known = [done for done in self._finished(recipe) if done.device == device]
        if not known:
            return Estimate(None, f"There is no finished run of {recipe} on {device} here to judge from.")
        nearest = min(known, key=lambda done: (len(_others(wanted, done)), abs(done.photos - photos)))
        of_steps = wanted[STEPS] / nearest.settings[STEPS] if STEPS in wanted and STEPS in nearest.settings else 1.0
        of_photos = photos / nearest.photos if photos > 0 else 1.0
        scale = {"train": of_steps, "compile": 1.0}
        seconds = sum(time.seconds * scale.get(time.name, of_photos) for time in nearest.times)
        basis = _basis(nearest, wanted, photos, known=len(known), same_data=bool(data) and data == nearest.data)
        return Estimate(seconds, basis, nearest.run.id)

    def _finished(self, recipe: str) -> list[_Done]:
        """Return the newest finished runs of a recipe, the newest first; what is damaged is passed over."""
        found: list[_Done] = []
        for run in reversed(run_folders(self._runs_dir)):
            if recipe_of_id(run.id) != recipe:
                continue
            done = self._done(run)
            if done is not None:
                found.append(done)
            if len(found) == _MOST_RUNS:
                break
        return found

    def _done(self, run: RunFolder) -> _Done | None:
        try:
            written = run.result_file.stat().st_mtime_ns
        except OSError:
            return None
        if run.id not in self._read or self._read[run.id][0] != written:
            self._read[run.id] = written, _read(run)
        return self._read[run.id][1]


def _read(run: RunFolder) -> _Done | None:
    try:
        record, result = run.record(), run.result()
        photos = len(read_json(run.scene_folder / SCENE_FILE)["frames"])
    except (DataError, RunError, KeyError, TypeError):
        return None
    if not result.times or not photos or record.flat_settings.get(STEPS) == 0:
        return None
    label, settings = record.name or run.id, record.flat_settings
    return _Done(run, label, record.device, record.data, settings, result.times, photos)


def _others(wanted: dict[str, Any], done: _Done) -> list[str]:
    """Return the settings that differ, but for the number of steps."""
    names = dict.fromkeys([*wanted, *done.settings])
    return [name for name in names if name != STEPS and wanted.get(name) != done.settings.get(name)]


def _basis(nearest: _Done, wanted: dict[str, Any], photos: int, *, known: int, same_data: bool) -> str:
    before, now = nearest.settings.get(STEPS), wanted.get(STEPS)
    trained = f" and {before} steps" if before is not None else ""
    of = f", the nearest of {known} finished ones" if known > 1 else ""
    said = [
        f"From run {nearest.label}{of}: {format_seconds(nearest.seconds)} with {nearest.photos} photos{trained}."
    ]
    scaled = []
    if before is not None and now is not None and now != before:
        scaled.append(f"training by steps ({before} to {now})")
    if photos not in (0, nearest.photos):
        scaled.append(f"the other stages by photos ({nearest.photos} to {photos})")
    if scaled:
        said.append(f"Scaled: {', '.join(scaled)}.")
    others = _others(wanted, nearest)
    if others:
        more = f" and {len(others) - _MOST_NAMED} more" if len(others) > _MOST_NAMED else ""
        said.append(f"It had other settings, which is not counted: {', '.join(others[:_MOST_NAMED])}{more}.")
    if same_data:
        said.append("Stages that it left in the workspace take no time again.")
    return " ".join(said)
