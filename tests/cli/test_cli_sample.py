"""The command that makes samples: each kind with its own settings."""

from __future__ import annotations

import re

import pytest

from toolkit.cli import main
from toolkit.samples.city import CitySettings
from toolkit.samples.drone_flights import OrbitVideoSettings, SpiralVideoSettings
from toolkit.samples.engine import EngineSettings
from toolkit.samples.make import SampleSettings
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
        assert re.search(rf"{flag} .*?\[{re.escape(f'{row.default}{unit}')}\]", said), flag


def test_the_help_of_the_command_lists_the_kinds_and_no_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    said = help_of(capsys, "sample")
    for kind in ("town", "orbit-video", "spiral-video", "engine", "city"):
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
