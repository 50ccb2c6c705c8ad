"""The command that makes samples: each kind with its own settings."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from toolkit.cli import main
from toolkit.samples.city import CitySettings
from toolkit.samples.drone_flights import OrbitVideoSettings, SpiralVideoSettings
from toolkit.samples.engine import EngineSettings
from toolkit.samples.make import SampleSettings
from toolkit.samples.nadir_flight import NadirFlightSettings
from toolkit.samples.nadir_queries import NadirQuerySampleSettings
from toolkit.settings import Settings


def help_of(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Return a help text with all its white space as single blanks."""
    with pytest.raises(SystemExit) as done:
        main([*words, "--help"])
    assert done.value.code == 0
    return " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("town", SampleSettings),
        ("orbit-video", OrbitVideoSettings),
        ("spiral-video", SpiralVideoSettings),
        ("nadir", NadirFlightSettings),
        ("nadir-queries", NadirQuerySampleSettings),
        ("engine", EngineSettings),
        ("city", CitySettings),
    ],
)
def test_the_help_of_a_kind_has_its_own_defaults(
    capsys: pytest.CaptureFixture[str], kind: str, settings: type[Settings]
) -> None:
    said = help_of(capsys, "sample", kind)
    flags = set(re.findall(r"--[a-z][a-z_.-]+", said.partition("options:")[2]))
    rows = {f"--{row.name.replace('_', '-')}": row for row in settings.table()}
    assert flags - {"--help", "--debug", "--to", "--seed"} == rows.keys()
    for flag, row in rows.items():
        unit = f" {row.unit}" if row.unit else ""
        assert re.search(rf"{flag} .*?\[{re.escape(f'{row.default}{unit}')}[\];]", said), flag


def test_the_help_of_the_command_lists_the_kinds_and_no_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    said = help_of(capsys, "sample")
    for kind in ("town", "orbit-video", "spiral-video", "nadir", "nadir-queries", "engine", "city"):
        assert kind in said
    assert "--flight" not in said


def test_a_setting_of_another_kind_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for wrong in (["town", "--keyframe-every", "3"], ["orbit-video", "--points", "3"]):
        with pytest.raises(SystemExit) as done:
            main(["sample", *wrong, "--to", "nowhere"])
        assert done.value.code == 2
        assert f"unrecognized arguments: {wrong[1]} 3" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [([], "the following arguments are required: KIND"), (["moon", "--to", "x"], "argument KIND: invalid choice")],
)
def test_a_kind_must_be_named(capsys: pytest.CaptureFixture[str], words: list[str], said: str) -> None:
    with pytest.raises(SystemExit) as done:
        main(["sample", *words])
    assert done.value.code == 2
    assert said in capsys.readouterr().err


def test_a_nadir_flight_and_further_queries_are_made(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    town = {"extent": 180, "buildings": 20, "trees": 0, "mast": "no"}
    small = {"path.map_photos": 3, "path.speed": 60, "camera.image_width": 48, "camera.image_height": 36}
    flight = {**{f"town.{name}": value for name, value in town.items()}, **small, "camera.samples": 1}

    def flags(before: str = "") -> list[str]:
        return [
            word for name, value in flight.items() for word in (f"--{before}{name.replace('_', '-')}", str(value))
        ]

    assert main(["sample", "nadir", "--to", str(tmp_path / "flight"), "--seed", "4", *flags()]) == 0
    assert f"3 photos for a map and 2 queries written to {tmp_path / 'flight'}" in capsys.readouterr().out
    black = [*flags("flight."), "--queries.kind", "black"]
    assert main(["sample", "nadir-queries", "--to", str(tmp_path / "black"), "--seed", "4", *black]) == 0
    assert f"2 queries written to {tmp_path / 'black'}" in capsys.readouterr().out
    assert len(list((tmp_path / "black" / "images").iterdir())) == 2
