"""What a sweep is made from, and what its trials are: the contents of its JSON files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

from toolkit.errors import DataError
from toolkit.runs.names import is_run_id
from toolkit.runs.sweep_space import Dimension, Method, Value

Direction = Literal["maximise", "minimise"]
#: Version of the layout of the whole folder.
SCHEMA = 1


@dataclass(frozen=True, slots=True)
class SweepPlan:
    """sweep.json: everything that a sweep is made from. Written once, never changed.

    Attributes
    ----------
    recipe, data, settings, seed, device:
        What runs; the settings are complete and hold for whatever the space does not change. The seed is that of
        every run, and of the choice of values.
    method, space, trials:
        How values are chosen, of which settings, and how often.
    objective, direction:
        Measure of a finished run, and which way it is better.
    prune:
        Curve by which trials are stopped early, as ``stage/name``; empty: none is.
    workers, threads:
        Runs at a time on this machine (0 on a cluster: as many as it has), and threads of each.
    cluster:
        Address of a Dask scheduler; empty: processes on this machine.
    most_hands:
        How often a run is handed out in all, where workers die.
    name:
        What the user called the sweep, empty where not.
    created:
        ISO 8601 in UTC.
    schema:
        Version of this layout.
    """

    recipe: str
    data: str
    settings: dict[str, Any]
    method: Method
    space: tuple[Dimension, ...]
    trials: int
    objective: str
    direction: Direction
    prune: str
    seed: int
    device: str
    workers: int
    threads: int
    cluster: str
    most_hands: int
    name: str
    created: str
    schema: int = SCHEMA

    def to_dict(self) -> dict[str, Any]:
        """Return the plan ready for JSON."""
        return {**asdict(self), "space": [dimension.to_dict() for dimension in self.space]}

    @classmethod
    def from_dict(cls, content: Any, path: Path) -> SweepPlan:
        """Return the plan in the JSON of ``path``. Raises :class:`DataError` where it is none."""
        try:
            fields = {name: content[name] for name in cls.__dataclass_fields__}
            fields["space"] = tuple(Dimension.from_dict(item) for item in content["space"])
            for name in ("trials", "seed", "workers", "threads", "most_hands"):
                fields[name] = int(content[name])
            if fields["schema"] != SCHEMA:
                raise ValueError(f"schema {fields['schema']}")
            if fields["method"] not in get_args(Method) or fields["direction"] not in get_args(Direction):
                raise ValueError(f"{fields['method']}, {fields['direction']}")
            if not isinstance(fields["settings"], dict) or not isinstance(fields["data"], str):
                raise ValueError("settings and data")
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(
                f"{path} is no plan of a sweep",
                expected=f"the fields of SweepPlan, schema {SCHEMA}",
                found=repr(error),
            ) from error
        return cls(**fields)


@dataclass(frozen=True, slots=True)
class Trial:
    """trials/<number>.json: which values were tried in which run.

    Attributes
    ----------
    number:
        From 0 on.
    values:
        By the dotted names of the settings.
    run:
        Id of the run.
    handed:
        How often it was handed out to a worker.
    pruned:
        Why it was stopped early; empty where it was not.
    """

    number: int
    values: dict[str, Value]
    run: str
    handed: int = 0
    pruned: str = ""

    @classmethod
    def from_dict(cls, content: Any, path: Path) -> Trial:
        """Return the trial in the JSON of ``path``. Raises :class:`DataError` where it is none."""
        try:
            made = cls(
                int(content["number"]),
                dict(content["values"]),
                str(content["run"]),
                int(content["handed"]),
                str(content["pruned"]),
            )
            if not is_run_id(made.run):
                raise ValueError(f"run {made.run!r}")
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(
                f"{path} is no trial of a sweep", expected="the fields of Trial", found=repr(error)
            ) from error
        return made


def handed_again(trial: Trial) -> Trial:
    """Return the trial as it is when it was handed out once more."""
    return replace(trial, handed=trial.handed + 1, pruned="")


def flat_values(values: Mapping[str, Value]) -> str:
    """Return values as one line for logs and lists."""
    shown = (
        f"{name}={value:.4g}" if isinstance(value, float) else f"{name}={value}" for name, value in values.items()
    )
    return ", ".join(shown)
