"""Matches of a capture are found in the workspace by its fingerprint; what is damaged is passed over."""

from __future__ import annotations

from pathlib import Path

from toolkit.files import write_json, write_text
from toolkit.runs.launch import WORKSPACE
from toolkit.runs.match_graph import has_match_graphs, match_graphs
from toolkit.workspace import Workspace


def make(runs: Path, capture: str, pairs: list[list[int]], method: str = "exhaustive") -> str:
    """Write what the stages features and matches of a run leave; return the key of the second."""
    workspace = Workspace(runs / WORKSPACE)
    features = workspace.stage(
        "features", inputs={"capture": capture, "seed": 0}, settings={}, code="1", build=lambda folder: None
    )

    def build(folder: Path) -> None:
        report = {"pairs_tried": 10, "verified_pairs": pairs, "group_sizes": [3, 1]}
        write_json(folder / "report.json", report)

    inputs = {"features": features.key, "pairs": {"method": method}, "seed": 0}
    return workspace.stage("matches", inputs=inputs, settings={"n": len(pairs)}, code="1", build=build).folder.name


def test_verified_pairs_are_read_from_the_report(tmp_path: Path) -> None:
    assert not has_match_graphs(tmp_path)
    assert match_graphs(tmp_path, "abc", 4) == ()
    key = make(tmp_path, "abc", [[0, 1, 50, 40], [1, 3, 30, 20]], method="sequential")
    make(tmp_path, "other", [[0, 1, 9, 9]])
    assert has_match_graphs(tmp_path)
    (graph,) = match_graphs(tmp_path, "abc", 4)
    assert graph.key == key
    assert graph.pairs.tolist() == [[0, 1], [1, 3]]
    assert graph.inliers.tolist() == [40, 20]
    assert (graph.tried, graph.groups) == (10, (3, 1))
    assert graph.label.startswith("sequential pairs, 2 of 10 verified, 20")


def test_a_matching_of_more_frames_is_another_captures(tmp_path: Path) -> None:
    make(tmp_path, "abc", [[0, 4, 50, 40]])
    assert match_graphs(tmp_path, "abc", 4) == ()
    assert len(match_graphs(tmp_path, "abc", 5)) == 1


def test_damaged_stages_are_left_out(tmp_path: Path) -> None:
    sound = make(tmp_path, "abc", [[0, 1, 50, 40]])
    for number, report in enumerate(
        ("no json", '{"verified_pairs": [[0]]}', "[]", '{"verified_pairs": [[-1,0,1,1]]}')
    ):
        key = make(tmp_path, "abc", [[0, 1, 50, 40]] * (number + 2))
        write_text(tmp_path / WORKSPACE / key / "report.json", report)
    key = make(tmp_path, "abc", [])
    write_text(tmp_path / WORKSPACE / key / "stage.json", "[]")
    assert [graph.key for graph in match_graphs(tmp_path, "abc", 4)] == [sound]


def test_a_matching_without_any_pair_is_one(tmp_path: Path) -> None:
    make(tmp_path, "abc", [])
    (graph,) = match_graphs(tmp_path, "abc", 4)
    assert graph.pairs.shape == (0, 2)
