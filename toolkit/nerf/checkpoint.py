"""A moment of a training in one safetensors file, replaced whole, with what is no tensor as JSON in its header."""

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

CHECKPOINT_FILE = "nerf.safetensors"
_FORMAT = 1


@dataclass(frozen=True, slots=True)
class NerfCheckpoint:
    """A training between two steps: its tensors by name, and all that is no tensor."""

    tensors: Mapping[str, Tensor]
    state: Mapping[str, Any]


def save_checkpoint(folder: Path, checkpoint: NerfCheckpoint) -> None:
    """Write a checkpoint in place of the one before. Raises :class:`RunError` where the disk refuses."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in checkpoint.tensors.items()}
    header = {"format": _FORMAT, "checksum": _checksum(tensors), "state": dict(checkpoint.state)}
    with atomic_path(folder / CHECKPOINT_FILE) as temporary:
        save_file(tensors, temporary, metadata={"checkpoint": json.dumps(header, allow_nan=False)})


def load_checkpoint(folder: Path) -> NerfCheckpoint | None:
    """Return the checkpoint of a folder, or None where there is none.

    Raises
    ------
    DataError
        Where it is damaged or not of this format.
    """
    path = folder / CHECKPOINT_FILE
    if not path.exists():
        return None
    todo = "Delete it to begin again"
    try:
        with safe_open(path, framework="pt") as handle:
            header = json.loads((handle.metadata() or {}).get("checkpoint", "null"))
            tensors = {name: handle.get_tensor(name).clone() for name in sorted(handle.keys())}
    except (OSError, SafetensorError, json.JSONDecodeError) as error:
        raise DataError(
            f"Checkpoint {path} is damaged", expected="a whole safetensors file", found=str(error), todo=todo
        ) from error
    if not isinstance(header, dict) or header.get("format") != _FORMAT:
        found = f"format {header.get('format')}" if isinstance(header, dict) else "another safetensors file"
        raise DataError(f"{path} is no checkpoint of this version", expected=f"format {_FORMAT}", found=found)
    if header["checksum"] != _checksum(tensors):
        raise DataError(
            f"Checkpoint {path} is damaged",
            expected=f"checksum {header['checksum']}",
            found=f"checksum {_checksum(tensors)}",
            todo=todo,
        )
    return NerfCheckpoint(tensors, header["state"])


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


def _checksum(tensors: Mapping[str, Tensor]) -> str:
    """Return a CRC-32 over names, shapes and bytes: finds damage, not intent."""
    total = 0
    for name in sorted(tensors):
        tensor = tensors[name]
        total = zlib.crc32(f"{name}{tensor.dtype}{tuple(tensor.shape)}".encode(), total)
        total = zlib.crc32(tensor.numpy().reshape(-1).view("uint8").data, total)
    return f"{total:08x}"
