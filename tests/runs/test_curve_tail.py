"""Measurements of a working run are read piece by piece, and thinned as they grow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fake_recipe import RECIPE, MakeRun

from toolkit.errors import DataError
from toolkit.runs.curve_tail import CurveTail, LiveCurve
from toolkit.runs.curves import HEADER
from toolkit.runs.launch import execute


def grown(count: int, most: int) -> LiveCurve:
    curve = LiveCurve("train", "loss", most=most)
    for step in range(1, count + 1):
        curve.add(step, 0.1 * step, 1 / step)
    return curve


@pytest.mark.parametrize("most", [8, 9])
@pytest.mark.parametrize("count", [1, 8, 9, 10, 40, 333])
def test_what_is_kept_is_evenly_spread_and_never_too_much(count: int, most: int) -> None:
    curve = grown(count, most)
    assert len(curve.steps) <= most
    assert set(np.diff(curve.steps)) <= {curve.stride}
    assert curve.steps[0] == 1
    assert count - curve.steps[-1] < curve.stride
    assert curve.latest == (count, 0.1 * count, 1 / count)
    assert curve.values == [1 / step for step in curve.steps]


def test_between_two_redrawings_it_only_grows() -> None:
    curve = LiveCurve("train", "loss", most=8)
    kept: list[int] = []
    redrawn = 0
    for step in range(1, 100):
        curve.add(step, step, 0.0)
        if curve.redrawn == redrawn:
            assert curve.steps[: len(kept)] == kept
        kept, redrawn = list(curve.steps), curve.redrawn
    assert redrawn == 4  # of 99 values every 16th is kept


def test_steps_that_a_resumed_run_repeats_take_the_place_of_those_there_were() -> None:
    curve = grown(20, 100)
    before = curve.redrawn
    for step in range(11, 31):
        curve.add(step, 5 + step, -1.0)
    assert curve.steps == list(range(1, 31))
    assert curve.values[9:11] == [0.1, -1.0]
    assert curve.redrawn == before + 1


def test_pace_is_that_of_the_last_points() -> None:
    curve = LiveCurve("train", "loss")
    assert curve.pace() is None
    for step in range(10):
        curve.add(step, step * (1.0 if step < 5 else 2.0), 0.0)
    assert curve.pace(window=4) == pytest.approx(2.0, rel=1e-12)


def test_it_reads_what_a_run_writes(queued: MakeRun) -> None:
    run = queued(loop__steps=25)
    tail = CurveTail(run.metrics_file)
    assert not tail.read()  # nothing is there yet
    execute(run, recipe=RECIPE)
    assert tail.read()
    whole = run.curves().find("train", "loss")
    assert whole is not None
    assert tail.curves["train", "loss"].values == whole.values.tolist()
    assert not tail.read()
    assert tail.find("total") is tail.curves["train", "total"]
    assert tail.find("psnr") is None


def test_a_line_waits_for_its_end_and_damaged_ones_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_text(f"{HEADER}\n0.1,train,1,loss,0.5\n0.2,train,2,lo")
    tail = CurveTail(path)
    assert tail.read()
    assert tail.curves["train", "loss"].steps == [1]
    assert not tail.read()
    with path.open("a") as file:
        file.write("ss,0.25\nnonsense\n")
    assert tail.read()
    assert tail.curves["train", "loss"].values == [0.5, 0.25]
    assert tail.damaged_lines == 1


def test_another_file_in_its_place_is_read_from_the_start(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_text(f"{HEADER}\n0.1,train,1,loss,0.5\n0.2,train,2,loss,0.4\n")
    tail = CurveTail(path)
    tail.read()
    path.write_text(f"{HEADER}\n0.1,train,1,loss,0.9\n")
    assert tail.read()
    assert tail.curves["train", "loss"].values == [0.9]


def test_a_file_that_is_none_is_told(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_text("a,b,c\n1,2,3\n")
    with pytest.raises(DataError, match=r"holds no measurements of a run; expected time_s,stage,step,name,value"):
        CurveTail(path).read()
    with pytest.raises(DataError, match="Cannot read"):
        CurveTail(tmp_path).read()
