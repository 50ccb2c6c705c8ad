"""Commands on data: make a sample, list and fetch public data sets."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.common import add, with_bar

if TYPE_CHECKING:
    from toolkit.settings import Settings


def add_commands(commands: argparse._SubParsersAction, *, with_sample_flags: bool) -> None:
    """Add all commands on data."""
    _add_sample(commands, with_sample_flags)
    _add_data(commands)


#: The kinds of samples: what each is, and an example.
_KINDS = {
    "town": ("Pictures of a town from a flight over it.", "--flight.frames 32"),
    "orbit-video": ("A filmed flight around the town.", "--flight.frames 180"),
    "spiral-video": ("A filmed flight over the town that widens turn by turn.", "--flight.turns 2"),
    "nadir": ("A flight that looks straight down: photos for a map, and queries between them.", "--path.height 60"),
    "nadir-queries": (
        "Queries for the map of a nadir flight: other light, heights, places, a descent.",
        "--queries.kind descent",
    ),
    "engine": ("The blades of an engine, alike but for faint wear, seen by a borescope.", "--film.frames 990"),
    "city": ("A city seen by a satellite: RPCs, suns, air, and the true surface.", "--orbit.views 20"),
}


def _add_sample(commands: argparse._SubParsersAction, with_flags: bool) -> None:
    added = commands.add_parser(
        "sample",
        help="Make pictures of a scene whose truth is known.",
        description="Make pictures of a scene whose truth is known. Each kind has settings of its own: "
        "toolkit sample KIND --help.",
        epilog="Example: toolkit sample town --to town/",
    )
    kinds = added.add_subparsers(title="kinds", metavar="KIND", required=True)
    for kind, (help, example) in _KINDS.items():
        one = add(kinds, kind, _sample, help, f"sample {kind} --to {kind}/ {example}")
        one.set_defaults(kind=kind)
        one.add_argument("--to", type=Path, required=True, metavar="FOLDER", help="new folder to write")
        one.add_argument("--seed", type=int, default=0, help="of every random choice [0]")
        if with_flags:
            _settings_of(kind).add_flags(one)


def _settings_of(kind: str) -> type[Settings]:
    from toolkit.samples.city import CitySettings
    from toolkit.samples.drone_flights import FLIGHTS
    from toolkit.samples.engine import EngineSettings
    from toolkit.samples.make import SampleSettings
    from toolkit.samples.nadir_flight import NadirFlightSettings
    from toolkit.samples.nadir_queries import NadirQuerySampleSettings

    others: dict[str, type[Settings]] = {
        "engine": EngineSettings,
        "city": CitySettings,
        "nadir": NadirFlightSettings,
        "nadir-queries": NadirQuerySampleSettings,
    }
    if kind in others:
        return others[kind]
    return FLIGHTS.get(kind.removesuffix("-video"), SampleSettings)


def _sample(arguments: argparse.Namespace) -> None:
    from toolkit.samples.city import CitySettings, make_city
    from toolkit.samples.drone_flights import OrbitVideoSettings, make_drone_flight
    from toolkit.samples.engine import EngineSettings, make_engine
    from toolkit.samples.make import SampleSettings, make_sample
    from toolkit.samples.nadir_flight import NadirFlightSettings, make_nadir_flight
    from toolkit.samples.nadir_queries import NadirQuerySampleSettings, make_nadir_queries

    wanted = _settings_of(arguments.kind).from_flags(arguments)
    if isinstance(wanted, OrbitVideoSettings):
        filming = wanted
        flight = with_bar(lambda bar: make_drone_flight(arguments.to, filming, seed=arguments.seed, progress=bar))
        print(f"{len(flight.numbers)} keyframes, {flight.video.name} and the truth written to {arguments.to}")
        return
    if isinstance(wanted, EngineSettings):
        turning = wanted
        engine = with_bar(lambda bar: make_engine(arguments.to, turning, seed=arguments.seed, progress=bar))
        arc = f"{engine.angles[-1]:g} degrees"
        print(f"{len(engine.scene)} pictures over {arc} and the truth written to {arguments.to}")
        return
    if isinstance(wanted, CitySettings):
        passing = wanted
        city = with_bar(lambda bar: make_city(arguments.to, passing, seed=arguments.seed, progress=bar))
        print(f"{len(city.views)} pictures from orbit and the true surface written to {arguments.to}")
        return
    if isinstance(wanted, NadirFlightSettings):
        flying = wanted
        scene = with_bar(lambda bar: make_nadir_flight(arguments.to, flying, seed=arguments.seed, progress=bar))
        queries = sum(frame.split == "test" for frame in scene.frames)
        print(f"{len(scene) - queries} photos for a map and {queries} queries written to {arguments.to}")
        return
    if isinstance(wanted, NadirQuerySampleSettings):
        asked = wanted
        scene = with_bar(
            lambda bar: make_nadir_queries(
                arguments.to, asked.flight, asked.queries, seed=arguments.seed, progress=bar
            )
        )
        print(f"{len(scene)} queries written to {arguments.to}")
        return
    assert isinstance(wanted, SampleSettings)
    with_bar(lambda bar: make_sample(arguments.to, wanted, seed=arguments.seed, progress=bar))
    print(f"Sample written to {arguments.to}")


def _add_data(commands: argparse._SubParsersAction) -> None:
    added = add(
        commands,
        "data",
        _data,
        "List public data sets, or fetch one and print where it is.",
        "data uav_brighton_beach",
    )
    added.add_argument("name", nargs="?", metavar="NAME", help="fetch this one")
    added.add_argument(
        "--cache", type=Path, metavar="DIR", help="where to keep it [$TOOLKIT_CACHE, or the system's]"
    )
    added.add_argument(
        "--allow-unverified", action="store_true", help="take files, too, whose right content is not known"
    )


def _data(arguments: argparse.Namespace) -> None:
    from toolkit.samples.registry import data_sets, fetch
    from toolkit.samples.registry_text import data_sets_text

    if arguments.name is None:
        print(data_sets_text(data_sets().values(), cache=arguments.cache))
        return
    folder = with_bar(
        lambda bar: fetch(
            arguments.name, cache=arguments.cache, allow_unverified=arguments.allow_unverified, progress=bar
        )
    )
    print(folder)
