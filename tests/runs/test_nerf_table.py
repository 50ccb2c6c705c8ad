"""The tables of radiance fields from results that were written by hand, and the segments that they are made of."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from fake_recipe import RECIPE

from toolkit.errors import DataError
from toolkit.files import write_json
from toolkit.recipes.registry import find_recipe
from toolkit.runs import nerf_runs
from toolkit.runs.folder import RunFolder
from toolkit.runs.nerf_runs import make_nerf_attempts, segment
from toolkit.runs.nerf_table import PAPER, ROWS, SEGMENTS, WEIGHTS, NerfRow, nerf_tables, write_nerf_tables
from toolkit.runs.paper_rows import PaperRow
from toolkit.runs.paper_runs import Attempt, TableOptions, row_settings
from toolkit.samples.engine import EngineSettings, make_engine
from toolkit.scene import Scene
from toolkit.scene.dataset import open_capture

METRICS = {
    "sfm.images": 10.0,
    "test.psnr": 31.237,
    "test.ssim": 0.91234,
    "depth.median": 0.000512,
    "depth.mean": 0.002351,
    "mesh.f_score": 0.6789,
    "mesh.threshold": 0.00031,
    "nerf.steps": 1500.0,
}
ROW = {row.key: row for row in ROWS}


def finished(folder: Path, more: Mapping[str, float | None]) -> RunFolder:
    run = RunFolder(folder)
    times = [{"name": name, "seconds": s, "reused": False} for name, s in (("train", 180.4), ("measure", 50.0))]
    write_json(run.result_file, {"metrics": METRICS | more, "times": times, "reports": {}, "test_views": []})
    return run


def test_a_row_has_its_measures_with_the_papers_beside_them(tmp_path: Path) -> None:
    weighed = finished(tmp_path / "b", {"test.lpips_alex": 0.1, "mesh.f_score": None})
    attempts = [
        Attempt(ROW["nerf-40"].row, "film", "finished", run=finished(tmp_path / "a", {})),
        Attempt(ROW["nerf-80"].row, "film", "failed", "No first pair; expected more"),
        Attempt(ROW["ds-nerf-0.1"].row, "film", "finished", run=weighed),
        Attempt(ROW["nerf-40"].row, "other", "failed", "dark"),
    ]
    first, second = nerf_tables(attempts, stride=4, window=4)

    text = first.markdown()
    ours = "10 | 31.24 | 0.9123 | – | 0.51 | 2.35 | 67.9 | 0.31 | 1500 | 180"
    assert f"| NeRF, 40 frames | {ours} | 36.2, 0.9414, 0.1321 |" in text
    assert "| NeRF, 80 frames | failed: No first pair |" in text
    assert text.count("| 34.4, 0.9192, 0.1457 |") == 1
    ours = "10 | 31.24 | 0.9123 | 0.1000 | 0.51 | 2.35 | – | 0.31 | 1500 | 180"
    assert f"| DS-NeRF, 250 frames, weight 0.1 | {ours} | not in source |" in text
    # As many cells in each line as in the head.
    assert len({line.count("|") for line in text.splitlines() if line.startswith("|")}) == 1
    assert "one frame in 4 of it" in text
    assert "warm start takes" not in text
    file = write_nerf_tables([first, second], tmp_path / "out").read_text(encoding="utf-8")
    assert (file.count("## film"), file.count("### Table 2"), file.count("### Table 3")) == (1, 2, 1)
    assert "failed: dark" in file


def test_the_papers_figures_are_those_of_its_table() -> None:
    assert [PAPER[row.key].psnr for row in SEGMENTS] == [36.2, 34.4, 32.8, 31.3, 26.9]
    assert [PAPER[row.key].lpips for row in SEGMENTS] == [0.1321, 0.1457, 0.1778, 0.2857, 0.4223]
    assert [PAPER[row.key].ssim for row in SEGMENTS] == [0.9414, 0.9192, 0.8985, 0.8619, 0.7664]
    assert [row.frames for row in SEGMENTS] == [40, 80, 150, 250, 400]
    assert not {row.key for row in WEIGHTS} & set(PAPER)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.key)
def test_each_row_changes_settings_that_its_recipe_has(row: NerfRow, tmp_path: Path) -> None:
    wishes = {"scene.points.pairs.overlap": 4, "train.steps": 30, "train.max_side": 48}
    settings: Any = row_settings(row.row, find_recipe(row.row.recipe), TableOptions(tmp_path, wishes))

    pairs = settings.scene.points.pairs
    assert (pairs.method, pairs.overlap, pairs.quadratic) == ("sequential", 4, False)
    assert settings.scene.way == "given"
    assert settings.train.steps == 30
    assert (settings.train.depth_weight > 0) == (row.row.recipe == "ds-nerf" and row.key != "ds-nerf-0")


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    tiny = {
        "rotor.blades": 24,
        "film.frames": 12,
        "film.step": 1.0,
        "film.samples": 1,
        "borescope.image_width": 64,
        "borescope.image_height": 48,
        "points": 100,
    }
    return make_engine(tmp_path_factory.mktemp("film") / "engine", EngineSettings().replace(tiny)).folder


def reference(folder: Path) -> Scene:
    found = open_capture(folder).reference
    assert found is not None
    return found


def test_a_segment_is_the_beginning_of_the_film_in_its_world(film: Path) -> None:
    whole = reference(film)
    cut = segment(whole, 10, 3)
    assert [frame.name for frame in cut.frames] == [whole.frames[i].name for i in (0, 3, 6, 9)]
    for frame in cut.frames:
        assert frame.cam_from_world == whole.frame(frame.name).cam_from_world
    assert [frame.split for frame in cut.frames] == ["test", "train", "train", "train"]
    assert cut.points is None


ROWS_HERE = (
    NerfRow(PaperRow("late", "Late", "late", {}), 12, warm_from="first"),
    NerfRow(PaperRow("first", "First", "first", {}), 6),
    NerfRow(PaperRow("long", "Long", "first", {}), 40),
    NerfRow(PaperRow("short", "Short", "first", {}), 4),
)


def test_rows_run_on_their_segments_and_a_warm_start_has_its_weights(
    film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, int, Any]] = []

    def attempts(rows: Any, data: Mapping[str, Path], *_: object, **__: object) -> list[Attempt]:
        (folder,) = data.values()
        asked.append((rows[0].key, len(reference(folder)), rows[0].changes.get("train.warm_start")))
        return [Attempt(rows[0], "film", "finished", run=RunFolder(tmp_path / rows[0].key))]

    monkeypatch.setattr(nerf_runs, "ROWS", ROWS_HERE)
    monkeypatch.setattr(nerf_runs, "make_attempts", attempts)
    made = make_nerf_attempts(
        ROWS_HERE, {"film": film}, {}, TableOptions(tmp_path, {}), stride=2, segments=tmp_path / "segments"
    )

    # The row that gives the weights is first, and made once.
    assert asked == [("first", 3, None), ("late", 6, str(tmp_path / "first"))]
    assert [each.outcome for each in made] == ["finished", "finished", "not applicable", "not applicable"]
    assert made[0].row is ROWS_HERE[0].row
    assert made[2].reason == "the film has 12 frames"
    assert made[3].reason == "a stride of 2 leaves 2 frames"


def test_a_warm_start_without_weights_is_told(film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nerf_runs, "ROWS", ROWS_HERE)
    made = make_nerf_attempts(
        ROWS_HERE[:1], {"film": film}, {}, TableOptions(tmp_path, {}), stride=1, segments=tmp_path / "segments"
    )
    assert made[0].outcome == "not applicable"
    assert made[0].reason == "no weights, for first not there: no recipe 'first'"


def test_a_film_without_poses_is_told(film: Path, tmp_path: Path) -> None:
    bare = film / "images"
    with pytest.raises(DataError, match="has no poses; expected a film with true or surveyed poses"):
        make_nerf_attempts(
            ROWS_HERE, {"film": bare}, {}, TableOptions(tmp_path, {}), stride=1, segments=tmp_path / "segments"
        )


def test_finished_runs_are_taken_again(film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nerf_runs, "ROWS", ROWS_HERE)
    recipes = {"first": dataclasses.replace(RECIPE, name="first")}
    options = TableOptions(tmp_path / "runs", {})
    made = [
        make_nerf_attempts(
            ROWS_HERE[1:2], {"film": film}, recipes, options, stride=1, segments=tmp_path / "segments"
        )[0]
        for _ in range(2)
    ]
    assert made[0].outcome == "finished", made[0].text
    assert made[0].run == made[1].run
