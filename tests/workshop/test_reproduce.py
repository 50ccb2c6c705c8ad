"""All tables by one command: what it runs, what it writes beside them, and what it keeps apart."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import pytest

from scripts import reproduce
from scripts.reproduce import PAGE, RECORD, TABLES, main
from toolkit.cli import build_parser
from toolkit.files import read_json


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Let the command line write a table without making it, and return what it was called with."""
    calls: list[list[str]] = []

    def run(arguments: Sequence[str]) -> int:
        calls.append(list(arguments))
        given = build_parser().parse_args(list(arguments))  # it must be one that there is
        if arguments[0] == "sample":
            given.to.mkdir(parents=True)
        else:
            given.out.mkdir(parents=True, exist_ok=True)
            (given.out / "table.md").write_text("| ours | paper |", encoding="utf-8")
        return 0

    monkeypatch.setattr(reproduce, "_toolkit", run)
    return calls


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TOOLKIT_DATA", raising=False)
    return tmp_path


def test_its_tables_are_those_of_the_command_line() -> None:
    commands = next(
        action for action in build_parser()._actions if isinstance(action, argparse._SubParsersAction)
    ).choices
    (paper,) = (action for action in commands["table"]._actions if action.dest == "paper")
    assert tuple(TABLES) == tuple(paper.choices or ())


def test_every_table_is_made_at_standard_size_and_told_on_one_page(here: Path, called: list[list[str]]) -> None:
    assert main([]) == 0
    assert [call[1] for call in called] == list(TABLES)
    assert called[0] == [
        "table", "a-3dgs", "--train-steps", "1000", "--max-side", "480",
        "--runs", "runs/a-3dgs", "--out", "docs/results/a-3dgs",
    ]  # fmt: skip
    page = (here / "docs/results" / PAGE).read_text(encoding="utf-8")
    assert "Quick" not in page
    assert page.count("[table.md](") == len(TABLES)
    assert "`toolkit table blades-nerf --stride 2`" in page
    assert "Where `TOOLKIT_DATA` named no folder" in page
    assert f"## Machine of {', '.join(TABLES)}" in page
    record = read_json(here / "docs/results/a-3dgs" / RECORD)
    assert record["exit"] == 0
    assert {"cpu", "cores", "memory_gib", "python", "libraries"} <= set(record["machine"])


def test_one_table_leaves_the_others_as_they_are(here: Path, called: list[list[str]]) -> None:
    assert main(["--only", "satellite-3d"]) == 0
    assert main(["--only", "blades-nerf", "--out", "docs/results"]) == 0
    page = (here / "docs/results" / PAGE).read_text(encoding="utf-8")
    assert page.count("[table.md](") == 2


def test_calls_that_were_stopped_and_went_on_count_together(here: Path, called: list[list[str]]) -> None:
    assert main(["--only", "satellite-3d"]) == 0
    assert main(["--only", "satellite-3d"]) == 0
    assert len(read_json(here / "docs/results/satellite-3d" / RECORD)["sittings"]) == 2
    assert " in 2 calls |" in (here / "docs/results" / PAGE).read_text(encoding="utf-8")
    assert main(["--only", "satellite-3d", "--force"]) == 0
    assert called[-1][-1] == "--force"
    assert len(read_json(here / "docs/results/satellite-3d" / RECORD)["sittings"]) == 1


def test_quick_tables_are_labelled_and_stay_out_of_the_results(here: Path, called: list[list[str]]) -> None:
    assert main(["--quick"]) == 0
    assert not (here / "docs").exists()
    assert [call[0] for call in called] == ["sample", "table"] * len(TABLES)
    page = (here / "runs/quick/results" / PAGE).read_text(encoding="utf-8")
    assert "they are no results" in page
    assert "| `toolkit sample city --plan.size 64" in page
    # Their data are not made twice.
    assert main(["--quick", "--only", "a-3dgs"]) == 0
    assert called[-2][0] == "table"


def test_quick_and_standard_tables_do_not_come_into_one_folder(
    here: Path, called: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--quick", "--only", "a-3dgs", "--out", "mine"]) == 0
    assert main(["--only", "a-3dgs", "--out", "mine"]) == 2
    assert "mine holds tables of quick size; expected of standard size, or none" in capsys.readouterr().err
    assert main(["--only", "a-3dgs"]) == 0
    assert main(["--quick", "--only", "blades-nerf", "--out", "docs/results"]) == 2
    assert "holds tables of standard size; expected of quick size" in capsys.readouterr().err


def test_a_table_that_fails_does_not_keep_the_others_from_being_made(
    here: Path, called: list[list[str]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    well = reproduce._toolkit
    monkeypatch.setattr(reproduce, "_toolkit", lambda words: 2 if "blades-nerf" in words else well(words))
    assert main(["--only", "blades-nerf", "satellite-3d"]) == 2
    assert "error: not made: blades-nerf" in capsys.readouterr().err
    assert not (here / "docs/results/blades-nerf").exists()
    page = (here / "docs/results" / PAGE).read_text(encoding="utf-8")
    assert "satellite-3d/table.md" in page
    assert "Radiance" not in page


def test_where_nothing_could_be_made_there_is_no_page(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(reproduce, "_toolkit", lambda _: 2)
    assert main(["--only", "a-3dgs"]) == 2
    assert not (here / "docs").exists()
    assert main(["--quick", "--only", "a-3dgs"]) == 2
    assert "The data of the quick table a-3dgs could not be made" in capsys.readouterr().err


def test_ctrl_c_says_that_the_next_call_goes_on(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(_: Sequence[str]) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(reproduce, "_toolkit", stop)
    assert main(["--only", "a-3dgs"]) == 130
    assert "stopped; the next call goes on" in capsys.readouterr().err


@pytest.mark.slow
def test_a_quick_table_is_made_for_real(here: Path) -> None:
    assert main(["--quick", "--only", "a-3dgs"]) == 0
    table = (here / "runs/quick/results/a-3dgs/table3.md").read_text(encoding="utf-8")
    assert "| Sensor poses, matched points | 1 of 1 |" in table
    assert "*paper: Sensor-DPT*" in table
