"""Icons and static structure in a video of something that moves, found from its statistics over time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from toolkit.capture.temporal import TemporalStatistics
from toolkit.errors import StageError
from toolkit.settings import Integer, Number, Settings

Mask = NDArray[np.bool_]

# Noise differs over a picture: this many times the typical one is taken off before motion is told.
_NOISE_MARGIN = 1.5
# Where more than this part of what has structure stands still, nothing moves.
_NOTHING_MOVES = 0.95
_EIGHT = np.ones((3, 3), dtype=bool)


class StaticMaskSettings(Settings):
    """How static structure is told from what moves."""

    coherence = Number(
        0.8,
        bounds=(0.05, 0.99),
        doc="Least part of a pixel's gradient energy that stays the same over time, for static structure.",
    )
    slack = Number(
        0.5,
        bounds=(0.01, 20.0),
        unit="px",
        doc="Most motion of static structure: a pixel's deviation over time divided by its mean gradient.",
    )
    contrast = Number(
        1.5, bounds=(0.0, 100.0), unit="levels/px", doc="Least mean gradient of static structure: shading has less."
    )
    quiet = Number(
        1.0, bounds=(0.0, 50.0), unit="levels", doc="A pixel is quiet up to this deviation, or to twice the noise."
    )
    enclosed = Number(
        0.65,
        bounds=(0.0, 1.0),
        doc="Least part of a quiet area's outline that is static structure, for the area to belong to it.",
    )
    closing = Integer(4, bounds=(0, 100), unit="px", doc="Gaps up to twice this width are closed.")
    least_area = Integer(30, bounds=(1, 1_000_000), unit="px", doc="Smaller pieces are left out.")
    largest_hole = Number(
        0.01, bounds=(0.0, 1.0), doc="Holes up to this part of the picture are filled: the inside of an icon."
    )
    grow = Integer(
        6, bounds=(0, 200), unit="px", doc="The mask is grown by this: features near the edge see what it covers."
    )


@dataclass(frozen=True, slots=True)
class StaticMask:
    """Which pixels show what does not move.

    Attributes
    ----------
    mask:
        (H, W) True where features are to be left out: static structure, cleaned and grown.
    structure:
        (H, W) True where static structure itself was seen.
    undecided:
        (H, W) True where the picture neither changes nor has anything on it that could stand still or move.
    coherence:
        (H, W) part of the gradient energy that stays the same over time, 0 to 1.
    statistics:
        Of which it was made.
    """

    mask: Mask
    structure: Mask
    undecided: Mask
    coherence: NDArray[np.float64]
    statistics: TemporalStatistics

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "masked": float(self.mask.mean()),
            "structure": float(self.structure.mean()),
            "undecided": float(self.undecided.mean()),
            "pieces": int(ndimage.label(self.mask, _EIGHT)[1]),
            "noise": self.statistics.noise,
            "frames": self.statistics.count,
            "repeated_frames": self.statistics.repeated,
        }


def find_static_mask(
    statistics: TemporalStatistics, settings: StaticMaskSettings, *, empty: Mask | None = None
) -> StaticMask:
    """Find icons and static structure in a video in which the rest moves.

    Section 4.1 of the paper on blades blacks out by hand what does not move; this finds it. Low variance alone
    does not tell it: what moves and has no texture changes as little. It takes a gradient to see that something
    stays. Where g(t) is a pixel's gradient, of smoothed frames, and v its brightness's variance over time, both
    without what the noise adds,

        coherence = |mean g|^2 / (|mean g|^2 + var g),    motion = sqrt(v) / |mean g|.

    Coherence is near 1 on structure that stays, and near 1/n on texture that passes, n being the number of frames
    in which it has moved on. The motion is that in pixels by which the mean gradient explains the variance. A pixel
    with a mean gradient of at least ``contrast``, a coherence of at least ``coherence`` and a motion of at most
    ``slack`` is static structure. Less contrast is what a lamp that is fixed to the camera casts on what moves.

    Quiet pixels (of a deviation that the noise explains) without gradient lie on anything without texture. An area
    of them is taken for static where at least ``enclosed`` of its outline, not counting the edge of the picture, is
    static structure: the inside of a bare casing. All others stay **undecided**: they are told, and not masked;
    there are hardly any features on them.

    What cannot be told apart: the rim of a turning part that looks the same at any angle changes only as the camera
    shakes, and is masked where it is still; features on it would mislead reconstruction as well. The far end of a
    straight road looks still for some seconds. A static part that is covered for some of the time is not found.
    These ask for the brush: ``mask.png`` is there to be painted.

    Parameters
    ----------
    statistics:
        Of frames in which the scene moves by more than its details are large.
    settings:
        Thresholds, and how the mask is cleaned and grown.
    empty:
        (H, W) True where the frame is empty (:func:`toolkit.capture.borders.find_borders`): neither static nor
        undecided. The edge of it is masked only as far as other static structure is.

    Raises
    ------
    StageError
        Where over 95 % of all structure stands still: nothing moves, and all would be masked.
    """
    blank = np.zeros(statistics.mean.shape, dtype=bool) if empty is None else empty
    # Smoothed gradients reach over the edge of the empty border; they are not the scene's.
    near = ndimage.binary_dilation(blank, _EIGHT, iterations=3) if blank.any() else blank
    steady = statistics.mean_gradient**2
    margin = _NOISE_MARGIN**2
    energy = steady + np.maximum(statistics.gradient_variance - margin * statistics.gradient_noise, 0.0)
    coherence = np.divide(steady, energy, out=np.zeros_like(energy), where=energy > 0)
    still = statistics.variance <= margin * statistics.noise**2 + settings.slack**2 * steady
    structure = (statistics.mean_gradient >= settings.contrast) & (coherence >= settings.coherence) & still & ~near
    _require_motion(structure, (energy >= settings.contrast**2) & ~near, statistics)
    quiet_variance = max(settings.quiet, 2 * statistics.noise) ** 2
    quiet = (statistics.variance <= quiet_variance) & ~structure
    inside, undecided = _enclosed(quiet & ~near, structure, near, settings.enclosed)
    mask = _cleaned(structure | inside, settings)
    return StaticMask(mask & ~blank, structure, undecided & ~mask, coherence, statistics)


def _require_motion(structure: Mask, textured: Mask, statistics: TemporalStatistics) -> None:
    share = structure.sum() / max(1, textured.sum())
    if share > _NOTHING_MOVES or not textured.any():
        found = f"{100 * share:.0f} % of all structure standing still" if textured.any() else "no structure at all"
        raise StageError(
            "Nothing moves in the video",
            expected="something that moves by more than its details are large",
            found=f"{found} in {statistics.count + statistics.repeated} frames",
            todo="Is it the right part of the recording? To keep the frames as they are, set find_static and "
            "stills.remove to no",
        )


def _enclosed(quiet: Mask, structure: Mask, empty: Mask, least: float) -> tuple[Mask, Mask]:
    """Return the quiet areas whose outline is static structure, and the others; empty outline does not count."""
    pieces, count = ndimage.label(quiet)
    inside = np.zeros(count + 1, dtype=bool)
    for number, place in enumerate(ndimage.find_objects(pieces), start=1):
        # One pixel of room for the outline; at the edge of the picture there is none.
        window = tuple(slice(max(0, part.start - 1), part.stop + 1) for part in place)
        area = pieces[window] == number
        outline = ndimage.binary_dilation(area) & ~area & ~empty[window]
        inside[number] = structure[window][outline].sum() >= max(1.0, least * outline.sum())
    return inside[pieces] & quiet, ~inside[pieces] & quiet


def _cleaned(found: Mask, settings: StaticMaskSettings) -> Mask:
    """Return the mask closed, without specks, with small holes filled, and grown."""
    mask = _closed(found, settings.closing)
    pieces, _ = ndimage.label(mask, _EIGHT)
    sizes = np.bincount(pieces.ravel())
    mask &= sizes[pieces] >= settings.least_area
    holes, _ = ndimage.label(~mask)
    sizes = np.bincount(holes.ravel())
    mask |= sizes[holes] <= settings.largest_hole * mask.size
    if settings.grow and mask.any():
        mask = ndimage.distance_transform_edt(~mask) <= settings.grow
    return mask


def _closed(mask: Mask, radius: int) -> Mask:
    """Close by a disc; the picture's edge is no obstacle."""
    if not radius or not mask.any():
        return mask
    wide = np.pad(mask, radius, mode="edge")
    grown = ndimage.distance_transform_edt(~wide) <= radius
    if grown.all():
        return grown[radius:-radius, radius:-radius]
    shrunk: Mask = ndimage.distance_transform_edt(np.pad(grown, 1, constant_values=True)) > radius
    return shrunk[radius + 1 : -radius - 1, radius + 1 : -radius - 1] | mask
