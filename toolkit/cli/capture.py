"""The command that makes a scene folder of a video and its telemetry."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from toolkit.cli.common import add, with_bar


def add_commands(commands: argparse._SubParsersAction, *, with_flags: bool) -> None:
    """Add the command; its flags come from settings, which take a moment to import."""
    added = add(
        commands,
        "frames",
        _frames,
        "Make a scene folder of a video: keyframes with times, and with priors from telemetry.",
        "frames flight.mp4 flight/ --telemetry flight.srt --keyframes.method every-nth",
    )
    added.add_argument("video", type=Path, metavar="VIDEO", help="a file that FFmpeg decodes")
    added.add_argument("folder", type=Path, metavar="FOLDER", help="new folder to write")
    added.add_argument(
        "--telemetry", type=Path, metavar="FILE", help="DJI's subtitles (.srt), a flight log (.csv) or track (.gpx)"
    )
    added.add_argument(
        "--camera", type=Path, metavar="PROFILE", help="known intrinsics: a profile that toolkit calibrate wrote"
    )
    if with_flags:
        from toolkit.capture.flight import FlightSettings

        FlightSettings.add_flags(added)


def _frames(arguments: argparse.Namespace) -> None:
    from toolkit.capture.flight import FlightSettings, open_flight

    settings = FlightSettings.from_flags(arguments)
    camera = None
    if arguments.camera is not None:
        from toolkit.capture.video import video_info
        from toolkit.poses.camera_profile import read_profile

        profile, info = read_profile(arguments.camera), video_info(arguments.video)
        camera = profile.camera_for(info.width, info.height)
    flight = with_bar(
        lambda bar: open_flight(
            arguments.video, arguments.telemetry, arguments.folder, settings, camera=camera, progress=bar
        )
    )
    for warning in flight.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    report = flight.keyframes.report
    priors = sum(frame.prior is not None for frame in flight.scene.frames)
    print(
        f"{report['keyframes']} of {report['frames']} frames ({report['method']}), {priors} with priors, "
        f"written to {arguments.folder}"
    )
    if camera is not None:
        print(f"To keep the camera of the profile as it is: toolkit run ... --camera {arguments.camera}")
