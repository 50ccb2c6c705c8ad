"""Depth maps from files that something else wrote: one ``.npy`` or ``.npz`` for each picture."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.monocular import DepthKind, DepthPrediction
from toolkit.errors import DataError
from toolkit.scene import Frame, Scene


class ArrayDepth:
    """Reads depth maps from a folder.

    For the frame ``a/b.jpg`` these are tried: ``a/b.jpg.npz``, ``a/b.jpg.npy``, ``a/b.npz``, ``a/b.npy``. An
    ``.npz`` holds an array ``depth`` or only one array, and may hold ``confidence`` (0..1) of the same size.
    NaN and infinity mean no depth, as does 0 where the values are depths.

    Parameters
    ----------
    folder:
        Of the arrays.
    kind:
        What the values mean.

    Raises
    ------
    DataError
        Where there is no such folder.
    """

    def __init__(self, folder: Path, kind: DepthKind = "metric") -> None:
        if not folder.is_dir():
            raise DataError(
                f"There is no folder of depth maps {str(folder)!r}",
                expected="a folder with <picture>.npy or .npz",
                todo="Set 'arrays' to it",
            )
        self._folder, self._kind = folder, kind

    @property
    def name(self) -> str:
        """Method and kind."""
        return f"depth maps ({self._kind}) of {self._folder.name}"

    def predict(self, scene: Scene, frame: Frame) -> DepthPrediction:
        """Return the stored map of ``frame``.

        Raises
        ------
        DataError
            Where it is missing, damaged, not of the picture's size, no numbers, negative, or nowhere finite.
        """
        path = self._find(frame)
        stored, confidence = _read(path)
        camera = scene.camera_of(frame)
        for what, array in (("depth", stored), ("confidence", confidence)):
            if array is not None and array.shape != (camera.height, camera.width):
                raise DataError(
                    f"The {what} in {path} does not fit the picture",
                    expected=f"{(camera.height, camera.width)}, as its camera says",
                    found=str(array.shape),
                    todo="Compute it again at the size of the pictures",
                )
        with np.errstate(over="ignore"):
            values = np.where(np.isfinite(stored), stored, np.nan).astype(np.float32)
        values[np.isinf(values)] = np.nan
        if self._kind != "affine-disparity":
            if np.any(values < 0):
                raise DataError(
                    f"Depths in {path} are negative",
                    expected="depths from 0 (none) on",
                    found=f"{int(np.sum(values < 0))} below 0",
                    todo="Say with 'kind' what the values are, for example affine-disparity",
                )
            values[values == 0] = np.nan
        if not np.isfinite(values).any():
            raise DataError(
                f"{path} holds no depth at all", expected="some finite values", found="zeros, NaN or infinity only"
            )
        if confidence is not None and not np.all((confidence >= 0) & (confidence <= 1)):
            raise DataError(f"The confidence in {path} is none", expected="values in 0..1")
        return DepthPrediction(values, self._kind, None if confidence is None else confidence.astype(np.float32))

    def _find(self, frame: Frame) -> Path:
        whole = self._folder / frame.name
        places = [
            base.with_name(base.name + ending) for base in (whole, whole.with_suffix("")) for ending in _ENDINGS
        ]
        for place in places:
            if place.is_file():
                return place
        raise DataError(
            f"Frame '{frame.name}' has no depth map",
            expected="one of " + ", ".join(str(place) for place in places),
            todo="Compute depth for all training pictures",
        )


_ENDINGS = (".npz", ".npy")


def _read(path: Path) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """Return depth and confidence of a file, both of real numbers; nothing in it is run."""
    confidence = None
    try:
        with path.open("rb") as handle:
            loaded = np.load(handle, allow_pickle=False)
            if isinstance(loaded, np.lib.npyio.NpzFile):
                names = [name for name in loaded.files if name != "confidence"]
                if "depth" not in names and len(names) != 1:
                    raise DataError(
                        f"{path} does not say which array is the depth",
                        expected="an array 'depth', or only one",
                        found=", ".join(names) or "none",
                    )
                depth = loaded["depth" if "depth" in names else names[0]]
                confidence = loaded["confidence"] if "confidence" in loaded.files else None
            else:
                depth = loaded
    except (
        OSError,
        ValueError,
        TypeError,
        KeyError,
        EOFError,
        MemoryError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise DataError(
            f"Cannot read the depth map {path}",
            expected="an .npy or .npz file of numbers",
            found=str(error),
            todo="Write it again with numpy.save or numpy.savez",
        ) from error
    for array in (depth, confidence):
        if array is not None and array.dtype.kind not in "fiu":
            raise DataError(f"{path} holds no real numbers", expected="floats or integers", found=str(array.dtype))
    return depth, confidence
