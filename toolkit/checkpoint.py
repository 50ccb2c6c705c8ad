"""Checkpoints: one safetensors file for each, whole or absent, with the run's state as JSON in its header.

A folder holds the last two, ``step-00000500.safetensors`` by the step. A new one is written under another name,
flushed and renamed before an older one goes: a killed run leaves at least the one before.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from toolkit.errors import DataError, RunError
from toolkit.files import atomic_path

FORMAT = 1
KEPT = 2
_NAME = "step-{:08d}.safetensors"
_PATTERN = "step-*.safetensors"


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A moment of a run.

    Attributes
    ----------
    step:
        Steps that were done.
    tensors:
        Every tensor of the run by its name.
    state:
        All that is no tensor, JSON-able.
    """

    step: int
    tensors: Mapping[str, Tensor]
    state: Mapping[str, Any]


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> Path:
    """Write a checkpoint beside the one before, and remove older ones. Returns its path.

    Raises
    ------
    RunError
        When the disk is full or the folder may not be written; what was there stays.
    """
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in checkpoint.tensors.items()}
    header = {
        "format": FORMAT,
        "step": checkpoint.step,
        "checksum": _checksum(tensors),
        "state": dict(checkpoint.state),
    }
    path = folder / _NAME.format(checkpoint.step)
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, metadata={"checkpoint": json.dumps(header, allow_nan=False)})
    for leftover in folder.glob(".step-*.tmp.safetensors"):
        leftover.unlink(missing_ok=True)
    for old in _newest_first(folder)[KEPT:]:
        old.unlink(missing_ok=True)
    return path


def load_checkpoint(path: Path) -> Checkpoint:
    """Return the checkpoint in a file.

    Raises
    ------
    DataError
        When the file is missing, truncated, changed or not a checkpoint of this format.
    """
    try:
        with safe_open(path, framework="pt") as handle:
            header = json.loads((handle.metadata() or {}).get("checkpoint", "null"))
            # Copies: the file is mapped into memory and may be replaced.
            tensors = {name: handle.get_tensor(name).clone() for name in sorted(handle.keys())}
    except FileNotFoundError as error:
        raise DataError(f"Checkpoint {path} is missing") from error
    except (OSError, SafetensorError, json.JSONDecodeError) as error:
        raise DataError(
            f"Checkpoint {path} is damaged",
            expected="a whole safetensors file",
            found=str(error),
            todo="Delete this file; the run then goes on from an older one, or from the start",
        ) from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        found = f"format {header.get('format')}" if isinstance(header, dict) else "another safetensors file"
        raise DataError(f"{path} is no checkpoint of this version", expected=f"format {FORMAT}", found=found)
    if header["checksum"] != _checksum(tensors):
        raise DataError(
            f"Checkpoint {path} is damaged",
            expected=f"checksum {header['checksum']}",
            found=f"checksum {_checksum(tensors)}",
            todo="Delete this file; the run then goes on from an older one, or from the start",
        )
    return Checkpoint(int(header["step"]), tensors, header["state"])


def load_newest(folder: Path) -> tuple[Checkpoint | None, tuple[str, ...]]:
    """Return the newest whole checkpoint of a folder, and what is wrong with newer ones.

    Returns
    -------
    checkpoint, notes:
        None and no notes where the folder has none.

    Raises
    ------
    DataError
        Where there are checkpoints, and all are damaged.
    """
    notes: list[str] = []
    for path in _newest_first(folder):
        try:
            checkpoint = load_checkpoint(path)
        except DataError as error:
            notes.append(str(error))
        else:
            return checkpoint, tuple(notes)
    if notes:
        raise DataError(
            f"No checkpoint in {folder} can be read",
            found=" ".join(notes),
            todo="Delete the folder to start from the beginning",
        )
    return None, ()


def require_same(saved: Mapping[str, Any], wanted: Mapping[str, Any], folder: Path) -> None:
    """Refuse to go on with a run that was another.

    Parameters
    ----------
    saved, wanted:
        Nested tables: what a checkpoint was made with, and what is asked now.
    folder:
        Of the checkpoint, for the message.

    Raises
    ------
    RunError
        Where they differ; the message names what, with both values.
    """
    before, now = _flat(saved), _flat(wanted)
    names = [name for name in dict.fromkeys([*before, *now]) if before.get(name) != now.get(name)]
    if names:
        raise RunError(
            f"The checkpoint in {folder} belongs to another run",
            expected=", ".join(f"{name} = {now.get(name)}" for name in names),
            found=", ".join(f"{name} = {before.get(name)}" for name in names),
            todo="Resume with what it was started with, or choose another folder",
        )


def _flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in table.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


def _newest_first(folder: Path) -> list[Path]:
    return sorted(folder.glob(_PATTERN), reverse=True)


def _checksum(tensors: Mapping[str, Tensor]) -> str:
    """Return a CRC-32 over names, shapes and bytes: finds damage, not intent."""
    total = 0
    for name in sorted(tensors):
        tensor = tensors[name]
        total = zlib.crc32(f"{name}{tensor.dtype}{tuple(tensor.shape)}".encode(), total)
        total = zlib.crc32(tensor.numpy().reshape(-1).view("uint8").data, total)
    return f"{total:08x}"
