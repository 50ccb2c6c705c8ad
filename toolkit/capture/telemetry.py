"""What a drone's sensors said over time, and what that makes of the frames of a video."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.capture.interpolate import linear, shortest_turn
from toolkit.errors import DataError

Array = NDArray[np.float64]
Clock = Literal["video", "log", "unix"]
AltitudeReference = Literal["ellipsoid", "sea level", "unstated"]
NorthReference = Literal["true", "magnetic", "unknown"]


@dataclass(frozen=True, eq=False)
class Readings:
    """Sensor readings at some times. NaN stands for what is not known.

    Attributes
    ----------
    times:
        (T,) seconds.
    latitude, longitude:
        (T,) WGS84 degrees; NaN both where the receiver had no position.
    altitude:
        (T,) metres, as the receiver wrote it.
    height:
        (T,) metres above the place of take-off.
    gimbal, flight:
        (T, 3) yaw, pitch and roll in degrees (:class:`toolkit.geometry.attitude.Attitude`) of the camera and of the
        airframe.
    warnings:
        What the user should know, a sentence each.

    Raises
    ------
    DataError
        Where the arrays do not fit together or a time is not finite.
    """

    times: Array
    latitude: Array
    longitude: Array
    altitude: Array
    height: Array
    gimbal: Array
    flight: Array
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("times", "latitude", "longitude", "altitude", "height", "gimbal", "flight"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        count = self.times.shape
        wanted = {"latitude": count, "longitude": count, "altitude": count, "height": count}
        wanted |= {"gimbal": (*count, 3), "flight": (*count, 3)}
        wrong = {name: getattr(self, name).shape for name, shape in wanted.items()} != wanted
        if wrong or len(count) != 1 or not np.isfinite(self.times).all():
            raise DataError(
                "Telemetry contradicts itself",
                expected="finite times (T,), four numbers and two attitudes (3,) for each",
                found=", ".join(f"{name} {getattr(self, name).shape}" for name in ("times", *wanted)),
            )

    def __len__(self) -> int:
        return len(self.times)


@dataclass(frozen=True, eq=False)
class Telemetry(Readings):
    """A log of sensor readings, in order of time.

    Attributes
    ----------
    clock:
        What the times count from: ``"video"`` (its start), ``"log"`` (the start of the log, of which the video
        knows nothing) or ``"unix"`` (1970, UTC).
    altitude_reference:
        What ``altitude`` is above, as far as the file says.
    north:
        Which north the yaw angles count from, as far as the file says.
    source:
        The file, or None.

    Raises
    ------
    DataError
        Where there is no reading or times do not increase.
    """

    clock: Clock = "video"
    altitude_reference: AltitudeReference = "unstated"
    north: NorthReference = "unknown"
    source: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not len(self.times) or not (np.diff(self.times) > 0).all():
            raise DataError(
                "The times of telemetry do not increase",
                expected="at least one reading, strictly increasing seconds",
                found=f"{len(self.times)} readings",
                todo="Use telemetry_in_order, which sorts and merges them",
            )

    @property
    def absolute(self) -> bool:
        """Whether times are seconds since 1970."""
        return self.clock == "unix"

    def at(self, times: ArrayLike, max_gap: float = 2.0) -> Readings:
        """Return the readings at other times.

        Positions, altitudes and heights are interpolated linearly, attitudes by the shortest turn. Nothing is
        interpolated between readings that are more than ``max_gap`` apart; the first and the last reading hold for
        half the median distance of readings, at most half of ``max_gap``, beyond them. What has no value is NaN,
        and a warning counts it.

        Parameters
        ----------
        times:
            (N,) seconds by the clock of this log, in any order.
        max_gap:
            Seconds, above 0.
        """
        wanted = np.asarray(times, dtype=np.float64)
        # Across the date line the short way.
        turned = np.full(len(self), np.nan)
        known = np.isfinite(self.longitude)
        turned[known] = np.unwrap(self.longitude[known], period=360.0)
        places = linear(self.times, np.stack([self.latitude, turned], axis=1), wanted, max_gap)
        found = Readings(
            times=wanted,
            latitude=places[:, 0],
            longitude=(places[:, 1] + 180.0) % 360.0 - 180.0,
            altitude=linear(self.times, self.altitude[:, None], wanted, max_gap)[:, 0],
            height=linear(self.times, self.height[:, None], wanted, max_gap)[:, 0],
            gimbal=shortest_turn(self.times, self.gimbal, wanted, max_gap),
            flight=shortest_turn(self.times, self.flight, wanted, max_gap),
        )
        return dataclasses.replace(found, warnings=self._missing(found, max_gap))

    def _missing(self, found: Readings, max_gap: float) -> tuple[str, ...]:
        """Say how many values are missing of kinds that the log has."""
        warnings = []
        kinds = {"position": "latitude", "altitude": "altitude", "height above take-off": "height"}
        for what, name in (kinds | {"gimbal attitude": "gimbal", "flight attitude": "flight"}).items():
            has = np.isfinite(getattr(self, name)).any()
            lacks = ~np.isfinite(getattr(found, name).reshape(len(found), -1)).all(axis=1)
            if has and lacks.any():
                first = found.times[np.flatnonzero(lacks)[0]]
                warnings.append(
                    f"{int(lacks.sum())} of {len(found)} times have no {what}: they lie in gaps of over "
                    f"{max_gap:g} s or outside the telemetry ({self.times[0]:.3f} to "
                    f"{self.times[-1]:.3f} s), the first at {first:.3f} s"
                )
        return tuple(warnings)


def telemetry_in_order(
    readings: Readings,
    *,
    clock: Clock = "video",
    altitude_reference: AltitudeReference = "unstated",
    north: NorthReference = "unknown",
    source: Path | None = None,
) -> Telemetry:
    """Return readings as a log: sorted by time, those of one time merged, and without positions at 0, 0.

    Of readings of one time the first counts; what it lacks is taken from the next. A roll that is missing where yaw
    and pitch are known is 0. Each of these adds a warning that counts them.

    Parameters
    ----------
    readings:
        In the order of the file.
    clock, altitude_reference, north, source:
        Of :class:`Telemetry`.

    Raises
    ------
    DataError
        Where there is no reading.
    """
    warnings = list(readings.warnings)
    places = np.stack([readings.latitude, readings.longitude], axis=1)
    places[~np.isfinite(places).all(axis=1)] = np.nan
    nowhere = (places == 0.0).all(axis=1)
    places[nowhere] = np.nan
    if nowhere.any():
        warnings.append(
            f"{int(nowhere.sum())} readings lie at 0, 0: the receiver had no position; they are left out"
        )
    gimbal = _with_roll(readings.gimbal, "gimbal", warnings)
    flight = _with_roll(readings.flight, "flight", warnings)
    late = int((np.diff(readings.times) < 0).sum())
    if late:
        warnings.append(f"{late} readings are earlier than the one before them: sorted by time")
    order = np.argsort(readings.times, kind="stable")
    times, start = np.unique(readings.times[order], return_index=True)
    columns = np.column_stack([places, readings.altitude, readings.height, gimbal, flight])[order]
    double = len(order) - len(times)
    if double:
        warnings.append(f"{double} readings have the time of another: merged")
        columns = _merged(columns, start, len(order))
    return Telemetry(
        times,
        columns[:, 0],
        columns[:, 1],
        columns[:, 2],
        columns[:, 3],
        columns[:, 4:7],
        columns[:, 7:10],
        tuple(warnings),
        clock=clock,
        altitude_reference=altitude_reference,
        north=north,
        source=source,
    )


# Columns that are known or not known together: the place, each of the heights, each attitude.
_TOGETHER = (slice(0, 2), slice(2, 3), slice(3, 4), slice(4, 7), slice(7, 10))


def _merged(columns: Array, start: NDArray[np.int64], count: int) -> Array:
    """Return one row for each run of rows from ``start``: of each kind the first that is known."""
    merged = columns[start]
    for row, (begin, end) in enumerate(zip(start, [*start[1:], count], strict=True)):
        for part in _TOGETHER:
            known = np.flatnonzero(np.isfinite(columns[begin:end, part]).all(axis=1))
            if len(known):
                merged[row, part] = columns[begin + known[0], part]
    return merged


def _with_roll(angles: Array, what: str, warnings: list[str]) -> Array:
    """Return attitudes whole: roll 0 where only it is missing, NaN where yaw or pitch is missing."""
    whole = angles.copy()
    lacks = np.isfinite(angles[:, :2]).all(axis=1) & ~np.isfinite(angles[:, 2])
    whole[lacks, 2] = 0.0
    whole[~np.isfinite(angles[:, :2]).all(axis=1)] = np.nan
    if lacks.any():
        warnings.append(f"{int(lacks.sum())} readings of the {what} attitude have no roll: taken as 0")
    return whole


def readings_from_rows(rows: Sequence[Mapping[str, float]], warnings: Iterable[str] = ()) -> Readings:
    """Return readings from one table a reading, what it lacks being NaN.

    Keys are ``time``, ``latitude``, ``longitude``, ``altitude``, ``height``, and ``gimbal_`` and ``flight_``
    followed by ``yaw``, ``pitch`` and ``roll``.
    """

    def column(name: str) -> Array:
        return np.array([row.get(name, np.nan) for row in rows], dtype=np.float64)

    def angles(kind: str) -> Array:
        return np.stack([column(f"{kind}_{axis}") for axis in ("yaw", "pitch", "roll")], axis=1)

    return Readings(
        times=column("time"),
        latitude=column("latitude"),
        longitude=column("longitude"),
        altitude=column("altitude"),
        height=column("height"),
        gimbal=angles("gimbal"),
        flight=angles("flight"),
        warnings=tuple(warnings),
    )
