"""Descriptors of learned features, in a file of their own that belongs to the keypoints of one database.

COLMAP's database could hold them, too, but its build ends the process where it meets the types of learned features.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.files import atomic_path
from toolkit.matching.database import settle

if TYPE_CHECKING:
    import torch

_FORMAT = "toolkit-descriptors-1"


def descriptor_path(database_path: Path) -> Path:
    """Return where the descriptors of a database's learned features are, beside it."""
    return database_path.with_name(f"{database_path.name}.descriptors.safetensors")


def write_descriptors(
    path: Path, keypoints: Mapping[int, NDArray[np.float32]], descriptors: Mapping[int, torch.Tensor], kind: str
) -> None:
    """Write the descriptors of a database's keypoints, in half precision.

    Parameters
    ----------
    path:
        Where to write.
    keypoints:
        (K, 2) pixels by image number, as they are in the database: their hash ties the file to it.
    descriptors:
        (K, D) by image number.
    kind:
        Of the features.
    """
    import torch
    from safetensors.torch import save_file

    tensors = {str(number): values.to("cpu", torch.float16).contiguous() for number, values in descriptors.items()}
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, {"format": _FORMAT, "kind": kind, "keypoints": _key(keypoints)})


class Descriptors:
    """The keypoints of a database with the descriptors that belong to them.

    Attributes
    ----------
    keypoints:
        (K, 2) float32 pixels by image number, centres at +0.5.
    kind:
        Of the features.
    """

    def __init__(self, file: Any, keypoints: Mapping[int, NDArray[np.float32]], kind: str) -> None:
        self._file = file
        self.keypoints = keypoints
        self.kind = kind

    def of(self, number: int) -> torch.Tensor:
        """Return the descriptors (K, D) float32 of an image by its number."""
        values: torch.Tensor = self._file.get_tensor(str(number))
        return values.float()


@contextmanager
def open_descriptors(path: Path, database_path: Path) -> Iterator[Descriptors]:
    """Yield the descriptors that belong to a database.

    Raises
    ------
    DataError
        Where the file is missing, damaged, or belongs to other keypoints than the database has.
    """
    from safetensors import SafetensorError, safe_open

    todo = "Extract learned features into the database again"
    if not path.is_file():
        raise DataError(f"{path} is missing", expected="the descriptors of learned features", todo=todo)
    keypoints = read_keypoints(database_path)
    try:
        with safe_open(path, framework="pt") as file:
            about = file.metadata() or {}
            if about.get("format") != _FORMAT:
                raise DataError(f"{path} holds no descriptors of ours", expected=_FORMAT, todo=todo)
            if about.get("keypoints") != _key(keypoints):
                raise DataError(
                    f"{path} belongs to another database than {database_path}",
                    expected="descriptors of the keypoints that are in it",
                    todo=todo,
                )
            yield Descriptors(file, keypoints, about.get("kind", ""))
    except SafetensorError as error:
        raise DataError(f"{path} is damaged", found=str(error), todo=todo) from error


def read_keypoints(database_path: Path) -> dict[int, NDArray[np.float32]]:
    """Return the keypoints (K, 2) of a database by image number, pixel centres at +0.5."""
    found = {}
    with closing(pycolmap.Database.open(database_path)) as database:
        for image in database.read_all_images():
            number = image.image_id
            there = database.exists_keypoints(number) and database.num_keypoints_for_image(number) > 0
            values = database.read_keypoints(number)[:, :2] if there else np.zeros((0, 2))
            found[number] = np.ascontiguousarray(values, dtype=np.float32)
    # COLMAP changes how the file is journalled, even when it only reads.
    settle(database_path)
    return found


def _key(keypoints: Mapping[int, NDArray[np.float32]]) -> str:
    digest = hashlib.sha256()
    for number in sorted(keypoints):
        digest.update(f"{number}:{len(keypoints[number])};".encode())
        digest.update(np.ascontiguousarray(keypoints[number], dtype=np.float32).tobytes())
    return digest.hexdigest()
