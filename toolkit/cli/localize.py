"""The command that localises photos in a run's map."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.common import RUN_HELP, add, add_runs_dir, with_bar
from toolkit.errors import SettingsError

if TYPE_CHECKING:
    from toolkit.runs.folder import RunFolder
    from toolkit.runs.localize_photo import LocalizedPhoto
    from toolkit.runs.photo_start import StartChoice


def add_commands(commands: argparse._SubParsersAction) -> None:
    """Add the command."""
    added = add(
        commands,
        "localize",
        _localize,
        "Find where photos were taken, in the map that a run made. Exit code 1 where none was found.",
        "localize latest frame_0004.jpg DJI_0815.JPG --start prior --set polish.use=false",
    )
    added.add_argument("run", metavar="RUN", help=RUN_HELP)
    added.add_argument(
        "photos", nargs="+", metavar="PHOTO", help="frame of the run's scene by its name, or a picture file"
    )
    added.add_argument(
        "--start",
        default="prior",
        metavar="WHERE",
        help="where the search begins: prior (the photo's GPS and gimbal), own (the pose that the scene has for "
        "it, to try), or E,N,U,HEADING,PITCH in metres and degrees (pitch -90 looks down; write --start=-3,... "
        "where the first one is negative) [prior]",
    )
    added.add_argument(
        "--start-sigma",
        type=float,
        nargs=2,
        metavar=("M", "DEG"),
        help="standard deviations of a start that is given by numbers [10 10]",
    )
    added.add_argument("--off", type=float, nargs=2, metavar=("M", "DEG"), help="move and turn the start own [0 0]")
    added.add_argument("--method", default="ours", metavar="NAME", help="ours, or one-shot as the paper [ours]")
    added.add_argument(
        "--features",
        metavar="NAME",
        help="sift, aliked-lightglue, disk-lightglue or superpoint-lightglue [those of the method's settings]",
    )
    added.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="change a setting of the method"
    )
    added.add_argument(
        "--sequence",
        action="store_true",
        help="the photos are one flight: each is looked for where the ones before it lead",
    )
    added.add_argument("--json", type=Path, metavar="FILE", help="write the results as JSON, too")
    added.add_argument("--seed", type=int, default=0, help="of every random choice [0]")
    added.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to compute [cpu]")
    add_runs_dir(added)


def _localize(arguments: argparse.Namespace) -> int:
    from toolkit.runs.index import find_run
    from toolkit.runs.localize_many import localize_many, named_photo
    from toolkit.runs.localize_photo import PhotoLocalizer, check_follows, method_settings
    from toolkit.runs.localize_text import localized_text

    settings = method_settings(arguments.method, features=arguments.features, changes=arguments.set)
    choice = _choice(arguments)
    if arguments.sequence:  # before maps and networks are opened
        check_follows(settings)
    run = find_run(arguments.run, arguments.runs)
    localizer = PhotoLocalizer(run, settings, device=arguments.device)
    # All of them before the first is localised: a name that is wrong is told at once.
    photos = [named_photo(localizer.scene, name) for name in dict.fromkeys(arguments.photos)]
    options = {"flight": arguments.sequence, "seed": arguments.seed}
    done = with_bar(lambda bar: localize_many(run, localizer, photos, choice, **options, progress=bar))
    if arguments.json is not None:
        _write(arguments.json, run, done)
    print(localized_text(done, metric=localizer.scene.georeference is not None))
    return 0 if any(one.found for one in done) else 1


def _choice(arguments: argparse.Namespace) -> StartChoice:
    from toolkit.runs.photo_start import POSITION_SIGMA, ROTATION_SIGMA_DEG, parse_start

    choice = parse_start(arguments.start, *(arguments.start_sigma or (POSITION_SIGMA, ROTATION_SIGMA_DEG)))
    for flag, given, kind in (("--off", arguments.off, "own"), ("--start-sigma", arguments.start_sigma, "pose")):
        if given is not None and choice.kind != kind:
            what = "--start own" if kind == "own" else "--start E,N,U,HEADING,PITCH"
            raise SettingsError(f"{flag} has nothing to change", expected=f"{what} too")
    if arguments.off is not None:
        choice = dataclasses.replace(choice, metres=arguments.off[0], degrees=arguments.off[1])
    return choice


def _write(path: Path, run: RunFolder, done: Sequence[LocalizedPhoto]) -> None:
    from toolkit.files import write_json
    from toolkit.runs.photo_results import photo_record
    from toolkit.runs.result import plain

    write_json(path, plain({"run": run.id, "photos": [photo_record(one) for one in done]}, []))
