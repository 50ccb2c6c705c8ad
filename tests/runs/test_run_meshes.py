"""The mesh of a run is drawn with fewer faces, in the frame of the paths."""

from __future__ import annotations

import os

import numpy as np
import pytest
from fake_recipe import MakeRun
from shapes import ball

from toolkit.errors import DataError, RunError
from toolkit.files import read_json, write_json
from toolkit.runs.compare import compare_runs
from toolkit.runs.folder import RunFolder
from toolkit.runs.measures import better
from toolkit.runs.meshes import read_run_mesh
from toolkit.runs.report_figures import aligned_figure
from toolkit.scene.mesh_files import write_mesh


def with_mesh(run: RunFolder, finer: int = 3) -> RunFolder:
    write_mesh(run.artifacts / "mesh.ply", ball(finer=finer))
    return run


def test_a_mesh_is_read_with_as_many_faces_as_can_be_drawn(finished: MakeRun) -> None:
    run = with_mesh(finished(), finer=5)
    mesh, total = read_run_mesh(run, most=2_000)
    assert total == 8 * 4**5
    assert 1_800 <= len(mesh.faces) <= 2_000
    assert mesh.rgb is not None
    whole, _ = read_run_mesh(run)
    assert len(whole.faces) == total


def test_another_mesh_in_the_same_place_is_read_anew(finished: MakeRun) -> None:
    run = with_mesh(finished(), finer=2)
    assert read_run_mesh(run)[1] == 8 * 4**2
    with_mesh(run, finer=3)
    os.utime(run.artifacts / "mesh.ply", ns=(1, 1))
    assert read_run_mesh(run)[1] == 8 * 4**3


def test_a_missing_or_damaged_mesh_is_told(finished: MakeRun) -> None:
    run = finished()
    with pytest.raises(RunError, match="has no mesh; expected a finished run of a method that makes one"):
        read_run_mesh(run)
    (run.artifacts / "mesh.ply").write_bytes(b"ply\nnothing")
    with pytest.raises(DataError):
        read_run_mesh(run)


def test_meshes_are_drawn_in_the_frame_of_the_paths(finished: MakeRun) -> None:
    a, b, bare = with_mesh(finished(name="a")), with_mesh(finished(name="b")), finished(name="bare")
    table = read_json(b.trajectory_file)
    for row in table["found"]:
        row["centre"] = [2 * value + 5 for value in row["centre"]]
    write_json(b.trajectory_file, table)
    drawn, remarks = aligned_figure(compare_runs([a, b, bare]).runs, "mesh")
    assert drawn is not None
    first, second = (trace for trace in drawn.data if trace.type == "mesh3d")
    assert (first.name, second.name) == ("a: mesh", "b: mesh")
    # The second run's world is twice as large and moved by five: in the common one its ball is half as large.
    width = np.ptp(np.asarray(second.x)) / np.ptp(np.asarray(first.x))
    assert width == pytest.approx(0.5, abs=1e-5)
    assert len(first.vertexcolor) == len(first.x)
    assert "a: a mesh of 512 faces, drawn with 512." in remarks
    assert any(text.startswith("bare: Run ") and "has no mesh" in text for text in remarks)


def test_which_way_measures_of_meshes_are_better() -> None:
    names = ("accuracy", "completeness", "normal_angle_deg", "precision", "recall", "f_score", "faces", "threshold")
    ways = [better(f"mesh.{name}") for name in names]
    assert ways == ["lower", "lower", "lower", "higher", "higher", "higher", None, None]
