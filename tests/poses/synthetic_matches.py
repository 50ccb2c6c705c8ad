"""Matches of made-up points in a database, with the true poses: structure from motion without pictures."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pycolmap

from toolkit.scene import Scene, scene_from_pycolmap


def synthetic_matches(
    folder: Path, *, frames: int, points: int = 200, noise: float = 0.5, seed: int = 0
) -> tuple[Scene, Path]:
    """Return the true scene and a database with keypoints, ``noise`` pixels off, and their matches."""
    database_path = folder / "matches.db"
    (folder / "images").mkdir(exist_ok=True)
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=frames, num_points3D=points
    )
    with closing(pycolmap.Database.open(database_path)) as database:
        truth = pycolmap.synthesize_dataset(options, database)
        pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=noise), truth, database)
    return scene_from_pycolmap(truth, folder / "images"), database_path


def forget_pairs(database_path: Path, kept: set[tuple[int, int]]) -> None:
    """Delete the matches of all pairs of frame indices but ``kept``."""
    with closing(pycolmap.Database.open(database_path)) as database:
        count = database.num_images()
        for i in range(count):
            for j in range(i + 1, count):
                if (i, j) not in kept:
                    database.delete_matches(i + 1, j + 1)
                    database.delete_two_view_geometry(i + 1, j + 1)
