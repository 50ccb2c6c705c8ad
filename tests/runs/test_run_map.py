"""A run's splat as a map: which runs have one, and which are too far from their origin."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_recipe import MakeRun
from ground_run import make_ground_run
from splat_ground import CAMERA, down, ground_map

from toolkit.errors import CapabilityError, DataError, RunError
from toolkit.localize.settings import ReliabilitySettings
from toolkit.runs.run_map import open_run_map, splat_kind
from toolkit.splat.ply import write_splats


@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_the_map_draws_what_the_run_trained(tmp_path: Path, kind: str) -> None:
    run = make_ground_run(tmp_path, kind=kind, recipe="colmap-3dgs" if kind == "3d" else "2dgs-sparse")
    opened = open_run_map(run)
    assert opened.kind == splat_kind(run) == kind
    drawn = opened.render(CAMERA, down(), ReliabilitySettings()).colour
    wanted = dataclasses.replace(ground_map(), kind=kind).render(CAMERA, down(), ReliabilitySettings()).colour
    # The file holds the Gaussians as they are.
    np.testing.assert_array_equal(drawn, wanted)


def test_a_run_without_a_splat_is_told(finished: MakeRun) -> None:
    run = finished()
    with pytest.raises(RunError, match=f"Run {run.id} has no splat; expected a finished run of a method"):
        open_run_map(run)


def test_an_empty_and_a_damaged_splat_are_told(tmp_path: Path) -> None:
    run = make_ground_run(tmp_path)
    write_splats(ground_map().gaussians.map(lambda values: values[:0]), run.splat_file)
    with pytest.raises(RunError, match=f"The splat of run {run.id} is empty"):
        open_run_map(run)
    run.splat_file.write_bytes(b"ply\nformat")
    with pytest.raises(DataError):
        open_run_map(run)


def test_a_splat_far_from_its_origin_is_refused(tmp_path: Path) -> None:
    run, ground = make_ground_run(tmp_path), ground_map().gaussians
    # 45 m of splat have 0.0004 m to lose: a step of single precision is 0.0002 m at 3 km, half a metre at 5,000 km.
    for away, fits in ((3e3, True), (5e6, False)):
        moved = dataclasses.replace(ground, means=ground.means + torch.tensor([away, 0.0, 0.0]))
        write_splats(moved, run.splat_file)
        if fits:
            assert len(open_run_map(run).gaussians) == len(ground)
        else:
            with pytest.raises(DataError, match=r"too far from its world's origin .* found steps of 0\.5 around"):
                open_run_map(run)


def test_a_gpu_that_is_not_there_is_told(tmp_path: Path) -> None:
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    with pytest.raises(CapabilityError, match="No GPU was found; expected one that CUDA can use"):
        open_run_map(make_ground_run(tmp_path), device="cuda")
