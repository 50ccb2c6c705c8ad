"""Commands on sweeps, with a recipe that takes no time."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fake_recipe import RECIPE, write_photos
from fake_sweeps import in_this_process

from toolkit.cli import main
from toolkit.recipes import registry
from toolkit.runs import mlflow_mirror, sweep_run
from toolkit.runs import sweep as sweeps
from toolkit.runs.mlflow_mirror import MirrorReport
from toolkit.runs.sweep_record import SweepFolder, list_sweeps


@pytest.fixture(autouse=True)
def one_recipe(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "all_recipes", lambda: {"fake": RECIPE})
    monkeypatch.setattr(sweep_run, "_workers", in_this_process)


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TOOLKIT_RUNS", str(tmp_path / "runs"))
    return tmp_path / "runs"


@pytest.fixture
def photos(tmp_path: Path) -> str:
    return str(write_photos(tmp_path / "photos"))


def test_a_sweep_from_its_start_to_its_table(runs: Path, photos: str, capsys: pytest.CaptureFixture[str]) -> None:
    grid = ["--grid", "loop.rate=0.1,0.5", "--grid", "loop.steps=3:5:3", "--set", "test_every=3"]
    where = ["--workers", "1", "--threads", "1", "--seed", "2", "--name", "rates"]
    assert main(["sweep", "fake", "--data", photos, *grid, *where]) == 0
    said = capsys.readouterr()
    (sweep,) = list_sweeps(runs)
    assert f"Sweep {sweep.id} in {sweep.path}" in said.err
    plan = sweep.plan()
    assert (plan.method, plan.trials, plan.objective, plan.direction) == ("grid", 6, "test.psnr", "maximise")
    assert (plan.workers, plan.threads, plan.seed, plan.settings["test_every"]) == (1, 1, 2, 3)
    best = next(line for line in said.out.splitlines() if line.startswith("Best: trial 0, test.psnr"))
    assert best.endswith(sweep.trials()[0].run)
    assert "loop.rate   0.1, 0.5" in said.out
    assert "loop.steps  3, 4, 5" in said.out

    assert main(["sweep-show", "rates"]) == 0
    assert best in capsys.readouterr().out
    assert main(["sweeps"]) == 0
    row = capsys.readouterr().out.splitlines()[1]
    assert row.split()[:6] == [sweep.id, "rates", "finished", "fake", "grid", "6/6"]
    assert main(["sweep-resume", "rates"]) == 2
    assert f"Sweep {sweep.id} is finished" in capsys.readouterr().err


def test_a_sweep_that_was_stopped_goes_on(
    runs: Path, photos: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[SweepFolder] = []
    monkeypatch.setattr(sweeps, "start_sweep", started.append)
    random = ["--random", "loop.rate=0.1:1:log", "--trials", "2", "--objective", "poses.sim3.ate", "--later"]
    assert main(["sweep", "fake", "--data", photos, *random, "--minimise", "--workers", "1"]) == 0
    (sweep,) = started
    assert sweep.plan().direction == "minimise"
    assert main(["sweep-cancel", "latest"]) == 0
    assert f"toolkit sweep-resume {sweep.id} goes on" in capsys.readouterr().out
    assert sweep.status().state == "cancelled"
    assert main(["sweep-resume", sweep.id[:-1]]) == 0
    assert "2 of 2 trials" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ([], "It is not clear what to try; expected one of --grid, --random and --tpe"),
        (["--grid", "pause=1", "--tpe", "pause=1:2"], "found --grid and --tpe"),
        (["--grid", "paus=1"], "Unknown setting 'paus'"),
        (["--random", "pause=1:2"], "The number of trials is out of range"),
        (["--grid", "pause=1", "--prune"], "Only TPE stops trials early"),
        (["--grid", "pause=1", "--preset", "draft"], "Preset 'draft' changes nothing here"),
        (["--grid", "pause=1", "--objective", "loop.total"], "It is not known which way 'loop.total' is better"),
    ],
)
def test_what_cannot_be_swept_is_told_and_makes_nothing(
    runs: Path, photos: str, capsys: pytest.CaptureFixture[str], arguments: list[str], told: str
) -> None:
    assert main(["sweep", "fake", "--data", photos, *arguments]) == 2
    assert told in capsys.readouterr().err
    assert list_sweeps(runs) == []


def test_a_folder_without_pictures_makes_no_sweep(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["sweep", "fake", "--data", str(tmp_path / "nowhere"), "--grid", "pause=1"]) == 2
    assert "nowhere" in capsys.readouterr().err
    assert list_sweeps(runs) == []


def test_damaged_sweeps_are_rows_that_say_so(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sweeps"]) == 0
    assert capsys.readouterr().out == f"No sweeps in {runs}\n"
    broken = runs / ".sweeps" / "20260101-000000-fake-abcd"
    broken.mkdir(parents=True)
    (broken / "sweep.json").write_text(json.dumps({"recipe": 1}))
    assert main(["sweeps"]) == 0
    assert "is no plan of a sweep" in capsys.readouterr().out
    assert main(["sweep-show", "2026"]) == 2


@pytest.mark.parametrize("command", ["sweep", "sweep-resume", "sweep-cancel", "sweeps", "sweep-show", "mirror"])
def test_every_help_of_sweeps_has_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main([command, "--help"])
    assert done.value.code == 0
    assert f"Example: toolkit {command}" in capsys.readouterr().out


def test_the_mirror_tells_what_it_did(
    runs: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Path, str, str]] = []

    def mirror(folder: Path, uri: str, *, experiment: str, progress: object) -> MirrorReport:
        asked.append((folder, uri, experiment))
        return MirrorReport(2, 3, 1, ("one is damaged",))

    monkeypatch.setattr(mlflow_mirror, "mirror_runs", mirror)
    assert main(["mirror", "--to", "sqlite:///m.db", "--experiment", "ours"]) == 0
    assert asked == [(runs, "sqlite:///m.db", "ours")]
    said = capsys.readouterr()
    assert said.out.startswith(
        "Mirrored 2 runs to experiment 'ours' in sqlite:///m.db; 3 were there already, 1 are"
    )
    assert said.err == "warning: one is damaged\n"
