"""ORB-SLAM3 as a backend (Campos et al., "ORB-SLAM3", T-RO 2021), through the optional package ``pyorbslam3``."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import CapabilityError, DataError, StageError
from toolkit.files import read_json, write_json, write_text
from toolkit.geometry.cameras import ColmapCamera
from toolkit.optional import require
from toolkit.poses.slam.orbslam3_read import clock, clock_seconds, read_segments
from toolkit.poses.slam.result import SlamResult
from toolkit.poses.slam.vocabulary_file import check_vocabulary
from toolkit.progress import Progress, ProgressEvent
from toolkit.scene.pictures import picture_size
from toolkit.settings import Integer, Number, Settings

_CHILD = "toolkit.poses.slam.orbslam3_child"
_SECONDS_BETWEEN_LOOKS = 0.1
_LAST_LINES = 5

#: COLMAP's models that ORB-SLAM3 can take: where focal lengths, principal point and distortion (k1 k2 p1 p2, for
#: fish-eyes k1 k2 k3 k4; -1: zero) lie among the parameters.
_PINHOLE: Mapping[str, tuple[int, ...]] = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2, -1, -1, -1, -1),
    "PINHOLE": (0, 1, 2, 3, -1, -1, -1, -1),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3, -1, -1, -1),
    "RADIAL": (0, 0, 1, 2, 3, 4, -1, -1),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
}
_FISHEYE: Mapping[str, tuple[int, ...]] = {
    "SIMPLE_RADIAL_FISHEYE": (0, 0, 1, 2, 3, -1, -1, -1),
    "RADIAL_FISHEYE": (0, 0, 1, 2, 3, 4, -1, -1),
    "OPENCV_FISHEYE": (0, 1, 2, 3, 4, 5, 6, 7),
}


class OrbSlam3Settings(Settings):
    """ORB-SLAM3's own settings, and how long it may take."""

    features = Integer(1500, bounds=(100, 20000), unit="features", doc="ORB features for each picture.")
    scale_factor = Number(1.2, bounds=(1.05, 2.0), doc="Between the levels of the picture pyramid.")
    levels = Integer(8, bounds=(1, 16), doc="Of the picture pyramid.")
    threshold = Integer(20, bounds=(1, 255), doc="Of the FAST corner detector, in grey values.")
    least_threshold = Integer(7, bounds=(1, 255), doc="The same where the first one finds no corner.")
    pace = Number(
        1.0,
        bounds=(0.0, 10.0),
        doc="Least time from frame to frame as a share of the video's own: ORB-SLAM3 builds its map meanwhile, and "
        "a map that lags behind loses the camera. 1: as it was filmed, which is what ORB-SLAM3 is made for; 0: as "
        "fast as it takes them.",
    )
    time_limit = Number(
        3600.0, bounds=(0.1, 1e6), unit="s", doc="Ended with an error where everything together takes longer."
    )


@dataclass(frozen=True, slots=True)
class OrbSlam3:
    """Tracks with ORB-SLAM3 in a process of its own. Two runs on the same frames differ a little: it uses threads.

    Attributes
    ----------
    vocabulary:
        File of visual words: :func:`~toolkit.poses.slam.vocabulary.train_vocabulary`.
    settings:
        As declared.
    """

    vocabulary: Path
    settings: OrbSlam3Settings

    @property
    def name(self) -> str:
        """As it stands in tables."""
        return "orbslam3"

    def track(
        self,
        pictures: Sequence[Path],
        times: NDArray[np.float64],
        camera: ColmapCamera,
        *,
        seed: int,
        progress: Progress,
        work_dir: Path,
    ) -> SlamResult:
        """Track all frames, as :class:`~toolkit.poses.slam.result.SlamBackend` says. The seed has no effect.

        A new segment begins with each new map. Where ORB-SLAM3 recognised an earlier map and merged the two, they
        are one segment. Keyframes of the last map are as they are after all loop closures; those of earlier maps as
        they were when they were last read, while tracking was lost.

        Raises
        ------
        CapabilityError
            For a camera model that ORB-SLAM3 does not have.
        DataError
            For a damaged vocabulary, pictures of another size than the camera's, or times that do not increase.
        MissingDependencyError
            Where ``pyorbslam3`` is not installed.
        StageError
            Where ORB-SLAM3 crashed or took too long; the message ends with the last lines of its log.
        """
        start = time.perf_counter()
        _check_pictures(pictures, times, camera)
        yaml = orbslam3_yaml(camera, times, self.settings)
        require("pyorbslam3")
        check_vocabulary(self.vocabulary)
        write_text(work_dir / "settings.yaml", yaml)
        job = {
            "vocabulary": str(self.vocabulary.absolute()),
            "settings": str((work_dir / "settings.yaml").absolute()),
            "pictures": [str(path.absolute()) for path in pictures],
            "times": clock_seconds(times).tolist(),
            "pace": self.settings.pace,
            "parent": os.getpid(),
        }
        write_json(work_dir / "job.json", job)
        run_child(
            [sys.executable, "-m", _CHILD, str((work_dir / "job.json").absolute())],
            work_dir,
            frames=len(pictures),
            time_limit=self.settings.time_limit,
            progress=progress,
        )
        found = read_json(work_dir / "result.json")
        segments, notes = read_segments(found, work_dir, times)
        return SlamResult(
            backend=self.name,
            segments=segments,
            frame_count=len(pictures),
            frame_seconds=np.array([frame["seconds"] for frame in found["frames"]], dtype=np.float64),
            seconds=time.perf_counter() - start,
            notes=notes,
        )


def orbslam3_yaml(camera: ColmapCamera, times: NDArray[np.float64], settings: OrbSlam3Settings) -> str:
    """Return the text of ORB-SLAM3's settings file, version 1.0.

    Raises
    ------
    CapabilityError
        For camera models other than those of PINHOLE, OPENCV and OPENCV_FISHEYE and their simpler kin.
    """
    fisheye = camera.model in _FISHEYE
    places = _FISHEYE.get(camera.model) or _PINHOLE.get(camera.model)
    if places is None:
        raise CapabilityError(
            f"ORB-SLAM3 has no camera model {camera.model}",
            expected=", ".join([*_PINHOLE, *_FISHEYE]),
            todo="Undistort the pictures first",
        )
    fx, fy, cx, cy, *distortion = (camera.params[i] if i >= 0 else 0.0 for i in places)
    # OpenCV counts pixels from the centre of the first one, COLMAP from its corner.
    intrinsics = {"fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5}
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2")
    intrinsics |= dict(zip(names, distortion, strict=True))
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    reals: dict[str, float] = {f"Camera1.{name}": value for name, value in intrinsics.items()}
    reals["ORBextractor.scaleFactor"] = settings.scale_factor
    # Of the window that is never opened, but must be described.
    reals |= dict.fromkeys(
        [f"Viewer.{name}" for name in ("KeyFrameSize", "KeyFrameLineWidth", "GraphLineWidth", "PointSize")], 1.0
    )
    reals |= dict.fromkeys([f"Viewer.{name}" for name in ("CameraSize", "CameraLineWidth")], 1.0)
    reals |= {f"Viewer.Viewpoint{axis}": 1.0 for axis in "XYZF"}
    whole = {
        "Camera.width": camera.width,
        "Camera.height": camera.height,
        # After so many frames without one it makes a keyframe.
        "Camera.fps": max(1, round(1.0 / step)),
        "Camera.RGB": 1,
        "ORBextractor.nFeatures": settings.features,
        "ORBextractor.nLevels": settings.levels,
        "ORBextractor.iniThFAST": settings.threshold,
        "ORBextractor.minThFAST": min(settings.least_threshold, settings.threshold),
    }
    kind = "KannalaBrandt8" if fisheye else "PinHole"
    lines = ["%YAML:1.0", "", 'File.version: "1.0"', f'Camera.type: "{kind}"']
    lines += [f"{name}: {value:.12f}" for name, value in reals.items()]
    lines += [f"{name}: {value}" for name, value in whole.items()]
    return "\n".join(lines) + "\n"


def run_child(
    command: Sequence[str], work_dir: Path, *, frames: int, time_limit: float, progress: Progress
) -> None:
    """Run a command that adds a line to ``progress.txt`` for each frame; its outputs go to ``log.txt``.

    It never outlives this call.

    Raises
    ------
    StageError
        Where it ends with an error or by a signal, or takes longer than ``time_limit`` seconds.
    """
    log, counted = work_dir / "log.txt", work_dir / "progress.txt"
    end = time.monotonic() + time_limit
    with log.open("wb") as output:
        child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT)
    try:
        while child.poll() is None:
            progress(_event(counted, frames))
            if time.monotonic() > end:
                raise StageError(
                    "ORB-SLAM3 took too long",
                    expected=f"an end within time_limit = {time_limit:g} s",
                    found=f"{_event(counted, frames).done} of {frames} frames done; {_last_words(log)}",
                    todo="Raise time_limit, or give fewer or smaller frames",
                )
            try:
                child.wait(_SECONDS_BETWEEN_LOOKS)
            except subprocess.TimeoutExpired:
                continue
    finally:
        if child.poll() is None:
            child.kill()
        child.wait()
    if child.returncode:
        code = child.returncode
        raise StageError(
            "ORB-SLAM3 crashed",
            expected="an end without error",
            found=f"{f'signal {-code}' if code < 0 else f'exit code {code}'} after "
            f"{_event(counted, frames).done} of {frames} frames; {_last_words(log)}",
            todo=f"The whole log is {log}",
        )
    progress(_event(counted, frames))


def _event(counted: Path, frames: int) -> ProgressEvent:
    done, state = 0, ""
    if counted.is_file():
        # Only whole lines count: the last one may be half written.
        lines = counted.read_text(encoding="ascii", errors="replace").split("\n")[:-1]
        done = len(lines)
        state = lines[-1].partition(" ")[2] if lines else ""
    return ProgressEvent("slam.track", done, frames, state.lower().replace("_", " "))


def _last_words(log: Path) -> str:
    lines = [
        line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()
    ]
    return "its last words: " + " / ".join(lines[-_LAST_LINES:]) if lines else "it said nothing"


def _check_pictures(pictures: Sequence[Path], times: NDArray[np.float64], camera: ColmapCamera) -> None:
    if not pictures or times.shape != (len(pictures),) or not np.isfinite(times).all():
        raise DataError(
            "Frames and times do not fit together",
            expected="at least one frame, and finite seconds, one for each",
            found=f"{len(pictures)} frames and times {times.shape}",
        )
    early = np.flatnonzero(np.diff(clock(times)) <= 0)
    if len(early):
        raise DataError(
            f"Frame {early[0] + 1} is not later than the one before",
            expected="times that increase by 4 ms or more",
            found=f"{times[early[0] + 1]} s after {times[early[0]]} s",
        )
    for path in pictures:
        size = picture_size(path)
        if size != (camera.width, camera.height):
            raise DataError(
                f"Picture {path} is not of its camera's size",
                expected=f"{camera.width}x{camera.height}",
                found=f"{size[0]}x{size[1]}",
            )
