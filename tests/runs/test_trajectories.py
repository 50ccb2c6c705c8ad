"""Trajectories of runs are laid onto each other for plots, and what cannot be laid is said."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.geometry.alignment import Similarity
from toolkit.geometry.rigid import RigidTransform, rotation_from_quaternion
from toolkit.runs.trajectories import Trajectories, Trajectory, align_trajectories, read_trajectories

TURN = Similarity(0.3, rotation_from_quaternion(np.array([0.8, 0.1, -0.5, 0.3])), np.array([5.0, -2.0, 40.0]))


def bent(count: int = 8) -> Trajectory:
    return Trajectory(
        {f"{i}.jpg": RigidTransform.look_at((i, 0.2 * i * i, 10.0), (4.0, 5.0, 0.0)) for i in range(count)}
    )


def straight(count: int = 8) -> Trajectory:
    return Trajectory(
        {f"{i}.jpg": RigidTransform.look_at((i, 0.0, 10.0), (i + 0.2, 1.0, 0.0)) for i in range(count)}
    )


def same(one: Trajectory, other: Trajectory) -> None:
    assert one.names == other.names
    for name in one.names:
        # Rounding of the alignment's singular value decomposition, on coordinates of order ten.
        np.testing.assert_allclose(one.poses[name].matrix, other.poses[name].matrix, atol=1e-9)


def test_every_run_is_laid_onto_the_reference() -> None:
    aligned = align_trajectories(
        {"a": Trajectories(bent().mapped(TURN), None), "b": Trajectories(bent().mapped(TURN.inverse()), bent())}
    )
    assert aligned.reference is not None
    for path in aligned.paths.values():
        assert set(path.names) == set(bent().names)
        for name, pose in path.poses.items():
            np.testing.assert_allclose(pose.centre, bent().poses[name].centre, atol=1e-9)
            np.testing.assert_allclose(pose.rotation, bent().poses[name].rotation, atol=1e-9)
    assert aligned.remarks == ("Aligned to the reference by camera centres (Sim(3)).",)


def test_without_reference_the_first_run_is_the_measure() -> None:
    aligned = align_trajectories(
        {"first": Trajectories(bent(), None), "second": Trajectories(bent().mapped(TURN), None)}
    )
    assert aligned.paths["first"] == bent() or aligned.paths["first"].names == bent().names
    for name, pose in aligned.paths["second"].poses.items():
        np.testing.assert_allclose(pose.centre, bent().poses[name].centre, atol=1e-9)
    assert aligned.remarks == ("Aligned to first by camera centres (Sim(3)).",)
    assert aligned.reference is None


def test_a_straight_flight_is_aligned_with_the_help_of_orientations() -> None:
    aligned = align_trajectories({"a": Trajectories(straight().mapped(TURN), straight())})
    for name, pose in aligned.paths["a"].poses.items():
        np.testing.assert_allclose(pose.centre, straight().poses[name].centre, atol=1e-9)
        np.testing.assert_allclose(pose.rotation, straight().poses[name].rotation, atol=1e-9)
    assert aligned.remarks[1] == "a: centres on a line, aligned by centres and orientations."


def test_a_run_that_cannot_be_aligned_is_left_out_with_the_reason() -> None:
    one = Trajectory({"other.jpg": bent().poses["0.jpg"]})
    aligned = align_trajectories({"a": Trajectories(bent(), bent()), "b": Trajectories(one, None)})
    assert set(aligned.paths) == {"a"}
    assert aligned.remarks[1].startswith("b is not drawn: Too few poses to align; expected at least 1; found 0.")


def test_no_trajectories_are_no_error() -> None:
    aligned = align_trajectories({})
    assert (dict(aligned.paths), aligned.reference, aligned.remarks) == ({}, None, ())


@pytest.mark.parametrize(
    "content",
    [
        {},
        {"found": [{"name": "a"}], "reference": None},
        {"found": [{"name": "a", "centre": [0, 0], "cam_from_world_wxyz": [1, 0, 0, 0]}], "reference": None},
        {"found": [{"name": "a", "centre": [0, 0, "x"], "cam_from_world_wxyz": [1, 0, 0, 0]}], "reference": None},
        {"found": [{"name": "a", "centre": [0, 0, 0], "cam_from_world_wxyz": [0, 0, 0, 0]}], "reference": None},
        {"found": 3, "reference": None},
        [],
    ],
)
def test_a_damaged_file_is_told(tmp_path: Path, content: object) -> None:
    path = tmp_path / "trajectory.json"
    path.write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"trajectory\.json holds no trajectories; expected name, centre"):
        read_trajectories(path)
