"""Fusion by COLMAP of maps that others wrote."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toolkit.depth.dense_folder import DenseFolder, write_map
from toolkit.depth.fuse import fuse_depth
from toolkit.depth.stereo_settings import FusionSettings
from toolkit.errors import DataError, StageError


def test_exact_maps_become_the_plane_with_colours_and_normals(exact_folder: Path, slanted: Any) -> None:
    cloud = fuse_depth(exact_folder, FusionSettings())
    assert len(cloud) > 1500
    height = cloud.xyz @ slanted.normal
    # Half a pixel to the side would be 0.009 here. Single points lie between pixels of a slanted plane.
    assert abs(np.mean(height)) < 3e-4
    assert np.abs(height).max() < 0.02
    assert cloud.normals is not None
    assert np.allclose(cloud.normals @ slanted.normal, 1, atol=1e-4)
    assert cloud.rgb is not None
    assert cloud.rgb.std() > 20


def test_fusion_repeats(exact_folder: Path) -> None:
    first, again = (fuse_depth(exact_folder, FusionSettings()) for _ in range(2))
    assert np.array_equal(first.xyz, again.xyz)
    assert {path.name for path in exact_folder.iterdir()} == {"images", "sparse", "stereo"}


def test_a_map_that_disagrees_gives_no_points(exact_folder: Path, slanted: Any) -> None:
    dense = DenseFolder(exact_folder)
    whole = fuse_depth(exact_folder, FusionSettings(min_pixels=1))
    for name, factor in (("1.png", 1.1), ("2.png", 1.2), ("3.png", 1.3), ("4.png", 1.4)):
        write_map(dense.path("depth", name), (slanted.depth[name] * factor).astype(np.float32))
    assert len(whole) > 0
    with pytest.raises(StageError, match="no point has 3 pixels that agree"):
        fuse_depth(exact_folder, FusionSettings())


def test_empty_damaged_and_missing_maps_are_told(exact_folder: Path, tmp_path: Path) -> None:
    dense = DenseFolder(exact_folder)
    dense.path("normal", "2.png").write_bytes(b"96&72&3&")
    with pytest.raises(DataError, match="is cut off"):
        fuse_depth(exact_folder, FusionSettings())
    for number in range(5):
        dense.write(f"{number}.png", np.zeros((72, 96), np.float32), np.zeros((72, 96, 3), np.float32), None)
    with pytest.raises(StageError, match="no pixel of any depth map has depth"):
        fuse_depth(exact_folder, FusionSettings())
    with pytest.raises(DataError, match="no dense folder"):
        fuse_depth(tmp_path / "nowhere", FusionSettings())
