"""The command that renders a run's splat as a video or pictures."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import get_args

from toolkit.cli.common import RUN_HELP, add, add_runs_dir, with_bar
from toolkit.errors import SettingsError


def add_commands(commands: argparse._SubParsersAction) -> None:
    """Add the command."""
    from toolkit.runs.render import Background, Device, PathName, RenderOptions, Shown

    usual = RenderOptions()
    added = add(
        commands,
        "render",
        _render,
        "Render a run's splat along a path, as a video or pictures.",
        "render latest --to town.mp4 --path flythrough --size 1280x720",
    )
    added.add_argument("run", metavar="RUN", help=RUN_HELP)
    added.add_argument("--to", type=Path, required=True, metavar="PATH", help="an .mp4 file, or a folder for PNGs")
    added.add_argument(
        "--path",
        choices=get_args(PathName),
        default=usual.path,
        help=f"around the scene, along its pictures in order, or the test pictures' places [{usual.path}]",
    )
    added.add_argument(
        "--frames", type=int, default=usual.frames, metavar="N", help=f"pictures on the path [{usual.frames}]"
    )
    added.add_argument(
        "--size",
        metavar="WxH",
        help="pixels [of the pictures, at most 1280 on the longer side]; other shapes are cut",
    )
    added.add_argument(
        "--what", choices=get_args(Shown), default=usual.what, help=f"colours, or depths in colour [{usual.what}]"
    )
    added.add_argument(
        "--fps",
        type=float,
        default=usual.frames_per_second,
        metavar="RATE",
        help=f"frames per second of a video [{usual.frames_per_second:g}]",
    )
    added.add_argument(
        "--background",
        choices=get_args(Background),
        default=usual.background,
        help=f"behind the splat [{usual.background}]",
    )
    added.add_argument(
        "--device", choices=get_args(Device), default=usual.device, help=f"where to compute [{usual.device}]"
    )
    add_runs_dir(added)


def _render(arguments: argparse.Namespace) -> None:
    from toolkit.runs.index import find_run
    from toolkit.runs.render import RenderOptions, render_run

    options = RenderOptions(
        path=arguments.path,
        frames=arguments.frames,
        size=None if arguments.size is None else _size(arguments.size),
        what=arguments.what,
        frames_per_second=arguments.fps,
        background=arguments.background,
        device=arguments.device,
    )
    run = find_run(arguments.run, arguments.runs)
    count = with_bar(lambda bar: render_run(run, arguments.to, options, progress=bar))
    print(f"Wrote {count} pictures of run {run.id} to {arguments.to}")


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,6})x(\d{1,6})", text)
    if found is None:
        raise SettingsError(
            "--size is no size in pixels", expected="width and height as 1280x720", found=repr(text)
        )
    return int(found[1]), int(found[2])
