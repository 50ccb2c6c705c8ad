"""The empty black borders of a video, and the part of the picture that is kept."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from toolkit.capture.temporal import TemporalStatistics
from toolkit.errors import DataError, SettingsError
from toolkit.settings import Boolean, Integer, Number, Settings, Text

Mask = NDArray[np.bool_]

# Bridges of the picture's content thinner than this are cut, so that writing in the border is not part of it.
_OPENING = 2
# Where less of the rectangle than this is empty, the picture fills it.
_ROUND = 0.01
_LEAST_SIDE = 32
_SMEAR = 2


class CropSettings(Settings):
    """Which part of the picture is kept."""

    borders = Boolean(True, doc="Cut off the empty black borders.")
    dark_share = Number(
        0.98, bounds=(0.5, 1.0), doc="A pixel is empty where it is dark in at least this part of the frames."
    )
    rectangle = Text("", doc="Keep this: left,top,width,height in pixels of the whole frame; empty: as found.")
    width = Integer(
        0, bounds=(0, 100_000), unit="px", doc="Keep so much of the middle, as the paper's 480; 0: all."
    )
    height = Integer(
        0, bounds=(0, 100_000), unit="px", doc="Keep so much of the middle, as the paper's 360; 0: all."
    )


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A part of a picture, in whole pixels of it."""

    left: int
    top: int
    width: int
    height: int

    def cut(self, picture: NDArray) -> NDArray:
        """Return the part of an array (H, W, ...)."""
        return picture[self.top : self.top + self.height, self.left : self.left + self.width]

    def to_list(self) -> list[int]:
        """Return left, top, width and height."""
        return [self.left, self.top, self.width, self.height]


@dataclass(frozen=True, slots=True)
class Borders:
    """Where a video's frames are empty.

    Attributes
    ----------
    rectangle:
        Around the content.
    empty:
        (H, W) of the whole frame, True where there is never any content: the borders, and the corners about the
        round picture of a borescope.
    round:
        Whether the content leaves over a hundredth of the rectangle empty: then the mask is needed, too.
    """

    rectangle: Rectangle
    empty: Mask
    round: bool

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {"rectangle": self.rectangle.to_list(), "round": self.round, "empty": float(self.empty.mean())}


def find_borders(statistics: TemporalStatistics, settings: CropSettings) -> Borders:
    """Find the empty borders of a video from the pixels that are dark in nearly all frames.

    The content is the largest piece of pixels that are not, its holes filled: a dark gap between blades lies inside
    it and is no border, and writing in the border is not connected with it and is. A corner of the scene that the
    lamp never reaches cannot be told from a border; there are no features in it either.

    Parameters
    ----------
    statistics:
        Of the whole frames.
    settings:
        How often a pixel must be dark.

    Raises
    ------
    DataError
        Where the video is dark everywhere.
    """
    lit = statistics.dark_share < settings.dark_share
    height, width = lit.shape
    opened = ndimage.binary_opening(np.pad(lit, _OPENING, mode="edge"), iterations=_OPENING)
    pieces, count = ndimage.label(opened[_OPENING:-_OPENING, _OPENING:-_OPENING])
    if not count:
        raise DataError(
            "The video is dark",
            expected="a picture in some part of the frame",
            found=f"at most {100 * (1 - statistics.dark_share.min()):.0f} % of the frames bright at any pixel",
            todo="Is it the right file? For a dim one set a lower temporal.dark",
        )
    sizes = np.bincount(pieces.ravel())
    content = ndimage.binary_fill_holes(pieces == 1 + int(np.argmax(sizes[1:])))
    # Opening took corners of the content off; what belongs to it is put back.
    content = ndimage.binary_dilation(content, iterations=_OPENING, mask=lit | content)
    top, bottom = _extent(np.where(content, statistics.mean, np.nan))
    left, right = _extent(np.where(content, statistics.mean, np.nan).T)
    rectangle = Rectangle(left, top, right - left, bottom - top)
    if rectangle.width * rectangle.height == width * height and content.all():
        return Borders(rectangle, np.zeros_like(content), round=False)
    empty = ~content
    return Borders(rectangle, empty, round=bool(rectangle.cut(empty).mean() > _ROUND))


def _extent(content: NDArray[np.float64]) -> tuple[int, int]:
    """Return the first row (H, W) that is not all NaN and the one after the last.

    Compression smears the content over the border by a row or two; these are darker than half of the next.
    """
    rows = np.flatnonzero(np.isfinite(content).any(axis=1))
    bright = np.array([np.nanmean(row) for row in content[rows]])
    first, last = 0, len(rows) - 1
    for _ in range(_SMEAR):
        if last - first < _LEAST_SIDE:
            break
        first += bool(bright[first] < bright[first + 1] / 2)
        last -= bool(bright[last] < bright[last - 1] / 2)
    return int(rows[first]), int(rows[last]) + 1


def chosen_rectangle(borders: Borders, settings: CropSettings) -> Rectangle:
    """Return the part of the frame that is kept.

    Parameters
    ----------
    borders:
        As found.
    settings:
        A rectangle of the user's comes first; else it is that around the content, or the whole frame. ``width`` and
        ``height`` take the middle of that.

    Raises
    ------
    SettingsError
        For a rectangle that cannot be read, a part that reaches out of the frame, is larger than what there is or
        smaller than 32 pixels.
    """
    height, width = borders.empty.shape
    whole = Rectangle(0, 0, width, height)
    if settings.rectangle:
        base = _rectangle(settings.rectangle, whole)
    else:
        base = borders.rectangle if settings.borders else whole
    made_width, made_height = settings.width or base.width, settings.height or base.height
    if made_width > base.width or made_height > base.height:
        raise SettingsError(
            f"Nothing of {made_width} x {made_height} pixels can be cut from the frame",
            expected=f"at most {base.width} x {base.height}, which is left of {width} x {height}",
            todo="Set a smaller crop.width and crop.height, or crop.borders to no",
        )
    if min(made_width, made_height) < _LEAST_SIDE:
        raise SettingsError(
            f"Too little of the frame is kept: {made_width} x {made_height} pixels",
            expected=f"at least {_LEAST_SIDE} x {_LEAST_SIDE}",
        )
    left, top = base.left + (base.width - made_width) // 2, base.top + (base.height - made_height) // 2
    return Rectangle(left, top, made_width, made_height)


def _rectangle(text: str, whole: Rectangle) -> Rectangle:
    found = re.fullmatch(r"\s*(\d{1,6})\s*,\s*(\d{1,6})\s*,\s*(\d{1,6})\s*,\s*(\d{1,6})\s*", text)
    made = None if found is None else Rectangle(*(int(part) for part in found.groups()))
    inside = made is not None and (made.left + made.width <= whole.width and made.top + made.height <= whole.height)
    if made is None or not inside:
        raise SettingsError(
            "Setting 'crop.rectangle' is no part of the frame",
            expected=f"left,top,width,height inside {whole.width} x {whole.height} pixels",
            found=repr(text[:40]),
        )
    return made
