"""Commands on data: make a sample, list and fetch public data sets."""

from __future__ import annotations

import argparse
from pathlib import Path

from toolkit.cli.common import add, with_bar


def add_commands(commands: argparse._SubParsersAction, *, with_sample_flags: bool) -> None:
    """Add all commands on data."""
    _add_sample(commands, with_sample_flags)
    _add_data(commands)


def _add_sample(commands: argparse._SubParsersAction, with_flags: bool) -> None:
    added = add(
        commands,
        "sample",
        _sample,
        "Make pictures of a scene whose truth is known.",
        "sample town --to town/ --flight.frames 32",
    )
    added.add_argument(
        "kind",
        choices=("town", "orbit-video", "spiral-video"),
        help="pictures of the town, or a filmed flight over it",
    )
    added.add_argument("--to", type=Path, required=True, metavar="FOLDER", help="new folder to write")
    added.add_argument("--seed", type=int, default=0, help="of every random choice [0]")
    if with_flags:
        from toolkit.samples.drone_flights import KeyframeStep
        from toolkit.samples.make import SampleSettings

        SampleSettings.add_flags(added)
        KeyframeStep.add_flags(added)


def _sample(arguments: argparse.Namespace) -> None:
    from toolkit.samples.drone_flights import FLIGHTS, make_drone_flight
    from toolkit.samples.make import SampleSettings, make_sample

    filmed = FLIGHTS.get(arguments.kind.removesuffix("-video"))
    if filmed is not None:
        wanted = filmed.from_flags(arguments)
        flight = with_bar(lambda bar: make_drone_flight(arguments.to, wanted, seed=arguments.seed, progress=bar))
        print(f"{len(flight.numbers)} keyframes, {flight.video.name} and the truth written to {arguments.to}")
        return

    settings = SampleSettings.from_flags(arguments)
    with_bar(lambda bar: make_sample(arguments.to, settings, seed=arguments.seed, progress=bar))
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
