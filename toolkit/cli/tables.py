"""The command that makes a paper's table and figures on our data."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from toolkit.cli.common import add, with_bar
from toolkit.errors import DataError, SettingsError

if TYPE_CHECKING:
    from toolkit.progress import Progress
    from toolkit.recipes.base import Recipe
    from toolkit.runs.nerf_table import NerfRow
    from toolkit.runs.paper_rows import PaperRow
    from toolkit.runs.paper_runs import Attempt, TableOptions
    from toolkit.samples.drone_flights import OrbitVideoSettings

Row = TypeVar("Row", "PaperRow", "NerfRow")


class MarkdownTable(Protocol):
    """A table that can be printed."""

    def markdown(self) -> str:
        """Return it as Markdown."""


#: Data sets of photographs that the table takes where they are on this machine.
_PHOTOS = ("uav_brighton_beach", "uav_sheffield_cross")
_BLADES, _NERF, _SATELLITE = "blades-camera-models", "blades-nerf", "satellite-3d"
_LOCALIZATION = "uav-localization"
#: Photographs that this table takes: their split into map and queries is given.
_SPLIT_PHOTOS = ("uav_sheffield_cross",)
#: Frames that each is matched with on the whole film of blades-nerf, as in the paper, and half a blade of it.
_WINDOW, _HALF_BLADE = 15, 19
#: Folder beside the runs in which samples are made; its dot keeps it out of lists of runs.
_FLIGHTS = ".data"


def add_commands(commands: argparse._SubParsersAction) -> None:
    """Add the command."""
    added = add(
        commands,
        "table",
        _table,
        "Make a paper's table on our data, with the paper's figures beside it.",
        "table a-3dgs --rows sensor-3dgs colmap-3dgs-spatial --train-steps 300",
    )
    added.add_argument(
        "paper",
        choices=("a-3dgs", _BLADES, _NERF, _SATELLITE, _LOCALIZATION),
        help=f"which one: a-3dgs, Table 3 of the drone paper; {_BLADES}, Table 1 of the paper on blades; {_NERF}, "
        f"its Tables 2 and 3; {_SATELLITE}, what the satellite paper measures; {_LOCALIZATION}, Tables 1 to 3 of "
        "the paper on localisation",
    )
    added.add_argument(
        "--data",
        type=Path,
        nargs="+",
        metavar="FOLDER",
        help="captures [a-3dgs: two filmed flights over the town, made beside the runs, and of the data sets here "
        + " and ".join(_PHOTOS)
        + f"; {_BLADES}: 98 degrees of an engine, made beside the runs; {_NERF}: films with poses, of which "
        f"segments are cut; 40 degrees of an engine, made beside the runs; {_SATELLITE}: a city seen from orbit, "
        f"made beside the runs; {_LOCALIZATION}: a nadir flight over the town, made beside the runs, and of the "
        f"data sets here {' and '.join(_SPLIT_PHOTOS)}]",
    )
    added.add_argument("--rows", nargs="+", metavar="ROW", help="methods [all]")
    added.add_argument("--runs", type=Path, metavar="DIR", help="folder of runs [runs/ and the name of the table]")
    added.add_argument(
        "--out", type=Path, metavar="DIR", help="where tables and figures go [docs/results/ and its name]"
    )
    added.add_argument(
        "--window",
        type=int,
        metavar="N",
        help=f"{_BLADES} and {_NERF}: frames that each is matched with [4; {_NERF}: {_WINDOW} at most, and less "
        "than half a blade at the stride]",
    )
    added.add_argument(
        "--stride",
        type=int,
        default=1,
        metavar="N",
        help=f"{_NERF}: take every so many frames of each segment, where time demands it [1]",
    )
    added.add_argument("--train-steps", type=int, metavar="N", help="steps of every training [each recipe's own]")
    added.add_argument("--max-side", type=int, metavar="N", help="pixels of the longer side [each recipe's own]")
    added.add_argument(
        "--fit-steps",
        type=int,
        default=100,
        metavar="N",
        help="steps that fit each test photo's pose to the splat, for a column of its own; 0: leave it out [100]",
    )
    added.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change a setting of every method that has it",
    )
    added.add_argument("--seed", type=int, default=0, help="of every random choice [0]")
    added.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to compute [cpu]")
    added.add_argument("--force", action="store_true", help="make finished runs again")


def _table(arguments: argparse.Namespace) -> None:
    arguments.runs = arguments.runs or Path("runs") / arguments.paper
    arguments.out = arguments.out or Path("docs/results") / arguments.paper
    if arguments.paper == _BLADES:
        _blades(arguments)
    elif arguments.paper == _NERF:
        _nerf(arguments)
    elif arguments.paper == _SATELLITE:
        _satellite(arguments)
    elif arguments.paper == _LOCALIZATION:
        _localization(arguments)
    else:
        _drones(arguments)


def _attempts(
    arguments: argparse.Namespace,
    rows: Sequence[PaperRow],
    wishes: Mapping[str, Any],
    usual: Callable[[Progress], Mapping[str, Path]],
) -> list[Attempt]:
    """Run the rows on the data that are named, or on the usual ones."""
    from toolkit.recipes import registry
    from toolkit.runs.paper_runs import make_attempts

    options = _options(arguments, rows, wishes)
    given = None if arguments.data is None else _named(arguments.data)

    def work(bar: Progress) -> list[Attempt]:
        data = usual(bar) if given is None else given
        return make_attempts(rows, data, registry.all_recipes(), options, progress=bar)

    return with_bar(work)


def _changes(recipes: Sequence[Recipe], texts: Sequence[str]) -> dict[str, Any]:
    """Return settings by their names from texts ``key=value``: each is one that any of the methods has."""
    plain = [recipe.settings_type() for recipe in recipes]
    changes: dict[str, Any] = {}
    for text in texts if plain else ():
        name = text.partition("=")[0].strip()
        # Where none has it, the first one says what is wrong.
        owner = next((settings for settings in plain if name in dict(settings.items())), plain[0])
        changes[name] = dict(owner.replace_from_text([text]).items())[name]
    return changes


def _options(arguments: argparse.Namespace, rows: Sequence[PaperRow], wishes: Mapping[str, Any]) -> TableOptions:
    """Return how runs are made; a wish of None is none, and what ``--set`` says comes last."""
    from toolkit.recipes import registry
    from toolkit.runs.paper_runs import TableOptions

    known = registry.all_recipes()
    changes = {name: value for name, value in wishes.items() if value is not None}
    changes |= _changes([known[row.recipe] for row in rows if row.recipe in known], arguments.set)
    return TableOptions(arguments.runs, changes, arguments.seed, arguments.device, arguments.force)


def _tell(tables: Sequence[MarkdownTable], file: Path) -> None:
    print("\n".join(table.markdown() for table in tables))
    print(f"Wrote {file}")


def _blades(arguments: argparse.Namespace) -> None:
    from toolkit.runs.blades_table import ROWS, arc_tables, write_arc_tables

    wishes = {"pairs.overlap": 4 if arguments.window is None else arguments.window}
    rows = _rows(ROWS, arguments.rows)
    tables = arc_tables(
        _attempts(arguments, rows, wishes, lambda bar: {"engine": _engine(arguments.runs, arguments.seed, bar)})
    )
    _tell(tables, write_arc_tables(tables, arguments.out))


def _engine(runs_dir: Path, seed: int, progress: Progress) -> Path:
    """Return the segment of the engine that the table takes, made where it is missing: 98 degrees, 0.4 a frame."""
    from toolkit.samples.engine import EngineSettings, make_engine

    settings = EngineSettings().replace({"film.frames": 246, "film.stride": 4})
    return make_engine(runs_dir / _FLIGHTS / f"engine-{seed}", settings, seed=seed, progress=progress).folder


def _nerf(arguments: argparse.Namespace) -> None:
    from toolkit.recipes import registry
    from toolkit.runs.nerf_runs import make_nerf_attempts
    from toolkit.runs.nerf_table import ROWS, nerf_tables, write_nerf_tables

    stride = arguments.stride
    if stride < 1:
        raise SettingsError("A stride must be positive", expected="a whole number from 1", found=str(stride))
    rows = _rows(ROWS, arguments.rows)
    usual = max(1, min(_WINDOW, _HALF_BLADE // stride))
    window = usual if arguments.window is None else arguments.window
    wishes = {
        "scene.points.pairs.overlap": window,
        "train.steps": arguments.train_steps,
        "train.max_side": arguments.max_side,
    }
    options = _options(arguments, [row.row for row in rows], wishes)
    given = None if arguments.data is None else _named(arguments.data)

    def work(bar: Progress) -> list[Any]:
        films = given if given is not None else {"engine": _film(arguments.runs, arguments.seed, bar)}
        return make_nerf_attempts(
            rows,
            films,
            registry.all_recipes(),
            options,
            stride=stride,
            segments=arguments.runs / _FLIGHTS / "segments",
            progress=bar,
        )

    tables = nerf_tables(with_bar(work), stride=stride, window=window)
    _tell(tables, write_nerf_tables(tables, arguments.out))


def _film(runs_dir: Path, seed: int, progress: Progress) -> Path:
    """Return the film of which segments are cut, made where it is missing: 40 degrees, a blade in 40 frames."""
    from toolkit.runs.nerf_table import LONGEST
    from toolkit.samples.engine import EngineSettings, make_engine

    settings = EngineSettings().replace({"film.frames": LONGEST})
    return make_engine(runs_dir / _FLIGHTS / f"film-{seed}", settings, seed=seed, progress=progress).folder


def _satellite(arguments: argparse.Namespace) -> None:
    from toolkit.runs.satellite_table import ROWS, satellite_tables, write_satellite_tables

    wishes = {"train.steps": arguments.train_steps, "train.max_side": arguments.max_side}
    rows = _rows(ROWS, arguments.rows)
    tables = satellite_tables(
        _attempts(arguments, rows, wishes, lambda bar: {"city": _city(arguments.runs, arguments.seed, bar)})
    )
    _tell(tables, write_satellite_tables(tables, arguments.out))


def _city(runs_dir: Path, seed: int, progress: Progress) -> Path:
    """Return the city that the table takes, made where it is missing: 20 views of 256 m, half a metre a pixel."""
    from toolkit.samples.city import CitySettings, make_city

    return make_city(runs_dir / _FLIGHTS / f"city-{seed}", CitySettings(), seed=seed, progress=progress).folder


def _localization(arguments: argparse.Namespace) -> None:
    from toolkit.runs.localization_rows import ROWS
    from toolkit.runs.localization_table import localization_tables, write_localization_tables

    wishes = {"train.steps": arguments.train_steps, "train.max_side": arguments.max_side}
    rows = _rows(ROWS, arguments.rows)
    tables = localization_tables(
        _attempts(arguments, rows, wishes, lambda bar: _mapped(arguments.runs, arguments.seed, bar))
    )
    _tell(tables, write_localization_tables(tables, arguments.out))


def _mapped(runs_dir: Path, seed: int, progress: Progress) -> dict[str, Path]:
    """Return the nadir flight, made where it is missing, and the photographs with a split that are there."""
    from toolkit.samples.nadir_flight import NadirFlightSettings, make_nadir_flight

    photos = _located(_SPLIT_PHOTOS)
    folder = runs_dir / _FLIGHTS / f"nadir-{seed}"
    make_nadir_flight(folder, NadirFlightSettings(), seed=seed, progress=progress)
    return {"nadir": folder} | photos


def _drones(arguments: argparse.Namespace) -> None:
    from toolkit.runs.paper_figures import render_grid, write_trajectories
    from toolkit.runs.paper_rows import ROWS
    from toolkit.runs.paper_table import paper_table
    from toolkit.runs.paper_text import table_markdown, write_table

    rows = _rows(ROWS, arguments.rows)
    wishes = {
        "train.steps": arguments.train_steps,
        "train.max_side": arguments.max_side,
        "train.refine_test_steps": arguments.fit_steps,
    }
    attempts = _attempts(arguments, rows, wishes, lambda bar: _usual_data(arguments.runs, arguments.seed, bar))
    table = paper_table(attempts)
    files = write_table(table, arguments.out)
    for rank in ("median", "worst"):
        files.append(arguments.out / f"renders_{rank}.png")
        render_grid(attempts, files[-1], rank=rank)
    files += write_trajectories(attempts, arguments.out)
    print(table_markdown(table))
    print("Wrote " + ", ".join(str(path) for path in files))


def _rows(rows: Sequence[Row], names: Sequence[str] | None) -> list[Row]:
    """Return the rows of these names, in the table's order."""
    known = [row.key for row in rows]
    unknown = [name for name in names or () if name not in known]
    if unknown:
        raise SettingsError(f"Unknown row '{unknown[0]}'", expected="one of " + ", ".join(known))
    return [row for row in rows if names is None or row.key in names]


def _named(folders: Sequence[Path]) -> dict[str, Path]:
    """Return data folders by their last names."""
    named = {folder.resolve().name: folder for folder in folders}
    if len(named) < len(folders):
        raise DataError("Two data folders have the same name", expected="names that tell columns apart")
    return named


def _usual_data(runs_dir: Path, seed: int, progress: Progress) -> dict[str, Path]:
    """Return the filmed flights, made where they are missing, and the photographs that are there."""
    from toolkit.samples.drone_flights import FLIGHTS, make_drone_flight

    photos = _located(_PHOTOS)
    data: dict[str, Path] = {}
    for name, settings_type in FLIGHTS.items():
        settings: OrbitVideoSettings = settings_type()
        folder = runs_dir / _FLIGHTS / f"{name}-{seed}"
        data[name] = make_drone_flight(folder, settings, seed=seed, progress=progress).folder
    return data | photos


def _located(names: Sequence[str]) -> dict[str, Path]:
    """Return the folders of those data sets that are on this machine."""
    from toolkit.samples.registry import locate

    return {name: folder for name in names if (folder := locate(name)) is not None}
