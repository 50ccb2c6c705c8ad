"""Runs ORB-SLAM3 in a process of its own: ``python -m toolkit.poses.slam.orbslam3_child job.json``.

ORB-SLAM3 ends its process where something is wrong and writes to the C output, so nothing else may live in it.
Beside the job file it leaves ``progress.txt`` (a line for each frame, as it goes), for each map
``keyframes_<n>.txt`` (TUM) and ``frames_<n>.txt`` (EuRoC), and at the end ``result.json``.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from toolkit.errors import ToolkitError
from toolkit.files import atomic_path, read_json, write_json
from toolkit.optional import require
from toolkit.scene.pictures import load_picture

#: In these states the map that was lost is still the active one; after them comes an empty one.
LOST = ("RECENTLY_LOST", "LOST")


class _Maps:
    """Saves the keyframes of each map before ORB-SLAM3 turns to the next: only the active one can be read."""

    def __init__(self, slam: Any, folder: Path) -> None:
        self.segments: list[dict[str, Any]] = []
        self._slam, self._folder = slam, folder
        self._open = False

    def saw(self, number: int, state: str, tracked: bool) -> None:
        if tracked:
            if not self._open:
                self.segments.append({"first": number})
                self._open = True
            self.segments[-1]["last"] = number
        elif self._open and state in LOST:
            self.save()
        else:
            self._open = False

    def save(self) -> None:
        # Saving an empty map crashes: the active one is not empty as long as a segment is open.
        if not self._open:
            return
        number = len(self.segments) - 1
        keyframes, frames = (self._folder / f"{kind}_{number}.txt" for kind in ("keyframes", "frames"))
        with atomic_path(keyframes) as temporary:
            self._slam.save_keyframe_trajectory_tum(str(temporary))
        # All frames can be read of the largest map only, which need not be the active one.
        with atomic_path(frames) as temporary:
            self._slam.save_trajectory_euroc(str(temporary))
        self.segments[-1] |= {"keyframes": keyframes.name, "frames": frames.name}


def _track(job: dict[str, Any], folder: Path) -> dict[str, Any]:
    package = require("pyorbslam3")
    slam = package.Slam(job["vocabulary"], job["settings"], package.Sensor.MONOCULAR, use_viewer=False)
    maps = _Maps(slam, folder)
    frames, changes = [], []
    with (folder / "progress.txt").open("w", encoding="ascii", buffering=1) as lines:
        for number, (picture, seconds) in enumerate(zip(job["pictures"], job["times"], strict=True)):
            if os.getppid() != job["parent"]:
                sys.exit("the process that wanted this is gone")
            image = load_picture(Path(picture))
            start = time.perf_counter()
            seen = slam.track_monocular(image, seconds)
            took = time.perf_counter() - start
            state, tracked = seen.state.name, bool(seen.ok)
            frames.append({"state": state, "tracked": tracked, "seconds": took})
            if slam.map_changed():
                changes.append(number)
            maps.saw(number, state, tracked)
            lines.write(f"{number} {state}\n")
            if number + 1 < len(job["times"]):
                due = start + job["pace"] * (job["times"][number + 1] - seconds)
                time.sleep(max(0.0, due - time.perf_counter()))
    slam.shutdown()
    maps.save()
    return {"frames": frames, "segments": maps.segments, "map_changes": changes}


def main(arguments: Sequence[str]) -> None:
    """Do the job of the file that is named; what goes wrong is told on the standard error output."""
    path = Path(arguments[0])
    try:
        write_json(path.parent / "result.json", _track(read_json(path), path.parent))
    except ToolkitError as error:
        sys.exit(f"error: {error}")
    # What ORB-SLAM3's threads do while the interpreter is taken down has nothing to add to a whole result.
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1:])
