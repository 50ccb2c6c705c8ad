"""Depth maps from files: found by the picture's name, checked, never run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toolkit.depth.array_depth import ArrayDepth
from toolkit.errors import DataError
from toolkit.scene import Scene

NAME = "nadir.png"
SHAPE = (30, 40)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "depth"
    made.mkdir()
    return made


@pytest.mark.parametrize("stored", ["nadir.png.npz", "nadir.png.npy", "nadir.npz", "nadir.npy"])
def test_a_map_comes_back_as_it_was_written(flat_scene: Callable[..., Scene], folder: Path, stored: str) -> None:
    depth = np.random.default_rng(0).uniform(1, 50, SHAPE).astype(np.float32)
    if stored.endswith("npz"):
        np.savez_compressed(folder / stored, anything=depth)
    else:
        np.save(folder / stored, depth)
    scene = flat_scene()
    prediction = ArrayDepth(folder).predict(scene, scene.frame(NAME))
    assert prediction.kind == "metric"
    assert prediction.confidence is None
    np.testing.assert_array_equal(prediction.values, depth)


def test_nan_infinity_and_zero_mean_no_depth_but_zero_disparity_is_a_value(
    flat_scene: Callable[..., Scene], folder: Path
) -> None:
    values = np.full(SHAPE, 7.0)
    values[0, :4] = np.nan, np.inf, -np.inf, 0
    np.save(folder / "nadir.npy", values)
    scene = flat_scene()
    depth = ArrayDepth(folder).predict(scene, scene.frame(NAME)).values
    disparity = ArrayDepth(folder, "affine-disparity").predict(scene, scene.frame(NAME)).values
    assert np.isnan(depth).sum() == 4
    assert np.isnan(disparity).sum() == 3
    assert disparity[0, 3] == 0


def test_confidence_travels_along(flat_scene: Callable[..., Scene], folder: Path) -> None:
    confidence = np.linspace(0, 1, 1200, dtype=np.float32).reshape(SHAPE)
    np.savez(folder / "nadir.npz", depth=np.ones(SHAPE), confidence=confidence, other=np.ones(3))
    scene = flat_scene()
    found = ArrayDepth(folder).predict(scene, scene.frame(NAME)).confidence
    assert found is not None
    np.testing.assert_array_equal(found, confidence)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"depth": np.ones((30, 41))}, r"does not fit the picture; expected \(30, 40\).*\(30, 41\)"),
        ({"depth": np.ones((30, 40, 1))}, r"does not fit the picture.*\(30, 40, 1\)"),
        ({"depth": -np.ones(SHAPE)}, "are negative.*1200 below 0.*affine-disparity"),
        ({"depth": np.full(SHAPE, np.nan)}, "holds no depth at all"),
        ({"depth": np.zeros(SHAPE)}, "holds no depth at all"),
        ({"depth": np.full(SHAPE, "far")}, "holds no real numbers"),
        ({"depth": np.full(SHAPE, 1j)}, "holds no real numbers; expected floats or integers; found complex"),
        ({"a": np.ones(SHAPE), "b": np.ones(SHAPE)}, "which array is the depth.*found a, b"),
        ({"depth": np.ones(SHAPE), "confidence": np.ones((3, 4))}, "confidence in .* does not fit"),
        ({"depth": np.ones(SHAPE), "confidence": np.full(SHAPE, 1.5)}, r"confidence in .*values in 0\.\.1"),
    ],
)
def test_a_map_that_cannot_be_used_is_refused(
    flat_scene: Callable[..., Scene], folder: Path, arrays: dict[str, Any], message: str
) -> None:
    np.savez(folder / "nadir.npz", **arrays)
    scene = flat_scene()
    with pytest.raises(DataError, match=message):
        ArrayDepth(folder).predict(scene, scene.frame(NAME))


class Trap:
    """Says so if anyone unpickles it."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (pytest.fail, ("a depth map was unpickled",))


def test_objects_are_never_unpickled(flat_scene: Callable[..., Scene], folder: Path) -> None:
    np.save(folder / "nadir.npy", np.array([Trap()], dtype=object), allow_pickle=True)
    scene = flat_scene()
    with pytest.raises(DataError, match="Cannot read the depth map .*numbers.*allow_pickle=False"):
        ArrayDepth(folder).predict(scene, scene.frame(NAME))


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY", b"PK\x03\x04 cut off", b"hello"])
def test_damaged_files_are_refused(flat_scene: Callable[..., Scene], folder: Path, content: bytes) -> None:
    (folder / "nadir.npy").write_bytes(content)
    scene = flat_scene()
    with pytest.raises(DataError, match="Cannot read the depth map .*nadir.npy"):
        ArrayDepth(folder).predict(scene, scene.frame(NAME))


def test_a_cut_off_file_is_refused(flat_scene: Callable[..., Scene], folder: Path) -> None:
    np.save(folder / "nadir.npy", np.ones(SHAPE))
    whole = (folder / "nadir.npy").read_bytes()
    (folder / "nadir.npy").write_bytes(whole[: len(whole) // 2])
    scene = flat_scene()
    with pytest.raises(DataError, match="Cannot read the depth map"):
        ArrayDepth(folder).predict(scene, scene.frame(NAME))


def test_what_is_missing_is_named(flat_scene: Callable[..., Scene], folder: Path) -> None:
    scene = flat_scene()
    with pytest.raises(DataError, match=r"'nadir.png' has no depth map.*nadir\.png\.npz.*nadir\.npy"):
        ArrayDepth(folder).predict(scene, scene.frame(NAME))
    with pytest.raises(DataError, match="There is no folder of depth maps .*nowhere"):
        ArrayDepth(folder / "nowhere")
