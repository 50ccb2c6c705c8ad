"""What a run shows while it trains, read from its folder (:mod:`toolkit.recipes.live_view` writes it)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from toolkit.errors import DataError
from toolkit.files import read_json
from toolkit.recipes.live_view import LIVE, PHOTO, POSES, RENDER, VIEW
from toolkit.runs.folder import RunFolder
from toolkit.runs.trajectories import Trajectories, read_trajectories


@dataclass(frozen=True, slots=True)
class LivePicture:
    """The latest render of one test photo.

    Attributes
    ----------
    name:
        Of the photo.
    step, steps:
        Of the training when it was drawn, and how many there will be.
    psnr:
        In dB.
    photo, render:
        Files.
    """

    name: str
    step: int
    steps: int
    psnr: float
    photo: Path
    render: Path


def live_stamp(run: RunFolder) -> tuple[int | None, int | None]:
    """Return when picture and poses were last written, None for what is not there."""
    view, poses = run.artifacts / LIVE / VIEW, run.artifacts / LIVE / POSES
    return _written(view), _written(poses)


def live_picture(run: RunFolder) -> LivePicture | None:
    """Return the latest render, None before the first one. Raises :class:`DataError` where it is damaged."""
    folder = run.artifacts / LIVE
    if not (folder / VIEW).is_file():
        return None
    content = read_json(folder / VIEW)
    try:
        return LivePicture(
            str(content["name"]),
            int(content["step"]),
            int(content["steps"]),
            float(content["psnr"]),
            folder / PHOTO,
            folder / RENDER,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{folder / VIEW} tells no picture", expected="name, step, steps and psnr", found=repr(error)
        ) from error


def live_poses(run: RunFolder) -> Trajectories | None:
    """Return the poses as they are refined, with their start as the reference; None where there are none.

    Raises
    ------
    DataError
        Where the file is damaged.
    """
    path = run.artifacts / LIVE / POSES
    return read_trajectories(path) if path.is_file() else None


def _written(path: Path) -> int | None:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return None
