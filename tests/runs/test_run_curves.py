"""metrics.csv grows by whole lines; what a crash leaves behind is neither read nor kept."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.errors import DataError
from toolkit.runs.curves import HEADER, Curves, CurveWriter, read_curves


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "metrics.csv"


def write(path: Path, *rows: tuple[float, int, float]) -> None:
    with closing(CurveWriter(path)) as writer:
        for seconds, step, value in rows:
            writer.write(seconds, "train", step, {"loss": value})


def test_values_come_back_by_stage_and_name(path: Path) -> None:
    with closing(CurveWriter(path)) as writer:
        writer.write(0.5, "train", 1, {"loss": 0.25, "psnr": 20.0})
        writer.write(1.0, "train", 2, {"loss": 1 / 3})
        writer.write(1.5, "evaluate", 1, {"loss": float("nan")})
    curves = read_curves(path)
    assert [(curve.stage, curve.name) for curve in curves.curves] == [
        ("train", "loss"),
        ("train", "psnr"),
        ("evaluate", "loss"),
    ]
    loss = curves.find("train", "loss")
    assert loss is not None
    assert loss.steps.tolist() == [1, 2]
    assert loss.seconds.tolist() == [0.5, 1.0]
    assert loss.values.tolist() == [0.25, 1 / 3]  # the shortest text that gives the same number back
    assert curves.find("train", "nothing") is None
    nan = curves.find("evaluate", "loss")
    assert nan is not None
    assert np.isnan(nan.values).all()


def test_each_step_can_be_read_at_once(path: Path) -> None:
    with closing(CurveWriter(path)) as writer:
        for step in range(1, 4):
            writer.write(step, "train", step, {"loss": 1.0})
            loss = read_curves(path).find("train", "loss")
            assert loss is not None
            assert len(loss.steps) == step


def test_the_file_is_plain_csv_whatever_names_say(path: Path) -> None:
    with closing(CurveWriter(path)) as writer:
        writer.write(0, 'a,b"c\nd', 1, {"x,y\r": 2.0})
    lines = path.read_text().split("\n")
    assert lines == [HEADER, "0.000,a_b_c_d,1,x_y_,2.0", ""]


@pytest.mark.parametrize("torn", ["1.000,train,3,lo", "1.000,train,3,loss,0.", "\x00\x00"])
def test_an_unended_last_line_is_not_read_and_is_cut_off_by_the_next_writer(path: Path, torn: str) -> None:
    write(path, (0.1, 1, 5.0), (0.2, 2, 4.0))
    with path.open("a") as file:
        file.write(torn)
    before = read_curves(path)
    assert before.damaged_lines == 0
    assert before.curves[0].steps.tolist() == [1, 2]
    write(path, (0.3, 3, 3.0))
    after = read_curves(path)
    assert after.damaged_lines == 0
    assert after.curves[0].values.tolist() == [5.0, 4.0, 3.0]
    assert torn not in path.read_text().split("\n")


def test_steps_that_a_resumed_run_repeats_count_once_with_the_new_value(path: Path) -> None:
    write(path, (1, 1, 9.0), (2, 2, 8.0), (3, 3, 7.0))
    write(path, (4, 2, 80.0), (5, 3, 70.0), (6, 4, 60.0))
    loss = read_curves(path).curves[0]
    assert loss.steps.tolist() == [1, 2, 3, 4]
    assert loss.values.tolist() == [9.0, 80.0, 70.0, 60.0]
    assert loss.seconds.tolist() == [1.0, 4.0, 5.0, 6.0]


def test_a_resumed_run_counts_its_time_on(path: Path) -> None:
    write(path, (1.5, 1, 1.0), (7.25, 2, 1.0))
    with closing(CurveWriter(path)) as writer:
        assert writer.seconds == 7.25


def test_damaged_lines_are_left_out_and_counted(path: Path) -> None:
    write(path, (0.1, 1, 5.0))
    with path.open("a") as file:
        file.write(
            "what?\n0.2,train,two,loss,4.0\nnan,train,2,loss,4.0\n0.2,train,2,loss,much\n\x00\x00\n0.3,train,3,loss,3\n"
        )
    curves = read_curves(path)
    assert curves.damaged_lines == 5
    assert curves.curves[0].steps.tolist() == [1, 3]


def test_another_file_is_refused_by_reader_and_writer(path: Path) -> None:
    path.write_text("step,loss\n1,2")
    for attempt in (read_curves, CurveWriter):
        with pytest.raises(DataError, match="holds no measurements of a run; expected time_s,stage"):
            attempt(path)
    assert path.read_text() == "step,loss\n1,2"


@pytest.mark.parametrize("begun", ["", HEADER[:7], HEADER])
def test_a_file_that_a_run_only_just_made_holds_nothing_yet(path: Path, begun: str) -> None:
    path.write_text(begun)
    assert read_curves(path) == Curves((), 0)
    write(path, (0.1, 1, 5.0))
    assert read_curves(path).curves[0].values.tolist() == [5.0]


def test_a_file_of_one_unended_line_that_is_no_header_is_refused(path: Path) -> None:
    path.write_text("step,loss")
    with pytest.raises(DataError, match="found 'step,loss'"):
        read_curves(path)


def test_a_missing_file_is_told(path: Path) -> None:
    with pytest.raises(DataError, match=r"Cannot read .*metrics\.csv"):
        read_curves(path)


@given(st.binary(max_size=300))
def test_whatever_follows_the_header_never_breaks_the_reader(
    tmp_path_factory: pytest.TempPathFactory, rest: bytes
) -> None:
    path = tmp_path_factory.mktemp("curves") / "metrics.csv"
    path.write_bytes(HEADER.encode() + b"\n0.1,train,1,loss,5.0\n" + rest)
    loss = read_curves(path).find("train", "loss")
    assert loss is not None
    assert 1 in loss.steps
