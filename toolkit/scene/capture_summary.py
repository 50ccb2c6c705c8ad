"""A capture at a glance: what its photos have in common, what varies, and what is to be minded."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.scene.dataset import Capture
from toolkit.scene.flight_facts import median_overlap, median_speed
from toolkit.scene.photo_quality import blurred, exposure_jumps
from toolkit.scene.photos import start_camera
from toolkit.scene.scene import Scene
from toolkit.scene.survey import PhotoFacts
from toolkit.scene.thumbnails import Thumbnail

_MOST_VALUES = 3
_MOST_NAMES = 5
#: Metres across within which receivers without RTK scatter: positions that lie as close tell no way.
_STANDSTILL = 1.0
_DAY = 86_400.0


@dataclass(frozen=True, slots=True)
class SummaryRow:
    """One line: what it is about, what is so, and whether it differs from photo to photo where it should not."""

    title: str
    text: str
    varies: bool = False


def summary_rows(capture: Capture, facts: Sequence[PhotoFacts]) -> tuple[SummaryRow, ...]:
    """Return what is known of a capture, line by line; what nobody knows has no line.

    Parameters
    ----------
    capture:
        As it was opened.
    facts:
        Of its frames, in their order.
    """
    scene = capture.scene
    sound = [fact for fact in facts if not fact.damage]
    tests = sum(frame.split == "test" for frame in scene.frames)
    rows = [
        SummaryRow("Photos", f"{len(scene):,}, of which {tests} are for tests"),
        _varying("Size", [f"{fact.width} × {fact.height} px" for fact in sound]),
        _varying("Camera", [fact.tags.camera for fact in sound if fact.tags.camera]),
        _focal_row(scene, sound),
        _time_row(capture, sound),
        _height_row(sound),
        *_sensor_rows(scene),
        *_flight_rows(capture, facts),
    ]
    if capture.reference is not None:
        known = len(capture.reference.registered)
        rows.append(SummaryRow("Known poses", f"{known} of {len(scene)} photos", varies=known < len(scene)))
    if capture.video is not None:
        rows.append(SummaryRow("Video", capture.video.name))
    return tuple(row for row in rows if row is not None)


def summary_warnings(
    capture: Capture, facts: Sequence[PhotoFacts], measures: Sequence[Thumbnail | None] = ()
) -> tuple[str, ...]:
    """Return what is to be minded, a sentence each: all that opening the capture warned of, and more.

    Parameters
    ----------
    capture, facts:
        As for :func:`summary_rows`.
    measures:
        Of the frames; none while they are not measured.
    """
    names = [fact.name for fact in facts]
    told = [*capture.warnings]
    damaged = [fact for fact in facts if fact.damage]
    told += [fact.damage for fact in damaged[:_MOST_NAMES]]
    if len(damaged) > _MOST_NAMES:
        told.append(f"{len(damaged) - _MOST_NAMES} more photos are damaged")
    told += _sensor_warnings(capture.scene)
    told += _orientation_warnings(capture, facts)
    sharp = [measure.sharpness if measure else None for measure in measures]
    soft = blurred(sharp)
    if soft:
        middle = np.median([value for value in sharp if value is not None])
        which = _list(f"{names[i]} with {sharp[i]:.0f}" for i in soft)
        told.append(
            f"{len(soft)} of {len(names)} photos may be blurred, or show little detail: the median sharpness is "
            f"{middle:.0f} ({which})"
        )
    jumps = exposure_jumps([measure.brightness if measure else None for measure in measures])
    if jumps:
        what = _list(f"{names[i]} by {stops:+.1f} stops" for i, stops in jumps)
        told.append(f"{len(jumps)} of {len(names)} photos are brighter or darker than their neighbours: {what}")
    return tuple(told)


def _varying(title: str, values: Sequence[str]) -> SummaryRow | None:
    """Return the value that all have, or the commonest ones with their counts."""
    counts = Counter(values).most_common()
    if not counts:
        return None
    if len(counts) == 1:
        return SummaryRow(title, counts[0][0])
    parts = [f"{value} ({count})" for value, count in counts[:_MOST_VALUES]]
    if len(counts) > _MOST_VALUES:
        parts.append(f"{len(counts) - _MOST_VALUES} more")
    return SummaryRow(title, ", ".join(parts), varies=True)


def _focal_row(scene: Scene, facts: Sequence[PhotoFacts]) -> SummaryRow | None:
    """Return focal lengths in px, those that methods start from, and in mm as the tags tell."""
    pixels: list[float] = []
    guessed = 0
    for frame in scene.frames:
        camera = scene.camera_of(frame)
        if isinstance(camera, ColmapCamera):
            pixels.append(camera.to_pycolmap().mean_focal_length())
            guessed += not camera.prior_focal_length and bool(np.isclose(pixels[-1], _guess(camera)))
    if not pixels:
        return None
    millimetres = sorted({fact.focal_mm for fact in facts if fact.focal_mm is not None})
    text = _range(pixels, "px", ".0f")
    if guessed:
        which = "" if guessed == len(pixels) else f" for {guessed} of {len(pixels)} photos"
        text += f", a guess{which}: nothing is known of the lens"
    if millimetres:
        text += f"; {_range(millimetres, 'mm', '.4g')} by the tags"
    varies = len({round(value) for value in pixels}) > 1 or len(millimetres) > 1
    return SummaryRow("Focal length", text, varies)


def _guess(camera: ColmapCamera) -> float:
    """Return the focal length that photos of a size get where their tags tell none."""
    return start_camera("SIMPLE_PINHOLE", camera.width, camera.height).params[0]


def _time_row(capture: Capture, facts: Sequence[PhotoFacts]) -> SummaryRow | None:
    taken = [fact.tags.time for fact in facts if fact.tags.time is not None]
    if taken:
        first, last = (datetime.fromtimestamp(moment, UTC) for moment in (min(taken), max(taken)))
        same_day = first.date() == last.date()
        until = last.strftime("%H:%M:%S" if same_day else "%Y-%m-%d %H:%M:%S")
        missing = f"; not told by {len(facts) - len(taken)} of them" if len(taken) < len(facts) else ""
        return SummaryRow("Taken", f"{first:%Y-%m-%d %H:%M:%S} to {until}{missing}", varies=bool(missing))
    times = [frame.time for frame in capture.scene.frames if frame.time is not None]
    if len(times) < 2:
        return None
    length = max(times) - min(times)
    # Passes of satellites are days apart.
    return SummaryRow("Length", f"{length:.1f} s" if length < 2 * _DAY else f"{length / _DAY:.0f} days")


def _height_row(facts: Sequence[PhotoFacts]) -> SummaryRow | None:
    heights = [fact.tags.relative_altitude for fact in facts if fact.tags.relative_altitude is not None]
    return SummaryRow("Height above take-off", _range(heights, "m", ".1f")) if heights else None


def _sensor_rows(scene: Scene) -> list[SummaryRow]:
    priors = [frame.prior for frame in scene.frames]
    placed = [prior.position for prior in priors if prior is not None and prior.position is not None]
    turned = sum(prior is not None and prior.rotation is not None for prior in priors)
    rows = [
        SummaryRow("GPS position", _share(len(placed), len(scene)), varies=0 < len(placed) < len(scene)),
        SummaryRow("Gimbal attitude", _share(turned, len(scene)), varies=0 < turned < len(scene)),
    ]
    if len(placed) > 1:
        east, north, up = np.ptp(np.array(placed), axis=0)
        rows.append(
            SummaryRow("Extent", f"{east:.0f} m east-west, {north:.0f} m north-south, {up:.0f} m in height")
        )
    return rows


def _flight_rows(capture: Capture, facts: Sequence[PhotoFacts]) -> list[SummaryRow]:
    rows = []
    speed = median_speed(capture.scene)
    if speed is not None:
        rows.append(SummaryRow("Speed", f"{speed:.1f} m/s between photos, the median"))
    overlap = median_overlap(capture.scene, facts)
    if overlap is not None:
        text = f"{100 * overlap:.0f} % of a photo is in the next one, the median, if the ground is level"
        rows.append(SummaryRow("Overlap", text))
    return rows


def _sensor_warnings(scene: Scene) -> list[str]:
    """Return what is missing of GPS; where only some photos lack it, opening photos has told."""
    positions = [f.prior.position for f in scene.frames if f.prior is not None and f.prior.position is not None]
    if not positions:
        if any(isinstance(scene.camera_of(frame), RpcCamera) for frame in scene.frames):
            return []  # RPCs tell where the ground is
        return [
            "no photo has a GPS position: methods that need sensors cannot run, and scale and north are unknown"
        ]
    if len(positions) > 2 and np.ptp(np.array(positions), axis=0).max() < _STANDSTILL:
        return [f"all GPS positions lie within {_STANDSTILL:g} m of each other: they tell no way that was flown"]
    return []


def _orientation_warnings(capture: Capture, facts: Sequence[PhotoFacts]) -> list[str]:
    """Return what opening a capture tells of photos only, for those with a file that describes them."""
    told = " ".join(capture.warnings)
    warnings = []
    sound = [fact for fact in facts if not fact.damage]
    upright = [fact.name for fact in sound if fact.height > fact.width]
    if 0 < len(upright) < len(sound) and "portrait format" not in told:
        warnings.append(f"{len(upright)} of {len(facts)} photos have portrait format ({_list(upright)})")
    turned = [fact.name for fact in sound if fact.tags.orientation not in (None, 1)]
    if turned and "orientation tag" not in told:
        warnings.append(
            f"{len(turned)} of {len(facts)} photos are to be shown turned, by their orientation tag; the pixels "
            f"are used as they are stored ({_list(turned)})"
        )
    if 0 < len(turned) < len(sound):
        warnings.append("the photos are of mixed orientation: some are stored turned, others are not")
    return warnings


def _share(count: int, total: int) -> str:
    return f"{count} of {total} photos ({100 * count / max(1, total):.0f} %)"


def _range(values: Sequence[float], unit: str, form: str) -> str:
    low, high = format(min(values), form), format(max(values), form)
    return f"{low} {unit}" if low == high else f"{low} to {high} {unit}"


def _list(texts: Iterable[str]) -> str:
    """Return the first texts, and that there are more."""
    every = list(texts)
    return ", ".join(every[:_MOST_NAMES]) + (", ..." if len(every) > _MOST_NAMES else "")
