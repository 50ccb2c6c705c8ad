"""What a run measured of its map and of poses, as texts beside the paper's figures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file
from splat_ground import down

from toolkit.errors import RunError
from toolkit.files import write_json
from toolkit.localize.batch import Batch
from toolkit.localize.result import Localization
from toolkit.localize.starts import Start
from toolkit.recipes.map_geometry import GEOMETRY
from toolkit.runs.folder import RunFolder
from toolkit.runs.localization_measures import (
    answers_text,
    centre_distances,
    map_measures,
    poses_text,
    published_map_measures,
)
from toolkit.runs.record import RunRecord


def finished(
    folder: Path,
    metrics: Mapping[str, float | None],
    reports: Mapping[str, Any] | None = None,
    recipe: str = "2dgs-sparse",
) -> RunFolder:
    run = RunFolder(folder)
    write_json(
        run.result_file, {"metrics": dict(metrics), "times": [], "reports": dict(reports or {}), "test_views": []}
    )
    record = RunRecord(recipe, {}, 0, "cpu", "flight", "abc", "", "2026-01-01T00:00:00Z", {}, {}, {})
    write_json(run.record_file, record.to_dict())
    return run


def poses(mode: str, scenario: str, mte: float) -> dict[str, float | None]:
    names = {"mte_m": mte, "rmse_t_m": 1.5 * mte, "mre_deg": 0.02, "rmse_r_deg": 0.03, "found": 0.875}
    return {f"localize.{mode}.{scenario}.{name}": value for name, value in names.items()}


def test_only_what_was_measured_of_a_map_is_told_and_the_papers_under_the_same_names(tmp_path: Path) -> None:
    run = finished(tmp_path / "run", {"sfm.points": 2500.0, "map.c2c_median": 0.0812, "test.psnr": None, "x": 1.0})
    ours, paper = map_measures(run), published_map_measures("2dgs-sparse")
    assert ours == {
        "sparse points": 2500.0,
        "PSNR of queries [dB]": None,
        "centres to dense cloud, median [m]": 0.0812,
    }
    assert paper["centres to dense cloud, median [m]"] == 0.88
    assert paper["PSNR of queries [dB]"] == 31.543
    # The third map ran out of memory: its figure is of the first checkpoint.
    assert published_map_measures("2dgs-dense-pos")["PSNR of queries [dB]"] == 27.676
    assert published_map_measures("colmap-3dgs") == {}
    every = finished(tmp_path / "whole", dict.fromkeys(("sfm.position_residual", "fused.points"), 1.0))
    assert set(map_measures(every)) <= set(paper)


def test_poses_are_lines_with_the_papers_below_each_kind_of_start(tmp_path: Path) -> None:
    metrics = {
        **poses("one-shot-sift", "sfm-test", 0.31),
        **poses("ours", "sfm-test", 0.05),
        "localize.start.sfm-test.mte_m": 0.0,
        **poses("ours", "sfm-test-pos10", 0.06),
        "localize.start.sfm-test-pos10.mte_m": 9.612,
    }
    reports = {"localize.calc-test": {"reason": "Query 'a' has no start by sensors"}}
    lines = poses_text(finished(tmp_path / "run", metrics, reports)).splitlines()
    cells = [[cell for cell in line.split("  ") if cell.strip()] for line in lines]
    told = [[cell.strip() for cell in row] for row in cells]
    assert told[0][:4] == ["start", "method", "found", "MTE [m]"]
    assert told[1][:2] == ["sfm-train", "(the paper, its data)"]
    assert told[2] == ["sfm-test", "one-shot-sift", "88%", "0.3100", "0.4650", "0.02000", "0.03000", "0"]
    assert told[3][:4] == ["sfm-test", "ours", "88%", "0.05000"]
    assert told[4] == ["sfm-test", "(the paper, its data)", "–", "0.28", "0.29", "0.11", "0.13", "–"]
    assert told[5] == ["calc-test", "not run: Query 'a' has no start by sensors"]
    assert told[7] == ["sfm-test-pos10", "ours", "88%", "0.06000", "0.09000", "0.02000", "0.03000", "9.612"]
    assert told[8][-1] == "9.550"


def test_a_recipe_of_no_paper_has_lines_of_its_own_only(tmp_path: Path) -> None:
    text = poses_text(finished(tmp_path / "run", poses("ours", "sfm-test", 0.05), recipe="mine"))
    assert len(text.splitlines()) == 2
    assert "paper" not in text


def test_answers_are_told_with_reasons_and_counted() -> None:
    start = Start("a", down(), 1.0, 1.0)
    covariance = np.diag([0.0004, 0.0001, 0.0001, 1e-8, 1e-8, 1e-8])
    found = Localization("a", down(), "", 50, 40, covariance)
    lost = Localization("b", None, "3 of 9 matches agree, 30 are needed")
    text = answers_text(
        {"town": Batch("ours", (start, start), (found, lost)), "black": Batch("ours", (start,), (lost,))}
    )
    lines = text.splitlines()
    assert lines[1].split(maxsplit=2)[2] == "FOUND, to ±0.02 m, 40 matches agree"
    assert lines[2].endswith("not found: 3 of 9 matches agree, 30 are needed")
    assert lines[3].startswith("black")
    assert lines[-1] == "1 of 3 believed"


def test_distances_of_centres_are_read_and_a_run_without_them_says_so(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "20260101-000000-2dgs-sparse-0000")
    with pytest.raises(RunError, match=r"did not measure its map; expected a finished run of a method 2dgs-\*"):
        centre_distances(run)
    run.artifacts.mkdir(parents=True)
    numbers = {"centres": np.ones((4, 3), np.float32), "distance": np.arange(4, dtype=np.float32)}
    save_file(numbers, run.artifacts / GEOMETRY)
    centres, distance = centre_distances(run)
    assert centres.shape == (4, 3)
    assert centres.dtype == distance.dtype == np.float64
    np.testing.assert_array_equal(distance, [0, 1, 2, 3])
