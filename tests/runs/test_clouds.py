"""Points of a run are thinned to what a browser draws, and lie in the frame of the paths."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_recipe import MakeRun

from toolkit.errors import DataError, RunError
from toolkit.runs.clouds import MOST_POINTS, read_cloud
from toolkit.runs.compare import compare_runs
from toolkit.runs.folder import RunFolder
from toolkit.runs.report_figures import aligned_figure
from toolkit.scene import Points
from toolkit.scene.folder import read_scene, write_scene
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.ply import write_splats


def with_points(run: RunFolder, count: int) -> RunFolder:
    """Give a run points in a box of two metres, one of them very far."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-1, 1, (count, 3))
    xyz[0] = 1e6
    rgb = np.full((count, 3), (10, 20, 30), np.uint8)
    scene = read_scene(run.scene_folder).replace(points=Points(xyz, rgb))
    write_scene(scene, run.scene_folder)
    return run


def with_splat(run: RunFolder, count: int = 50) -> RunFolder:
    rng = np.random.default_rng(1)
    gaussians = Gaussians(
        torch.tensor(rng.uniform(-1, 1, (count, 3)), dtype=torch.float32),
        torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4).contiguous(),
        torch.zeros(count, 3),
        torch.zeros(count),
        torch.full((count, 1, 3), 1.0),
    )
    write_splats(gaussians, run.splat_file)
    return run


def test_many_points_are_thinned_and_far_ones_left_out(finished: MakeRun) -> None:
    run = with_points(finished(), 30_000)
    cloud = read_cloud(run, "points")
    assert len(cloud.xyz) == len(cloud.rgb) == MOST_POINTS
    assert cloud.total == 30_000
    assert np.abs(cloud.xyz).max() < 1
    assert tuple(cloud.rgb[0]) == (10, 20, 30)
    again = read_cloud(run, "points")
    np.testing.assert_array_equal(cloud.xyz, again.xyz)


def test_few_points_are_all_there(finished: MakeRun) -> None:
    assert len(read_cloud(with_points(finished(), 40), "points").xyz) == 40


def test_centres_of_gaussians_have_the_colour_of_their_constant_term(finished: MakeRun) -> None:
    cloud = read_cloud(with_splat(finished()), "gaussians")
    assert len(cloud.xyz) == 50
    # 255 (0.5 + 1 / (2 sqrt(pi))) rounds to 199.
    assert {tuple(colour) for colour in cloud.rgb.tolist()} == {(199, 199, 199)}


def test_what_is_missing_or_damaged_is_told(finished: MakeRun, queued: MakeRun) -> None:
    run = finished()
    with pytest.raises(RunError, match="has no points; expected a finished run"):
        read_cloud(run, "points")
    with pytest.raises(RunError, match="has no points"):
        read_cloud(queued(), "points")
    with pytest.raises(RunError, match="has no splat"):
        read_cloud(run, "gaussians")
    run.splat_file.write_bytes(b"ply\nnothing")
    with pytest.raises(DataError):
        read_cloud(run, "gaussians")


def test_points_are_drawn_in_the_frame_of_the_paths(finished: MakeRun) -> None:
    runs = [with_points(finished(name="a"), 40), finished(name="b")]
    comparison = compare_runs(runs)
    drawn, remarks = aligned_figure(comparison.runs, "points")
    assert drawn is not None
    clouds = [trace for trace in drawn.data if trace.name and trace.name.endswith(": points")]
    assert [trace.name for trace in clouds] == ["a: points"]
    assert len(clouds[0].x) == 40
    assert clouds[0].marker.color[0] == "#0a141e"
    assert "a: 40 of 40 points; far ones are left out." in remarks
    assert any(text.startswith("b: Run ") and "has no points" in text for text in remarks)
    plain, _ = aligned_figure(comparison.runs)
    assert plain is not None
    assert len(plain.data) == len(drawn.data) - 1


def test_points_follow_the_alignment_of_their_run(finished: MakeRun, tmp_path: Path) -> None:
    from toolkit.files import read_json, write_json
    from toolkit.runs.trajectories import align_trajectories, read_trajectories

    a, b = finished(name="a"), finished(name="b")
    table = read_json(b.trajectory_file)
    for row in table["found"]:
        row["centre"] = [2 * value + 5 for value in row["centre"]]
    write_json(b.trajectory_file, table)
    read = {run.record().name: read_trajectories(run.trajectory_file) for run in (a, b)}
    aligned = align_trajectories({name: dataclasses.replace(item, reference=None) for name, item in read.items()})
    # The second run is twice as large and moved by five: its points have to come back.
    np.testing.assert_allclose(aligned.transforms["b"].apply([[7.0, 9.0, 11.0]]), [[1.0, 2.0, 3.0]], atol=1e-9)
    np.testing.assert_allclose(aligned.transforms["a"].apply([[1.0, 2.0, 3.0]]), [[1.0, 2.0, 3.0]])
