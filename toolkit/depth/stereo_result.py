"""What became of the pictures in multi-view stereo."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.depth.dense_folder import DepthViews, open_depth_views


@dataclass(frozen=True, slots=True)
class FrameStereo:
    """What became of one picture.

    Attributes
    ----------
    name:
        Of the frame.
    sources:
        Pictures that it was compared with, best first.
    depth_range:
        Nearest and farthest z of the search, or None.
    size:
        Width and height of the maps in pixels.
    rejected:
        Pixels by the first reason for which they were rejected, and how many were ``kept``.
    seconds:
        That the search took, without compiling; 0 where nothing was searched.
    reason:
        Why there is no depth map; empty where there is one.
    """

    name: str
    sources: tuple[str, ...]
    depth_range: tuple[float, float] | None
    size: tuple[int, int]
    rejected: dict[str, int]
    seconds: float = 0.0
    reason: str = ""

    @property
    def coverage(self) -> float:
        """Share of the picture's pixels that have depth."""
        return self.rejected.get("kept", 0) / (self.size[0] * self.size[1])

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {**dataclasses.asdict(self), "coverage": self.coverage}


@dataclass(frozen=True, slots=True)
class StereoResult:
    """Depth and normal maps in a dense folder, and how they came about.

    Attributes
    ----------
    folder:
        COLMAP's dense workspace.
    frames:
        One entry for each frame with a pose.
    """

    folder: Path
    frames: tuple[FrameStereo, ...]

    @property
    def views(self) -> DepthViews:
        """The depth views, read from the disk when they are asked for."""
        return open_depth_views(self.folder)

    @property
    def seconds_per_megapixel(self) -> float:
        """Of the search, over all pictures; NaN where nothing was searched."""
        done = [frame for frame in self.frames if frame.seconds > 0]
        pixels = sum(frame.size[0] * frame.size[1] for frame in done)
        return sum(frame.seconds for frame in done) / pixels * 1e6 if pixels else math.nan

    @property
    def coverage(self) -> float:
        """Mean share of pixels with depth, over the pictures that have a map."""
        shares = [frame.coverage for frame in self.frames if not frame.reason]
        return float(np.mean(shares)) if shares else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        rejected: dict[str, int] = {}
        for frame in self.frames:
            for name, count in frame.rejected.items():
                rejected[name] = rejected.get(name, 0) + count
        seconds = self.seconds_per_megapixel
        return {
            "images": sum(not frame.reason for frame in self.frames),
            "coverage": self.coverage,
            "seconds_per_megapixel": seconds if math.isfinite(seconds) else None,
            "pixels": rejected,
            "frames": [frame.to_dict() for frame in self.frames],
        }
