"""Finding and reading a network's weights. No code that a file names is run."""

from __future__ import annotations

import json
import pickle
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from toolkit.errors import CapabilityError, DataError, WeightsMissingError
from toolkit.optional import require

_HUB_NAME = re.compile(r"[\w-][\w.-]*/[\w-][\w.-]*")
# Last parts of names of tensors that only training uses: what DINOv2 and CroCo put in place of hidden patches.
_UNUSED = frozenset({"mask_token"})
_LOADING = (
    OSError,
    ValueError,
    RuntimeError,
    KeyError,
    TypeError,
    AttributeError,
    EOFError,
    pickle.UnpicklingError,
)


def find_weights(weights: str, default: str, *, download: bool, files: Sequence[str]) -> Path:
    """Return the file or folder with a network's weights.

    Parameters
    ----------
    weights:
        A file, a folder, or a name on the Hugging Face hub; empty: ``default``.
    default:
        A name on the hub.
    download:
        Fetch what is missing from the hub. Never done unasked.
    files:
        What a folder may hold weights as, one of which is needed.

    Raises
    ------
    WeightsMissingError
        Where there are none.
    MissingDependencyError
        Where a name on the hub is given and ``huggingface_hub`` is missing.
    """
    wanted = weights or default
    place = Path(wanted)
    if place.is_file():
        return place
    if not place.is_dir():
        if weights and not _HUB_NAME.fullmatch(weights):
            raise WeightsMissingError(
                f"Weights missing: there is no file or folder '{weights}'",
                expected="a path, or a name on the hub (owner/model)",
                todo=_download_command(default),
            )
        place = _from_hub(wanted, download)
    if not any((place / name).is_file() for name in files):
        raise WeightsMissingError(
            f"Weights missing: {place} holds none",
            expected=" or ".join(files),
            todo=_download_command(default),
        )
    return place


def _from_hub(name: str, download: bool) -> Path:
    hub = require("huggingface_hub")
    try:
        # Safetensors and settings only: nothing that could run code is fetched.
        found = hub.snapshot_download(
            name, allow_patterns=["config.json", "*.safetensors"], local_files_only=not download
        )
    except (OSError, ValueError, RuntimeError, KeyError, TypeError) as error:
        where = (
            "the Hugging Face hub and its cache" if download else "the Hugging Face cache (no download was asked)"
        )
        raise WeightsMissingError(
            f"Weights missing: no '{name}'",
            expected=f"a path, or the network in {where}",
            found=" ".join(str(error).split())[:300],
            todo=_download_command(name) + ", set download, or set weights to a path",
        ) from error
    return Path(found)


def _download_command(name: str) -> str:
    return f"Run: hf download {name}"


def read_state(path: Path, files: Sequence[str]) -> dict[str, Any]:
    """Return the tensors of a weights file, or of the first of ``files`` in a folder. No code in it is run.

    Raises
    ------
    DataError
        Where the file is damaged, or holds anything but tensors.
    """
    import torch
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    file = path if path.is_file() else next(path / name for name in files if (path / name).is_file())
    try:
        if file.suffix == ".safetensors":
            return load_file(file)
        state = torch.load(file, map_location="cpu", weights_only=True)
    except (*_LOADING, SafetensorError) as error:
        raise _damaged(file, error) from error
    if not isinstance(state, dict) or not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise DataError(f"{file} holds no weights", expected="named tensors", found=type(state).__name__)
    return state


def read_config(folder: Path) -> dict[str, Any]:
    """Return ``config.json`` of a folder of weights; empty where there is none.

    Raises
    ------
    DataError
        Where it is no table in JSON.
    """
    path = folder / "config.json"
    if not path.is_file():
        return {}
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise _damaged(path, error) from error
    if not isinstance(values, dict):
        raise DataError(
            f"{path} is no settings of a network", expected="a table in JSON", found=type(values).__name__
        )
    return values


def loaded(make: Callable[[], Any], path: Path) -> Any:
    """Return what ``make`` returns; whatever fails is told as a :class:`DataError` about the weights."""
    from safetensors import SafetensorError

    try:
        return make()
    except (*_LOADING, SafetensorError) as error:
        raise _damaged(path, error) from error


def require_safetensors(path: Path, network: str) -> Path:
    """Return the folder of weights for packages whose own loader runs the code that a checkpoint names.

    Raises
    ------
    CapabilityError
        For a single file: those packages read it without protection.
    """
    if path.is_file():
        raise CapabilityError(
            f"{path.name} would be read by {network} itself, which runs code that the file names",
            expected="a folder with config.json and model.safetensors",
            todo="Take the weights from the Hugging Face hub, which are safetensors",
        )
    return path


def check_complete(model: Any, folder: Path) -> None:
    """Refuse a folder whose ``model.safetensors`` lacks tensors: packages leave those at random, and say nothing.

    A name may be missing where the network keeps the same tensor under another name that is there (files hold such
    a tensor once), or where it is of a part that no prediction uses.

    Raises
    ------
    DataError
        For any other missing name, and where the file is damaged.
    """
    from safetensors import SafetensorError, safe_open

    file = folder / "model.safetensors"
    try:
        with safe_open(file, framework="pt") as handle:
            names = set(handle.keys())
    except (OSError, SafetensorError) as error:
        raise _damaged(file, error) from error
    own = model.state_dict()
    present = {_memory(tensor) for name, tensor in own.items() if name in names}
    missing = [
        name
        for name, tensor in own.items()
        if name not in names and _memory(tensor) not in present and name.rpartition(".")[2] not in _UNUSED
    ]
    if missing:
        raise DataError(
            f"The weights in {folder} are incomplete, or of another network",
            expected=f"{len(own)} tensors",
            found=f"{len(missing)} missing: " + ", ".join(missing[:3]),
            todo="Get its files again",
        )


def _memory(tensor: Any) -> tuple[Any, ...]:
    """Return where a tensor lies, and how: two names of one tensor have the same."""
    return tensor.device, tensor.data_ptr(), tensor.dtype, tuple(tensor.shape), tensor.stride()


def _damaged(path: Path, error: Exception) -> DataError:
    return DataError(
        f"{path} cannot be loaded",
        expected="the weights of this network",
        found=" ".join(str(error).split())[:300] or type(error).__name__,
        todo="Get it again",
    )
