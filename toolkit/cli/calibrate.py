"""The command that finds a camera's intrinsics, for later flights to use."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from toolkit.cli.common import add, with_bar
from toolkit.errors import RunError


def add_commands(commands: argparse._SubParsersAction, *, with_flags: bool) -> None:
    """Add the command; its flags come from settings, which take a moment to import."""
    added = add(
        commands,
        "calibrate",
        _calibrate,
        "Find a camera's intrinsics from pictures, once, and keep them in a profile.",
        "calibrate photos/ --out drone.camera.json --camera-model OPENCV",
    )
    added.add_argument("folder", type=Path, metavar="DATA_FOLDER", help="pictures of anything with depth")
    added.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="profile to write, a new file [<name of the folder>.camera.json, here]",
    )
    added.add_argument("--seed", type=int, default=0, help="of every random choice [0]")
    if with_flags:
        from toolkit.poses.calibrate import CalibrationSettings

        CalibrationSettings.add_flags(added)


def _calibrate(arguments: argparse.Namespace) -> None:
    from toolkit.poses.calibrate import CalibrationSettings, calibrate_folder
    from toolkit.poses.camera_profile import PROFILE_ENDING, write_profile

    settings = CalibrationSettings.from_flags(arguments)
    out = arguments.out or Path(arguments.folder.resolve().name + PROFILE_ENDING)
    if out.exists():
        raise RunError(f"{out} is there already", todo="Move it away, or name another file with --out")
    with tempfile.TemporaryDirectory(prefix="toolkit-calibrate-") as work:
        profile = with_bar(
            lambda bar: calibrate_folder(
                arguments.folder, settings, seed=arguments.seed, progress=bar, work_dir=Path(work)
            )
        )
    write_profile(profile, out)
    camera = profile.camera
    values = zip(camera.to_pycolmap().params_info.split(", "), camera.params, strict=True)
    print(
        f"{profile.name}, {profile.width} x {profile.height} px, {profile.model}: "
        + ", ".join(f"{name} {value:.6g}" for name, value in values)
    )
    sigma, error = 100 * profile.focal_sigma, profile.reprojection_error
    print(f"focal length to {sigma:.2g} %, mean error {error:.2f} px, {profile.photos} photos")
    print(f"written to {out} after {profile.seconds:.1f} s")
