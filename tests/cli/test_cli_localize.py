"""Photos are localised from the command line: the table, its exit code, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from ground_run import NAMES, TESTS, UNPOSED, make_ground_run
from PIL import Image

from toolkit.cli import main
from toolkit.runs.folder import RunFolder

QUICK = ["--set", "polish.use=false", "--set", "fan.most=1"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return make_ground_run(tmp_path_factory.mktemp("ground"))


@pytest.fixture
def said(run: RunFolder, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Said:
    monkeypatch.setenv("TOOLKIT_RUNS", str(run.path.parent))
    return Said(capsys)


class Said:
    """Runs the command and keeps what it prints."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys
        self.out = self.err = ""

    def __call__(self, *arguments: object) -> int:
        code = main(["localize", "latest", *map(str, arguments)])
        self.out, self.err = self._capsys.readouterr()
        return code


def test_photos_are_found_from_their_sensors_and_from_a_pose(said: Said, run: RunFolder, tmp_path: Path) -> None:
    black = tmp_path / "black.png"
    Image.fromarray(np.zeros((180, 240, 3), np.uint8)).save(black)
    answer = tmp_path / "answer.json"
    assert said(TESTS[0], UNPOSED, *QUICK) == 0
    head, first, second, last = said.out.splitlines()
    assert head.split() == [
        *("photo", "position", "[m]", "sigma", "[m]", "sigma", "[deg]", "inliers", "rounds", "seconds"),
        *("off", "[m]", "off", "[deg]"),
    ]
    assert first.split()[0] == TESTS[0]
    assert float(first.split()[-2]) < 0.05
    assert second.split()[-1] == "–"  # it has no pose to be off from
    assert last == "2 of 2 found, by ours"
    assert "localize" in said.err  # the bar
    assert (run.artifacts / "localize" / "photos" / f"{UNPOSED}.json").is_file()

    # One that is not found does no harm; where none is found the code says so.
    above = ["--start", "1,-1,42,0,-90", "--start-sigma", "5", "10"]
    assert said(black, TESTS[0], *above, *QUICK, "--json", answer) == 0
    assert "not found" in said.out
    assert "black.png: 0 of 0 matches agree" in said.out
    assert said.out.splitlines()[-1] == "1 of 2 found, by ours"
    told = json.loads(answer.read_text())
    assert told["run"] == run.id
    assert [photo["found"] for photo in told["photos"]] == [False, True]
    assert said(black, *above, *QUICK) == 1
    assert said.out.splitlines()[-1] == "0 of 1 found, by ours"


def test_one_shot_from_near_its_own_pose(said: Said) -> None:
    assert said(TESTS[1], "--start", "own", "--off", 2, 3, "--method", "one-shot", "--features", "sift") == 0
    assert said.out.splitlines()[-1] == "1 of 1 found, by one-shot-sift"


def test_a_flight_is_followed(said: Said) -> None:
    assert said(*TESTS[:2], "--sequence", "--start", "own", *QUICK) == 0
    assert "localize.sequence" in said.err
    assert said(TESTS[0], "--sequence", "--start", "own", "--method", "one-shot") == 2
    assert "error: The one shot cannot follow a flight" in said.err


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (
            ["nothing.jpg"],
            "There is no photo 'nothing.jpg'; expected a frame of the run's scene, or a picture file",
        ),
        ([NAMES[0], "--start", "there"], "The start cannot be read"),
        ([NAMES[0], "--off", "1", "1"], "--off has nothing to change; expected --start own too"),
        ([NAMES[0], "--start-sigma", "1", "1"], "--start-sigma has nothing to change"),
        ([NAMES[0], "--method", "best"], "Unknown method 'best'; expected one of ours, one-shot"),
        ([NAMES[0], "--features", "orb"], "orb"),
        ([NAMES[0], "--set", "x=1"], "Unknown setting 'x'"),
        ([UNPOSED, "--start", "own"], f"Photo '{UNPOSED}' has no pose of its own"),
    ],
)
def test_what_cannot_be_is_told(said: Said, arguments: list[str], told: str) -> None:
    assert said(*arguments) == 2
    assert said.err.startswith("error: ")
    assert told in said.err


def test_its_help_has_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main(["localize", "--help"])
    assert done.value.code == 0
    assert "Example: toolkit localize" in capsys.readouterr().out
