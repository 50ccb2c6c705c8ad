"""How a network's input is cut from a picture, and where each of its pixels lies in the picture."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from toolkit.errors import DataError

Picture = NDArray[np.uint8]
Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MapPlan:
    """A picture is scaled to ``scaled`` and laid into a map of ``size`` with its corner at ``corner``.

    Attributes
    ----------
    picture, scaled, size:
        Width and height in pixels of the picture, the scaled picture and the map.
    corner:
        Where the scaled picture's top-left corner comes to lie; negative where it is cropped.
    """

    picture: tuple[int, int]
    scaled: tuple[int, int]
    size: tuple[int, int]
    corner: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        if min(*self.picture, *self.scaled, *self.size) < 1:
            raise DataError(
                "A picture is too narrow for the network",
                expected="sides that are not many times as long as each other",
                found=f"{self.picture[0]}x{self.picture[1]} pixels",
            )

    @property
    def picture_from_map(self) -> Array:
        """(4,) ``sx, sy, ox, oy``. Edges of pixels keep their places in resampling, so no half pixels appear."""
        scale = np.array(self.picture) / self.scaled
        return np.concatenate([scale, -scale * self.corner])

    @property
    def shown(self) -> NDArray[np.bool_]:
        """(H, W) which pixels of the map show the picture; the others are padding."""
        width, height = self.size
        columns = np.arange(width) - self.corner[0]
        rows = np.arange(height) - self.corner[1]
        inside_x = (columns >= 0) & (columns < self.scaled[0])
        inside_y = (rows >= 0) & (rows < self.scaled[1])
        return inside_y[:, None] & inside_x[None, :]

    def padded_to(self, width: int, height: int) -> MapPlan:
        """Return the plan with a larger map, the old one in its middle (the smaller half first)."""
        left, top = (width - self.size[0]) // 2, (height - self.size[1]) // 2
        return dataclasses.replace(self, size=(width, height), corner=(self.corner[0] + left, self.corner[1] + top))

    def apply(self, picture: Picture, resample: Image.Resampling, fill: int = 255) -> Picture:
        """Return the map (H, W, 3) uint8 of a picture (h, w, 3), padded with ``fill``."""
        scaled = np.asarray(Image.fromarray(picture).resize(self.scaled, resample))
        made = np.full((self.size[1], self.size[0], 3), fill, dtype=np.uint8)
        shown = self.shown
        rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
        made[np.ix_(rows, columns)] = scaled[np.ix_(rows - self.corner[1], columns - self.corner[0])]
        return made


def of_one_size(plans: Sequence[MapPlan]) -> list[MapPlan]:
    """Return plans whose maps are all as large as the largest."""
    width, height = (max(plan.size[axis] for plan in plans) for axis in (0, 1))
    return [plan.padded_to(width, height) for plan in plans]


def vggt_plan(width: int, height: int, *, pad: bool, side: int = 518, patch: int = 14) -> MapPlan:
    """Return how VGGT's ``load_and_preprocess_images`` scales a picture.

    ``crop``: the width becomes 518, the height a multiple of 14, of which the middle 518 are taken. ``pad``: the
    longer side becomes 518, and the shorter one is padded to as much. Rounding is Python's, as there.
    """
    if pad:
        if width >= height:
            scaled = (side, round(height * (side / width) / patch) * patch)
        else:
            scaled = (round(width * (side / height) / patch) * patch, side)
        return MapPlan((width, height), scaled, scaled).padded_to(side, side)
    scaled = (side, round(height * (side / width) / patch) * patch)
    if scaled[1] <= side:
        return MapPlan((width, height), scaled, scaled)
    return MapPlan((width, height), scaled, (side, side), (0, -((scaled[1] - side) // 2)))


def dust3r_plan(width: int, height: int, *, side: int = 512, patch: int = 16) -> MapPlan:
    """Return how DUSt3R's ``load_images`` scales a picture for its networks of 512 pixels.

    The longer side becomes 512 and the middle is taken, of sides that are multiples of 16. Of square pictures it
    takes three quarters of the height, since the networks were trained on longish pictures only.
    """
    longest = max(width, height)
    scaled = (round(width * side / longest), round(height * side / longest))
    middle = (scaled[0] // 2, scaled[1] // 2)
    half = [((2 * centre) // patch) * patch // 2 for centre in middle]
    if scaled[0] == scaled[1]:
        half[1] = 3 * half[0] // 4
    corner = (half[0] - middle[0], half[1] - middle[1])
    return MapPlan((width, height), scaled, (2 * half[0], 2 * half[1]), corner)


def depth_anything_plan(width: int, height: int, *, side: int = 504, patch: int = 14) -> MapPlan:
    """Return how Depth Anything 3 scales a picture with ``upper_bound_resize``.

    The longer side becomes 504 and both the nearest multiples of 14; a tie goes up.
    """
    scale = side / max(width, height)
    near = [max(1, round(length * scale)) for length in (width, height)]
    scaled = [max(1, (2 * length + patch) // (2 * patch) * patch) for length in near]
    return MapPlan((width, height), (scaled[0], scaled[1]), (scaled[0], scaled[1]))


def cropped_to_smallest(plans: Sequence[MapPlan]) -> list[MapPlan]:
    """Return plans of the middles of all maps, as large as the smallest: what Depth Anything 3 does."""
    width, height = (min(plan.size[axis] for plan in plans) for axis in (0, 1))
    return [
        dataclasses.replace(
            plan,
            size=(width, height),
            corner=(
                plan.corner[0] - (plan.size[0] - width) // 2,
                plan.corner[1] - (plan.size[1] - height) // 2,
            ),
        )
        for plan in plans
    ]
