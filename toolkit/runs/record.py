"""run.json: everything that a run is made from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from toolkit.errors import DataError

#: Version of the layout of the whole run folder.
SCHEMA = 1


@dataclass(frozen=True, slots=True)
class RunRecord:
    """run.json: everything that a run is made from. Written once, never changed.

    Attributes
    ----------
    recipe, settings, seed, device:
        What runs; the settings are complete, defaults included.
    data, data_fingerprint:
        Folder of the capture, and the hash of its pictures and priors.
    name:
        What the user called the run, empty where not.
    created:
        ISO 8601 in UTC.
    code, machine, threads:
        From :mod:`toolkit.runs.machine`.
    schema:
        Version of this layout.
    """

    recipe: str
    settings: dict[str, Any]
    seed: int
    device: str
    data: str
    data_fingerprint: str
    name: str
    created: str
    code: dict[str, Any]
    machine: dict[str, Any]
    threads: dict[str, Any]
    schema: int = SCHEMA

    def to_dict(self) -> dict[str, Any]:
        """Return the record ready for JSON."""
        return asdict(self)

    @property
    def flat_settings(self) -> dict[str, Any]:
        """The settings under dotted names."""
        return _flatten(self.settings, "")

    @classmethod
    def from_dict(cls, content: Any, path: Path) -> RunRecord:
        """Return the record in the JSON of ``path``.

        Raises
        ------
        DataError
            For a missing field, one of the wrong type, or another version of the layout.
        """
        if not isinstance(content, Mapping):
            raise DataError(f"{path} is no record of a run", expected="an object", found=type(content).__name__)
        if content.get("schema") != SCHEMA:
            raise DataError(
                f"{path} has a layout that this version cannot read",
                expected=f"schema {SCHEMA}",
                found=repr(content.get("schema")),
                todo="Read it with the version of the toolkit that wrote it",
            )
        tables, numbers = {"settings", "code", "machine", "threads"}, {"schema", "seed"}
        for name in cls.__dataclass_fields__:
            kind = dict if name in tables else int if name in numbers else str
            if not isinstance(content.get(name), kind):
                raise DataError(
                    f"{path} is no record of a run",
                    expected=f"'{name}' as {kind.__name__}",
                    found=repr(content.get(name, "nothing")),
                )
        return cls(**{name: content[name] for name in cls.__dataclass_fields__})


def _flatten(values: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= _flatten(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {prefix + name: value}
    return flat
