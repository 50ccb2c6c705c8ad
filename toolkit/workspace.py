"""Where stages keep their outputs: one folder for each (stage, input, settings, code), whole or absent."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from filelock import FileLock

from toolkit.errors import RunError
from toolkit.files import disk_errors, read_json, write_json

_RECORD = "stage.json"


def fingerprint(value: Any) -> str:
    """Return the SHA-256 (hexadecimal) of a JSON-able value, independent of the order of keys."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def file_fingerprint(path: Path) -> str:
    """Return the SHA-256 (hexadecimal) of a file's content."""
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def code_version(*modules: ModuleType) -> str:
    """Return a hash of the source files of ``modules``; a package counts with every file in it."""
    sources = []
    for module in modules:
        file_name = getattr(module, "__file__", None)
        if file_name is None:
            raise ValueError(f"{module.__name__} has no source file")
        sources.append(Path(file_name))
    return source_version(*sources)


def source_version(*sources: Path) -> str:
    """Return a hash of source files; an ``__init__.py`` counts with every file of its package."""
    digest = hashlib.sha256()
    for source in sources:
        files = sorted(source.parent.rglob("*.py")) if source.name == "__init__.py" else [source]
        for file in files:
            digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class StageOutput:
    """The kept output of a stage.

    Attributes
    ----------
    folder:
        Where its files are. Read them, do not change them.
    key:
        Hash of stage name, input, settings and code.
    seconds:
        Wall time it took when it was built.
    reused:
        True when it was found and not built now.
    """

    folder: Path
    key: str
    seconds: float
    reused: bool


class Workspace:
    """Keeps outputs of stages under ``root``.

    A stage builds into a temporary folder that is renamed when it is complete, so a killed or failed stage
    leaves nothing that a later one would read. Two processes that want the same output wait for each other.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    def stage(
        self, name: str, *, inputs: Any, settings: Any, code: str, build: Callable[[Path], None]
    ) -> StageOutput:
        """Return the output of a stage, calling ``build(folder)`` only where it is not there yet.

        Parameters
        ----------
        name:
            Short name of the stage, used in the folder's name.
        inputs, settings:
            JSON-able description of what goes in (fingerprints of files, keys of earlier stages) and of the
            settings.
        code:
            Version of the code, from :func:`code_version`.
        build:
            Writes the output into the folder that it is given.

        Raises
        ------
        RunError
            When the disk is full or may not be written, or something else lies where the output belongs.
        """
        key = fingerprint({"stage": name, "inputs": inputs, "settings": settings, "code": code})[:20]
        folder = self.root / f"{name}-{key}"
        lock = FileLock(self.root / f".{name}-{key}.lock")
        with disk_errors(self.root, "preparing"):
            self.root.mkdir(parents=True, exist_ok=True)
            lock.acquire()
        try:
            if folder.exists():
                return StageOutput(folder, key, _recorded_seconds(folder), reused=True)
            temporary = self.root / f".{name}-{key}.{uuid.uuid4().hex[:8]}.tmp"
            try:
                with disk_errors(self.root, "writing stage output below"):
                    temporary.mkdir()
                    start = time.perf_counter()
                    build(temporary)
                    seconds = time.perf_counter() - start
                    record = {"stage": name, "inputs": inputs, "settings": settings, "code": code}
                    write_json(temporary / _RECORD, {**record, "seconds": seconds})
                    temporary.rename(folder)
            finally:
                if temporary.exists():
                    shutil.rmtree(temporary)
        finally:
            lock.release()
        return StageOutput(folder, key, seconds, reused=False)

    def remove_leftovers(self) -> int:
        """Delete temporary folders that killed processes left behind and return their number.

        Call it only while no other process builds in this workspace.
        """
        leftovers = [path for path in self.root.glob(".*.tmp") if path.is_dir()]
        for path in leftovers:
            shutil.rmtree(path)
        return len(leftovers)


def _recorded_seconds(folder: Path) -> float:
    """Return how long the output in ``folder`` took to build, or raise where it is no output."""
    record = read_json(folder / _RECORD) if (folder / _RECORD).is_file() else None
    seconds = record.get("seconds") if isinstance(record, dict) else None
    if not isinstance(seconds, float):
        raise RunError(
            f"{folder} is no stage output of ours",
            expected=f"a {_RECORD} that a finished stage wrote",
            todo="Move the folder away",
        )
    return seconds
