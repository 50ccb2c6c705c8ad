"""The command that makes a paper's table, with a recipe that takes no time in the place of a method."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import pytest
from fake_recipe import RECIPE, FakeSettings, write_photos

from toolkit.cli import main
from toolkit.errors import Cancelled
from toolkit.files import write_json
from toolkit.progress import ProgressEvent
from toolkit.recipes import registry
from toolkit.recipes.nerf import NERF
from toolkit.recipes.sat_heights import RECIPE as SAT_HEIGHTS
from toolkit.runs import paper_runs
from toolkit.runs.index import list_runs
from toolkit.samples import city, drone_flights, engine, nadir_flight
from toolkit.samples.city import CitySettings
from toolkit.samples.data_set import MARKER
from toolkit.samples.nadir_flight import NadirFlightSettings
from toolkit.samples.registry import find_data_set

NAME = "noposegs"


@pytest.fixture(autouse=True)
def one_recipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "all_recipes", lambda: {NAME: dataclasses.replace(RECIPE, name=NAME)})
    monkeypatch.delenv("TOOLKIT_DATA", raising=False)
    monkeypatch.setenv("TOOLKIT_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def places(tmp_path: Path) -> list[str]:
    return ["--runs", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]


def test_a_table_is_made_of_named_data_and_taken_again(
    tmp_path: Path, places: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    photos = write_photos(tmp_path / "my_photos")
    command = ["table", "a-3dgs", "--data", str(photos), "--rows", "sensor-dpt", NAME, *places]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert r"## Means over 1 data set: my\_photos" in said
    assert said.index("| NoposeGS | 1 of 1 |") < said.index("| Sensor-DPT | 0 of 1 | not there: no recipe")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "renders_median.png",
        "renders_worst.png",
        "table3.csv",
        "table3.md",
        "table3.tex",
        "trajectories_my_photos.html",
    ]
    assert main(command) == 0
    assert len(list_runs(tmp_path / "runs")) == 1
    assert main([*command, "--force"]) == 0
    assert len(list_runs(tmp_path / "runs")) == 2


def test_without_data_the_two_flights_and_photographs_are_taken(
    tmp_path: Path, places: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tiny = {"town.trees": 0, "flight.frames": 6, "flight.image_width": 32, "flight.image_height": 24}
    flights = {
        name: lambda made=made: made().replace({**tiny, "keyframe_every": 1})
        for name, made in drone_flights.FLIGHTS.items()
    }
    monkeypatch.setattr(drone_flights, "FLIGHTS", flights)
    monkeypatch.setenv("TOOLKIT_DATA", str(tmp_path))
    write_photos(tmp_path / "uav_sheffield_cross")
    # Fetched earlier, and not in the folder of data.
    fetched = write_photos(tmp_path / "cache" / "uav_brighton_beach")
    write_json(fetched / MARKER, {"content": find_data_set("uav_brighton_beach").content()})
    assert main(["table", "a-3dgs", "--rows", NAME, *places]) == 0
    said = capsys.readouterr().out
    assert r"## Means over 4 data sets: orbit, spiral, uav\_brighton\_beach, uav\_sheffield\_cross" in said
    assert "| NoposeGS | 4 of 4 |" in said
    # The flights' folder is none of them, and the same photographs need one run.
    assert len(list_runs(tmp_path / "runs")) == 3
    assert drone_flights.open_drone_flight(tmp_path / "runs" / ".data" / "orbit-0").numbers.size == 6


def test_a_folder_of_data_that_is_not_there_is_told_before_anything_is_made(
    tmp_path: Path, places: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TOOLKIT_DATA", str(tmp_path / "nowhere"))
    assert main(["table", "a-3dgs", "--rows", NAME, *places]) == 2
    assert "TOOLKIT_DATA names no folder" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_an_unknown_row_and_two_folders_of_one_name_are_told(
    tmp_path: Path, places: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["table", "a-3dgs", "--rows", "nothing", *places]) == 2
    assert "Unknown row 'nothing'; expected one of colmap-3dgs, colmap-3dgs-spatial, cf-3dgs" in (
        capsys.readouterr().err
    )
    twice = [str(write_photos(tmp_path / part / "same")) for part in "ab"]
    assert main(["table", "a-3dgs", "--data", *twice, *places]) == 2
    assert "Two data folders have the same name; expected names that tell columns apart." in capsys.readouterr().err


def test_data_that_are_no_capture_end_the_table_before_any_run(
    tmp_path: Path, places: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["table", "a-3dgs", "--data", str(tmp_path / "nowhere"), *places]) == 2
    assert "nowhere is missing" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_a_stopped_table_says_so(
    tmp_path: Path, places: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: object, **__: object) -> ProgressEvent:
        raise Cancelled("enough")

    monkeypatch.setattr(paper_runs, "execute", stop)
    photos = write_photos(tmp_path / "photos")
    assert main(["table", "a-3dgs", "--data", str(photos), "--rows", NAME, *places]) == 130
    assert "stopped: enough" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_tables_of_radiance_fields_are_made_of_segments_of_a_film(
    tmp_path: Path, places: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    quick = dataclasses.replace(NERF, run=lambda data, _, context: RECIPE.run(data, FakeSettings(), context))
    monkeypatch.setattr(registry, "all_recipes", lambda: {"nerf": quick})
    tiny = {"film.samples": 1, "film.step": 0.5, "borescope.image_width": 48, "borescope.image_height": 36}
    film = engine.make_engine(tmp_path / "film", engine.EngineSettings().replace({**tiny, "film.frames": 40}))
    command = ["table", "blades-nerf", "--data", str(film.folder), "--stride", "8", *places]
    assert main([*command, "--rows", "nerf-40", "nerf-80", "ds-nerf-40"]) == 0
    said = capsys.readouterr().out
    assert "one frame in 8 of it" in said
    # Half a blade, 19 frames, holds two of every eighth.
    assert "from each picture and the 2 that follow it" in said
    lines = [line for line in said.splitlines() if line.startswith("| ")]
    assert lines[1].startswith("| NeRF, 40 frames | ")
    assert lines[1].endswith(" | 36.2, 0.9414, 0.1321 |")
    assert lines[2].startswith("| NeRF, 80 frames | not applicable: the film has 40 frames |")
    assert lines[4].startswith("| DS-NeRF, 40 frames, weight 0.1 | not there: no recipe 'ds-nerf' |")
    assert len(list_runs(tmp_path / "runs")) == 1
    assert (tmp_path / "out" / "tables2and3.md").is_file()
    assert main([*command, "--stride", "0"]) == 2
    assert "A stride must be positive" in capsys.readouterr().err


def test_the_satellite_table_makes_its_city_and_names_what_is_not_there(
    tmp_path: Path, places: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    quick = dataclasses.replace(SAT_HEIGHTS, run=lambda data, _, context: RECIPE.run(data, FakeSettings(), context))
    monkeypatch.setattr(registry, "all_recipes", lambda: {"sat-heights": quick})
    asked: list[tuple[Path, dict[str, object], int]] = []

    def make_city(folder: Path, settings: CitySettings, *, seed: int, progress: object) -> SimpleNamespace:
        asked.append((folder, settings.to_dict(), seed))
        return SimpleNamespace(folder=write_photos(folder))

    monkeypatch.setattr(city, "make_city", make_city)
    assert main(["table", "satellite-3d", "--rows", "heights", "colmap", "--seed", "4", *places]) == 0
    said = capsys.readouterr().out
    assert asked == [(tmp_path / "runs" / ".data" / "city-4", CitySettings().to_dict(), 4)]
    assert "| COLMAP + 3DGS | not there: no recipe 'sat-colmap-3dgs' |" in said
    assert "| RPCs, heights matched over the ground | " in said
    assert said.index("| COLMAP") < said.index("| RPCs, heights")
    assert (tmp_path / "out" / "methods.md").is_file()
    assert len(list_runs(tmp_path / "runs")) == 1


def test_the_tables_on_localisation_take_the_nadir_flight_and_photographs_with_a_split(
    tmp_path: Path, places: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        registry, "all_recipes", lambda: {"2dgs-dense": dataclasses.replace(RECIPE, name="2dgs-dense")}
    )
    monkeypatch.setenv("TOOLKIT_DATA", str(tmp_path))
    write_photos(tmp_path / "uav_sheffield_cross")
    asked: list[tuple[Path, dict[str, object], int]] = []

    def make_flight(folder: Path, settings: NadirFlightSettings, *, seed: int, progress: object) -> None:
        asked.append((folder, settings.to_dict(), seed))
        # Other pictures than the photographs: the same ones would need one run.
        write_photos(folder, seed=1)

    monkeypatch.setattr(nadir_flight, "make_nadir_flight", make_flight)
    command = ["table", "uav-localization", "--rows", "2dgs-sparse", "2dgs-dense", "--seed", "3", *places]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert asked == [(tmp_path / "runs" / ".data" / "nadir-3", NadirFlightSettings().to_dict(), 3)]
    assert said.index("## nadir") < said.index("## uav_sheffield_cross")
    assert "| 2DGS, sparse start | not there: no recipe '2dgs-sparse' |" in said
    # It has no measures of a map, and nothing is made up for it.
    assert "| 2DGS, dense start | sfm-test | ours | not run |" in said
    assert (tmp_path / "out" / "tables1to3.md").is_file()
    assert len(list_runs(tmp_path / "runs")) == 2


def test_settings_are_changed_for_the_methods_that_have_them(
    tmp_path: Path, places: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        registry, "all_recipes", lambda: {"2dgs-dense": dataclasses.replace(RECIPE, name="2dgs-dense")}
    )
    photos = write_photos(tmp_path / "flight")
    name, value = next(item for item in RECIPE.settings_type().items() if type(item[1]) is int)
    command = ["table", "uav-localization", "--rows", "2dgs-dense", "--data", str(photos), *places]
    assert main([*command, "--set", f"{name}={value + 1}"]) == 0
    (run,) = list_runs(tmp_path / "runs")
    assert run.run.record().flat_settings[name] == value + 1
    capsys.readouterr()
    assert main([*command, "--set", "localise.often=1"]) == 2
    assert "localise" in capsys.readouterr().err
