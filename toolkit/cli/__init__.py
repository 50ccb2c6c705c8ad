"""The command line: reads arguments, calls the toolkit, prints."""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Sequence

import toolkit
from toolkit.cli import calibrate, capture, data, localize, pages, queue, render, runs, slam, sweep, tables
from toolkit.cli.common import Command
from toolkit.errors import Cancelled, ToolkitError


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code, most often 0; 2 for an error that is told, 130 when stopped."""
    _bear_any_text()
    given = list(sys.argv[1:] if argv is None else argv)
    arguments = build_parser(
        with_sample_flags="sample" in given,
        with_frame_flags="frames" in given,
        with_inspection_flags="inspection" in given,
        with_calibration_flags="calibrate" in given,
        with_vocabulary_flags="vocabulary" in given,
    ).parse_args(given)
    command: Command = arguments.command
    try:
        code = command(arguments)
        sys.stdout.flush()
    except (Cancelled, KeyboardInterrupt) as stop:
        print(f"stopped: {str(stop) or 'Ctrl-C'}", file=sys.stderr)
        return 130
    except ToolkitError as error:
        if arguments.debug:
            raise
        print(f"error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        # The reader of our output went away (as in `toolkit runs | head`); nothing more can be said to it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    return code or 0


def _bear_any_text() -> None:
    """Write a question mark for what the output cannot hold, as arrows in a file or pipe of Windows' code pages."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def build_parser(
    *,
    with_sample_flags: bool = True,
    with_frame_flags: bool = True,
    with_inspection_flags: bool = True,
    with_calibration_flags: bool = True,
    with_vocabulary_flags: bool = True,
) -> argparse.ArgumentParser:
    """Return the parser of all commands.

    The flags of ``sample``, ``frames``, ``inspection``, ``calibrate`` and ``vocabulary`` come from their settings,
    which take a moment to import: only these commands need them.
    """
    parser = argparse.ArgumentParser(
        prog="toolkit",
        description="3D reconstruction from drone video, satellite images and inspection footage.",
        epilog="Example: toolkit run colmap-3dgs --data photos/ --set train.steps=500",
    )
    parser.add_argument("--version", action="version", version=f"toolkit {toolkit.__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    pages.add_commands(commands)
    runs.add_commands(commands)
    queue.add_commands(commands)
    sweep.add_commands(commands)
    render.add_commands(commands)
    localize.add_commands(commands)
    data.add_commands(commands, with_sample_flags=with_sample_flags)
    capture.add_commands(commands, with_flags=with_frame_flags, with_inspection_flags=with_inspection_flags)
    calibrate.add_commands(commands, with_flags=with_calibration_flags)
    slam.add_commands(commands, with_vocabulary_flags=with_vocabulary_flags)
    tables.add_commands(commands)
    return parser
