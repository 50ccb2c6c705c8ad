"""The commands that make scene folders of videos, mask them and cut them."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from toolkit.cli.common import add, with_bar


def add_commands(commands: argparse._SubParsersAction, *, with_flags: bool, with_inspection_flags: bool) -> None:
    """Add the commands; flags of the first two come from settings, which take a moment to import."""
    _add_frames(commands, with_flags)
    _add_inspection(commands, with_inspection_flags)
    _add_mask(commands)
    _add_segment(commands)


def _add_frames(commands: argparse._SubParsersAction, with_flags: bool) -> None:
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


def _add_inspection(commands: argparse._SubParsersAction, with_flags: bool) -> None:
    added = add(
        commands,
        "inspection",
        _inspection,
        "Make a scene folder of an inspection video: cropped, without stops, with what does not move masked.",
        "inspection borescope.mp4 blades/ --rate 30 --crop.width 480 --crop.height 360",
    )
    added.add_argument(
        "source", type=Path, metavar="VIDEO", help="a file that FFmpeg decodes, or a folder of pictures"
    )
    added.add_argument("folder", type=Path, metavar="FOLDER", help="new folder to write")
    added.add_argument(
        "--mask", type=Path, metavar="PICTURE", help="take this mask (black: left out) in place of finding one"
    )
    added.add_argument(
        "--camera", type=Path, metavar="PROFILE", help="known intrinsics: a profile that toolkit calibrate wrote"
    )
    added.add_argument("--seed", type=int, default=0, help="of the choice of frames for statistics [0]")
    if with_flags:
        from toolkit.capture.inspection import InspectionSettings

        InspectionSettings.add_flags(added)


def _add_mask(commands: argparse._SubParsersAction) -> None:
    added = add(
        commands,
        "mask",
        _mask,
        "Give all frames of a scene folder one mask: its mask.png after it was painted, or another picture.",
        "mask blades/ --mask painted.png",
    )
    added.add_argument("folder", type=Path, metavar="FOLDER", help="of the scene")
    added.add_argument(
        "--mask", type=Path, metavar="PICTURE", help="black is left out, white is used [mask.png in FOLDER]"
    )


def _add_segment(commands: argparse._SubParsersAction) -> None:
    added = add(
        commands,
        "segment",
        _segment,
        "Make a scene folder of a stretch of frames of another, over the same pictures.",
        "segment blades/ blades-400/ --length 400 --start 1000",
    )
    added.add_argument("folder", type=Path, metavar="FOLDER", help="of the whole scene")
    added.add_argument("target", type=Path, metavar="NEW", help="new folder to write")
    added.add_argument("--length", type=int, required=True, metavar="FRAMES", help="how many frames")
    added.add_argument("--start", type=int, default=0, metavar="INDEX", help="of the first frame [0]")
    added.add_argument("--stride", type=int, default=1, metavar="FRAMES", help="take every so-manyth frame [1]")
    added.add_argument(
        "--copy", action="store_true", help="copy the pictures; else the new folder refers to the old ones"
    )


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


def _inspection(arguments: argparse.Namespace) -> None:
    from toolkit.capture.inspection import InspectionSettings, open_inspection

    settings = InspectionSettings.from_flags(arguments)
    camera = None
    if arguments.camera is not None:
        from toolkit.capture.sources import frame_source
        from toolkit.poses.camera_profile import read_profile

        profile = read_profile(arguments.camera)
        height, width = next(frame_source(arguments.source).frames()).grey().shape
        camera = profile.camera_for(width, height)
    made = with_bar(
        lambda bar: open_inspection(
            arguments.source,
            arguments.folder,
            settings,
            mask=arguments.mask,
            camera=camera,
            seed=arguments.seed,
            progress=bar,
        )
    )
    for warning in made.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    crop = made.rectangle
    print(f"{crop.width} x {crop.height} px from ({crop.left}, {crop.top}), {100 * made.mask.mean():.1f} % masked")
    for stop in made.to_dict()["stills"]["stops"] if made.stills is not None else []:
        print(
            f"left out frames {stop['first']} to {stop['last']}: within {stop['motion_px']:.2f} px of frame "
            f"{stop['kept']}, which is kept"
        )
    print(f"{len(made.numbers)} of {len(made.sampled)} frames written to {arguments.folder}")


def _mask(arguments: argparse.Namespace) -> None:
    from toolkit.capture.mask_files import apply_mask, read_mask

    scene = with_bar(lambda bar: apply_mask(arguments.folder, arguments.mask, progress=bar))
    if scene.mask_dir is None:
        print(f"The mask is white everywhere: the {len(scene)} frames have none now")
        return
    path = scene.mask_path(scene.frames[0])
    camera = scene.camera_of(scene.frames[0])
    assert path is not None
    share = read_mask(path, (camera.width, camera.height)).mean()
    print(f"{len(scene)} frames leave out {100 * share:.1f} % of the picture")


def _segment(arguments: argparse.Namespace) -> None:
    from toolkit.capture.segments import write_segment

    part = write_segment(
        arguments.folder,
        arguments.target,
        arguments.length,
        start=arguments.start,
        stride=arguments.stride,
        copy_images=arguments.copy,
    )
    print(f"{len(part)} frames from {part.frames[0].name} to {part.frames[-1].name}, in {arguments.target}")
