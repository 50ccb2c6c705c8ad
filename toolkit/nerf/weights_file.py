"""A trained field in one safetensors file, and the start of a training from it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from toolkit.errors import DataError, SettingsError
from toolkit.files import atomic_path
from toolkit.nerf.field import RadianceField
from toolkit.nerf.settings import NerfSettings
from toolkit.nerf.space import Space

FIELD_FILE = "field.safetensors"
_FORMAT = 1
_OCCUPANCY = "occupancy."


def save_field(path: Path, field: RadianceField) -> None:
    """Write a field with its settings and its space. Raises :class:`RunError` where the disk refuses."""
    tensors = dict(field.tensors())
    tensors |= {f"{_OCCUPANCY}{name}": tensor for name, tensor in field.occupancy_tensors().items()}
    header = {"format": _FORMAT, "settings": field.settings.to_dict(), "space": field.space.to_dict()}
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with atomic_path(path) as temporary:
        save_file(contiguous, temporary, metadata={"field": json.dumps(header, allow_nan=False)})


def load_field(path: Path) -> RadianceField:
    """Return the field in a file, or in a folder's ``field.safetensors``.

    Raises
    ------
    DataError
        Where it is missing, damaged, or no field.
    """
    file, header, tensors = _read(path)
    try:
        settings, space = NerfSettings.from_dict(header["settings"]), Space.from_dict(header["space"])
    except (KeyError, TypeError, ValueError, SettingsError) as error:
        raise DataError(f"{file} is no field of this version", found=str(error)) from error
    field = RadianceField(settings, space, torch.Generator())
    set_tensors(field, _learned(tensors), file)
    field.set_occupancy({n.removeprefix(_OCCUPANCY): t for n, t in tensors.items() if n.startswith(_OCCUPANCY)})
    return field


def warm_start(field: RadianceField, path: Path) -> None:
    """Give a field the weights of another run. Both must lie in one world: the box comes with the weights.

    Parameters
    ----------
    field:
        Changed in place, its space included.
    path:
        A file, a folder with ``field.safetensors``, or the folder of a run.

    Raises
    ------
    DataError
        Where the file is missing, damaged or no field; where names or shapes of its tensors are others, which the
        message names; where its box has nothing in common with that of the field.
    """
    file, header, tensors = _read(path)
    try:
        space = Space.from_dict(header["space"])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{file} is no field of this version", found=str(error)) from error
    own = field.space
    if any(a_high < b_low or b_high < a_low for a_low, a_high, b_low, b_high in zip(
        own.low, own.high, space.low, space.high, strict=True
    )):  # fmt: skip
        raise DataError(
            f"The weights in {file} belong to another world",
            expected=f"a box that meets the one from {_text(own.low)} to {_text(own.high)}",
            found=f"one from {_text(space.low)} to {_text(space.high)}",
            todo="Start from a run whose poses have the same origin and scale",
        )
    if space.contracted != own.contracted:
        raise DataError(
            f"The weights in {file} do not fit",
            expected=f"space {'contracted' if own.contracted else 'box'}",
            found=f"space {'contracted' if space.contracted else 'box'}",
            todo="Train with the space of that run",
        )
    set_tensors(field, _learned(tensors), file)
    field.space = space


def set_tensors(field: RadianceField, tensors: dict[str, Tensor], source: Path) -> None:
    """Set all numbers of a field.

    Raises
    ------
    DataError
        Where names or shapes are not the field's.
    """
    own = {name: tuple(tensor.shape) for name, tensor in field.tensors().items()}
    given = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    wrong = [name for name in {**own, **given} if own.get(name) != given.get(name)]
    if wrong:
        shown, more = wrong[:6], len(wrong) - 6
        raise DataError(
            f"The weights in {source} do not fit the network"
            + (f" ({more} more tensors differ)" if more > 0 else ""),
            expected=", ".join(f"{name} {own.get(name, 'absent')}" for name in shown),
            found=", ".join(f"{name} {given.get(name, 'absent')}" for name in shown),
            todo="Take the settings field, hash_grid and fine_samples of the run that the weights are from",
        )
    with torch.no_grad():
        for name, tensor in field.tensors().items():
            tensor.copy_(tensors[name])


def _read(path: Path) -> tuple[Path, dict[str, Any], dict[str, Tensor]]:
    places = [path / FIELD_FILE, path / "artifacts" / FIELD_FILE] if path.is_dir() else [path]
    file = next((place for place in places if place.is_file()), places[0])
    try:
        with safe_open(file, framework="pt") as handle:
            header = json.loads((handle.metadata() or {}).get("field", "null"))
            tensors = {name: handle.get_tensor(name).clone() for name in sorted(handle.keys())}
    except FileNotFoundError as error:
        raise DataError(
            f"There are no weights in {path}", expected=f"{FIELD_FILE} of another run", found="no such file"
        ) from error
    except (OSError, SafetensorError, json.JSONDecodeError) as error:
        raise DataError(f"{file} is damaged", expected="a whole safetensors file", found=str(error)) from error
    if not isinstance(header, dict) or header.get("format") != _FORMAT:
        found = f"format {header.get('format')}" if isinstance(header, dict) else "another safetensors file"
        raise DataError(f"{file} is no radiance field", expected=f"format {_FORMAT}", found=found)
    return file, header, tensors


def _learned(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor for name, tensor in tensors.items() if not name.startswith(_OCCUPANCY)}


def _text(corner: tuple[float, float, float]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in corner) + ")"
