"""What the pixels of a video do over time: the sums from which borders and static structure are told."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.optional import require
from toolkit.settings import Integer, Number, Settings

Grey = NDArray[np.uint8]
Array = NDArray[np.float64]

# Blocks of this side tell the noise; the quarter of them with the least is taken to have no texture.
_BLOCK = 16
_TEXTURELESS = 0.25
# The second difference 1 -2 1 by 1 -2 1 multiplies white noise by 6 (Immerkaer 1996).
_LAPLACIAN_GAIN = 6.0
# A frame repeats the one before where no block has changed by more levels on average than this and the noise.
_REPEATED = 1.0


class TemporalSettings(Settings):
    """Of what the statistics over time are made."""

    frames = Integer(
        400,
        bounds=(10, 100_000),
        unit="frames",
        doc="Frames that are looked at, at random over the video: an even step could fall on the blades' own.",
    )
    smoothing = Number(
        1.2,
        bounds=(0.5, 10.0),
        unit="px",
        doc="Sigma of the Gaussian before gradients are taken: noise, slight shake.",
    )
    dark = Integer(10, bounds=(0, 254), unit="levels", doc="A pixel of at most this brightness (of 255) is dark.")


@dataclass(frozen=True, slots=True)
class TemporalStatistics:
    """Statistics of each pixel over the frames of a video.

    Attributes
    ----------
    count:
        Of frames that were summed up.
    repeated:
        Of frames that were not, because they show the same as the last one that was: a stop, however long it is,
        counts as one view.
    mean:
        (H, W) brightness, 0 to 255.
    variance:
        (H, W) of the brightness, levels squared.
    mean_gradient:
        (H, W) length of the mean gradient vector of smoothed frames, levels a pixel.
    gradient_variance:
        (H, W) variance of that vector (of both components together), levels squared a pixel squared.
    dark_share:
        (H, W) part of the frames in which the pixel is dark.
    noise:
        Standard deviation of the sensor's noise in levels, from the parts of single frames without texture.
    gradient_noise:
        Variance of the gradient vector that this noise alone makes, levels squared a pixel squared.
    """

    count: int
    repeated: int
    mean: Array
    variance: Array
    mean_gradient: Array
    gradient_variance: Array
    dark_share: Array
    noise: float
    gradient_noise: float


def sampled_numbers(count: int, most: int, seed: int) -> list[int]:
    """Return numbers of at most ``most`` of ``count`` frames: one drawn at random from each of equal stretches."""
    if count <= most:
        return list(range(count))
    edges = np.linspace(0, count, most + 1).astype(int)
    drawn: list[int] = np.random.default_rng(seed).integers(edges[:-1], edges[1:]).tolist()
    return drawn


def temporal_statistics(frames: Iterable[Grey], settings: TemporalSettings) -> TemporalStatistics:
    """Sum up the frames of a video pixel by pixel; only one is held at a time.

    Parameters
    ----------
    frames:
        (H, W) uint8, all of one size. All that come are used: :func:`sampled_numbers` chooses.
    settings:
        Smoothing and what is called dark.

    Raises
    ------
    MissingDependencyError
        Where OpenCV is missing.
    DataError
        Where there are fewer than two frames, or they differ in size.
    """
    sums = _Sums(settings)
    for frame in frames:
        sums.add(frame)
    if sums.count + sums.repeated < 2:
        raise DataError(
            "Nothing can be told of what moves",
            expected="at least 2 frames",
            found=f"{sums.count}",
            todo="Give a longer video, or a higher rate",
        )
    return sums.statistics()


class _Sums:
    """Sums up frames that differ from the one before, and counts the others."""

    def __init__(self, settings: TemporalSettings) -> None:
        self._cv = require("cv2")
        self._settings = settings
        self._totals: list[Array] = []
        self._noises: list[float] = []
        self._shape: tuple[int, ...] = ()
        self._last: Array | None = None
        self.count = self.repeated = 0

    def add(self, frame: Grey) -> None:
        """Take the next frame."""
        self._shape = self._shape or frame.shape
        check_size(frame, self._shape, self.count + self.repeated)
        level, sigma = frame.astype(np.float64), self._settings.smoothing
        smooth = self._cv.GaussianBlur(level, (0, 0), sigma, borderType=self._cv.BORDER_REPLICATE)
        self._noises.append(noise_level(frame, self._settings.dark))
        if self._last is not None and self._repeats(smooth - self._last):
            self.repeated += 1
            return
        self._last = smooth
        self.count += 1
        down, across = np.gradient(smooth)
        dark = frame <= self._settings.dark
        values = (level, level**2, across, down, across**2 + down**2, dark)
        self._totals = self._totals or [np.zeros(self._shape) for _ in values]
        for total, value in zip(self._totals, values, strict=True):
            total += value

    def _repeats(self, change: Array) -> bool:
        """Return whether noise explains by how much the smoothed picture has changed in each block."""
        # Of a difference of two frames: sqrt(2), mean of |x|: sqrt(2 / pi), smoothing: 1 / (2 sqrt(pi) s).
        noise = float(np.median(self._noises)) / (np.pi * self._settings.smoothing)
        return float(_blocks(np.abs(change)).mean(axis=1).max(initial=0.0)) < _REPEATED + 2 * noise

    def statistics(self) -> TemporalStatistics:
        """Return what was summed up."""
        mean, square, across, down, energy, dark = (total / self.count for total in self._totals)
        noise = float(np.median(self._noises))
        return TemporalStatistics(
            count=self.count,
            repeated=self.repeated,
            mean=mean,
            variance=np.maximum(square - mean**2, 0.0),
            mean_gradient=np.hypot(across, down),
            gradient_variance=np.maximum(energy - across**2 - down**2, 0.0),
            dark_share=dark,
            noise=noise,
            # Derivatives of white noise that a Gaussian of sigma s has smoothed: sigma^2 / (8 pi s^4) each.
            gradient_noise=noise**2 / (4 * np.pi * self._settings.smoothing**4),
        )


def check_size(frame: Grey, shape: tuple[int, ...], number: int) -> None:
    """Raise :class:`DataError` where a frame is no (H, W) uint8 of ``shape``."""
    if frame.shape != shape or frame.ndim != 2 or frame.dtype != np.uint8:
        raise DataError(
            f"Frame {number} of those looked at is not like the first",
            expected=f"(H, W) uint8 of shape {shape}",
            found=f"{frame.dtype} of shape {frame.shape}",
            todo="Take the pictures of another size out of the folder",
        )


def noise_level(frame: Grey, dark: int = 10) -> float:
    """Return the standard deviation of a frame's noise in levels.

    J. Immerkaer, "Fast noise variance estimation" (CVIU 1996), in blocks of 16 pixels; the block at the lower
    quartile is taken, so that texture in up to three quarters of the picture is not called noise. Blocks that are
    dark or saturated say nothing and are left out: 0 where all are.

    Parameters
    ----------
    frame:
        (H, W) uint8.
    dark:
        Brightness up to which a block counts as dark.
    """
    level = frame.astype(np.float64)
    rows = level[:-2] - 2 * level[1:-1] + level[2:]
    second = rows[:, :-2] - 2 * rows[:, 1:-1] + rows[:, 2:]
    if min(second.shape) < _BLOCK:
        return 0.0
    bright = _blocks(level[1:-1, 1:-1])
    spread = np.abs(_blocks(second)).mean(axis=1) * np.sqrt(np.pi / 2) / _LAPLACIAN_GAIN
    usable = (bright.min(axis=1) > 0) & (bright.mean(axis=1) > dark) & (bright.max(axis=1) < 255)
    return float(np.quantile(spread[usable], _TEXTURELESS)) if usable.any() else 0.0


def _blocks(picture: Array) -> Array:
    """Return the whole blocks of a picture as (B, 256)."""
    rows, columns = picture.shape[0] // _BLOCK, picture.shape[1] // _BLOCK
    whole = picture[: rows * _BLOCK, : columns * _BLOCK]
    blocks: Array = whole.reshape(rows, _BLOCK, columns, _BLOCK).swapaxes(1, 2).reshape(rows * columns, -1)
    return blocks
