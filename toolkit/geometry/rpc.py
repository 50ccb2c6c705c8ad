"""Rational polynomial cameras (RPC00B): from latitude, longitude and height to pixels and back.

The model is that of the Compendium of Controlled Extensions for NITF (STDI-0002, volume 1, appendix E): line
and sample are quotients of two cubic polynomials each in normalised longitude L, latitude P and height H, whose
20 terms come in the order::

    1, L, P, H, LP, LH, PH, L^2, P^2, H^2, PLH, L^3, LP^2, LH^2, L^2 P, P^3, PH^2, L^2 H, P^2 H, H^3

Geodetic coordinates are rows of latitude and longitude in degrees (WGS84) and height above the ellipsoid in metres,
in this order. RPC00B counts pixels from the centre of the top-left one; this project has that centre at (0.5, 0.5),
so half a pixel is added to what the polynomials give.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError
from toolkit.geometry.rpc_terms import TERMS, term_derivatives, terms

Array = NDArray[np.float64]

_POLYNOMIALS = ("line_num", "line_den", "sample_num", "sample_den")
#: Ground coordinates are found to this many degrees of the pixel's true place on the model.
_LOCATE_DEGREES = 1e-11
_LOCATE_STEPS = 50
#: Normalised coordinates that a search has run away with.
_RUNAWAY = 1e3
#: Points at a time, so that their 20 terms stay in the processor's cache.
_ROWS_AT_ONCE = 8192
#: Heights may pass the stated range by this part of it, for rounding of files and origins, before they are outside.
_HEIGHT_SLACK = 1e-6


@dataclass(frozen=True)
class Rpc:
    """A rational polynomial camera.

    Attributes
    ----------
    line_num, line_den, sample_num, sample_den:
        20 coefficients each, in RPC00B's order.
    line_offset, line_scale, sample_offset, sample_scale:
        RPC00B's own pixels: the centre of the top-left pixel is (0, 0).
    latitude_offset, latitude_scale, longitude_offset, longitude_scale:
        Degrees.
    height_offset, height_scale:
        Metres above the WGS84 ellipsoid.

    Raises
    ------
    DataError
        For a wrong number of coefficients, values that are not finite, a scale of zero, and a denominator that
        changes its sign within the volume that the scales span (looked for on a grid).
    """

    line_num: tuple[float, ...]
    line_den: tuple[float, ...]
    sample_num: tuple[float, ...]
    sample_den: tuple[float, ...]
    line_offset: float
    line_scale: float
    sample_offset: float
    sample_scale: float
    latitude_offset: float
    latitude_scale: float
    longitude_offset: float
    longitude_scale: float
    height_offset: float
    height_scale: float

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            object.__setattr__(self, item.name, _numbers(item.name, value, item.name in _POLYNOMIALS))
        for name in ("line", "sample", "latitude", "longitude", "height"):
            if getattr(self, f"{name}_scale") == 0:
                raise DataError(
                    f"RPC has {name}_scale zero",
                    expected="a scale that normalises the coordinate",
                    todo="Read the RPC again from the image's vendor file",
                )
        self._check_denominators()

    def _check_denominators(self) -> None:
        steps = np.linspace(-1.0, 1.0, 9)
        grid = terms(np.stack(np.meshgrid(steps, steps, steps)).reshape(3, -1))
        for name in ("line_den", "sample_den"):
            values = np.array(getattr(self, name)) @ grid
            if not (values.min() > 0 or values.max() < 0):
                raise DataError(
                    f"RPC's {name} changes its sign within the RPC's volume, where pixels would be at infinity",
                    expected="a denominator of one sign over the stated latitudes, longitudes and heights",
                    found=f"values from {values.min():.3g} to {values.max():.3g}",
                    todo="Check the order of the coefficients (RPC00B) and the scales",
                )

    @cached_property
    def _numerators(self) -> Array:
        """(2, 20) for x and y."""
        return np.array([self.sample_num, self.line_num])

    @cached_property
    def _denominators(self) -> Array:
        """(2, 20) for x and y."""
        return np.array([self.sample_den, self.line_den])

    @cached_property
    def _pixel_scale(self) -> Array:
        return np.array([self.sample_scale, self.line_scale])

    @cached_property
    def _pixel_offset(self) -> Array:
        # RPC00B's first pixel has its centre at 0, ours at 0.5.
        return np.array([self.sample_offset + 0.5, self.line_offset + 0.5])

    @property
    def height_range(self) -> tuple[float, float]:
        """Lowest and highest height in metres for which the RPC was made."""
        half = abs(self.height_scale)
        return self.height_offset - half, self.height_offset + half

    @property
    def ground_offset(self) -> Array:
        """(3,) latitude, longitude and height of the middle of the RPC's volume."""
        return np.array([self.latitude_offset, self.longitude_offset, self.height_offset])

    @property
    def ground_scale(self) -> Array:
        """(3,) scale of latitude, longitude and height."""
        return np.array([self.latitude_scale, self.longitude_scale, self.height_scale])

    def normalised(self, geodetic: ArrayLike) -> Array:
        """Return normalised longitude, latitude and height (3, N) of latitude, longitude, height (N, 3)."""
        rows = np.asarray(geodetic, dtype=np.float64).reshape(-1, 3) - self.ground_offset
        # A scene near the date line may count its longitudes from the other side.
        rows[:, 1] -= 360.0 * np.round(rows[:, 1] / 360.0)
        return np.ascontiguousarray((rows / self.ground_scale)[:, [1, 0, 2]].T)

    def check_heights(self, heights: ArrayLike) -> None:
        """Raise :class:`DataError` where heights in metres are outside the RPC's range; NaN is let pass."""
        values = np.asarray(heights, dtype=np.float64)
        low, high = self.height_range
        slack = _HEIGHT_SLACK * (high - low)
        outside = (values < low - slack) | (values > high + slack)
        if outside.any():
            raise DataError(
                f"{int(outside.sum())} of {values.size} heights are outside the RPC's range",
                expected=f"{_metres(low)} to {_metres(high)} m above the ellipsoid",
                found=f"{_metres(np.nanmin(values))} to {_metres(np.nanmax(values))} m",
                todo="Check the unit and the reference of the heights, or ask for extrapolate=True",
            )

    def project(self, geodetic: ArrayLike, *, extrapolate: bool = False) -> Array:
        """Return pixels (N, 2), x and y with +0.5 at the centre of a pixel.

        Parameters
        ----------
        geodetic:
            (N, 3) latitude and longitude in degrees, height in metres. A row that is not finite gives NaN, as does
            a place beyond a pole of the polynomials' quotient.
        extrapolate:
            Also take heights outside :attr:`height_range`.

        Raises
        ------
        DataError
            For heights outside the RPC's range without ``extrapolate``.
        """
        rows = np.asarray(geodetic, dtype=np.float64).reshape(-1, 3)
        if not extrapolate:
            self.check_heights(rows[:, 2])
        pixels = np.empty((len(rows), 2))
        for start in range(0, len(rows), _ROWS_AT_ONCE):
            piece = slice(start, start + _ROWS_AT_ONCE)
            pixels[piece] = self._pixels(terms(self.normalised(rows[piece]))).T
        return pixels

    def _pixels(self, values: Array) -> Array:
        """Return x and y (2, N) of the terms (20, N)."""
        below = self._denominators @ values
        # Beyond the pole the sign differs from that in the middle of the volume, which is the first coefficient's.
        below[~(below * self._denominators[:, :1] > 0)] = np.nan
        pixels: Array = self._numerators @ values
        pixels /= below
        pixels *= self._pixel_scale[:, None]
        pixels += self._pixel_offset[:, None]
        pixels[:, ~np.isfinite(pixels).all(axis=0)] = np.nan
        return pixels

    def jacobian(self, geodetic: ArrayLike, *, extrapolate: bool = False) -> Array:
        """Return exact derivatives (N, 2, 3) of x and y by latitude, longitude (per degree) and height (per metre).

        Arguments and errors are those of :meth:`project`.
        """
        rows = np.asarray(geodetic, dtype=np.float64).reshape(-1, 3)
        if not extrapolate:
            self.check_heights(rows[:, 2])
        slopes = np.empty((len(rows), 2, 3))
        for start in range(0, len(rows), _ROWS_AT_ONCE):
            piece = slice(start, start + _ROWS_AT_ONCE)
            place = self.normalised(rows[piece])
            slopes[piece] = self._slopes(terms(place), term_derivatives(place)).transpose(2, 1, 0)[:, :, [1, 0, 2]]
        return slopes / self.ground_scale

    def _slopes(self, values: Array, derivatives: Array) -> Array:
        """Return the derivatives (D, 2, N) of x and y by the normalised coordinates whose terms' are (D, 20, N)."""
        below = self._denominators @ values
        quotient = (self._numerators @ values) / below
        slopes: Array = self._numerators @ derivatives - quotient * (self._denominators @ derivatives)
        slopes *= self._pixel_scale[:, None] / below
        return slopes

    def locate(self, pixels: ArrayLike, heights: ArrayLike, *, extrapolate: bool = False) -> Array:
        """Return latitude, longitude and height (N, 3) of pixels at given heights, by Newton's method.

        The last step is below 1e-11 degrees (a micrometre on the ground).

        Parameters
        ----------
        pixels:
            (N, 2) x and y, +0.5 at the centre of a pixel.
        heights:
            (N,) metres, or one number for all.
        extrapolate:
            Also take heights outside :attr:`height_range`.

        Raises
        ------
        DataError
            For heights outside the RPC's range without ``extrapolate``, values that are not finite and pixels for
            which the iteration finds no place.
        """
        uv = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        metres = np.broadcast_to(np.asarray(heights, dtype=np.float64), (len(uv),))
        if not (np.isfinite(uv).all() and np.isfinite(metres).all()):
            raise DataError("Pixels or heights to localise are not finite")
        if not extrapolate:
            self.check_heights(metres)
        ground = np.empty((len(uv), 3))
        for start in range(0, len(uv), _ROWS_AT_ONCE):
            piece = slice(start, start + _ROWS_AT_ONCE)
            ground[piece] = self._located(uv[piece], metres[piece])
        return ground

    def _located(self, uv: Array, metres: Array) -> Array:
        place = np.zeros((3, len(uv)))
        place[2] = (metres - self.height_offset) / self.height_scale
        degrees = np.abs(np.array([[self.longitude_scale], [self.latitude_scale]]))
        active = np.arange(len(uv))
        for _ in range(_LOCATE_STEPS):
            step = self._newton_step(place[:, active], uv[active].T)
            # A place that runs away becomes no number, stays active, and is reported.
            step[:, ~(np.abs(place[:2, active] + step).max(axis=0) < _RUNAWAY)] = np.nan
            place[:2, active] += step
            active = active[~((np.abs(step) * degrees).max(axis=0) < _LOCATE_DEGREES)]
            if not len(active):
                break
        else:
            middle_x, middle_y = self._pixel_offset
            x, y = uv[active[0]]
            raise DataError(
                f"No place on the ground was found for {len(active)} of {len(uv)} pixels",
                expected=f"pixels in or near the picture, whose middle is ({middle_x:.1f}, {middle_y:.1f})",
                found=f"({x:.1f}, {y:.1f}) at a height of {metres[active[0]]:.1f} m, which does not converge",
            )
        ground = place[[1, 0, 2]].T * self.ground_scale + self.ground_offset
        ground[:, 2] = metres
        return ground

    def _newton_step(self, place: Array, uv: Array) -> Array:
        """Return the step (2, N) in normalised longitude and latitude that Newton's method takes."""
        values = terms(place)
        (x_by_x, y_by_x), (x_by_y, y_by_y) = self._slopes(values, term_derivatives(place)[:2])
        miss_x, miss_y = uv - self._pixels(values)
        determinant = x_by_x * y_by_y - x_by_y * y_by_x
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.stack([y_by_y * miss_x - x_by_y * miss_y, x_by_x * miss_y - y_by_x * miss_x]) / determinant

    def scaled(self, across: float, down: float) -> Rpc:
        """Return the RPC of the same picture with ``across`` times the columns and ``down`` times the lines."""
        return replace(
            self,
            sample_offset=(self.sample_offset + 0.5) * across - 0.5,
            sample_scale=self.sample_scale * across,
            line_offset=(self.line_offset + 0.5) * down - 0.5,
            line_scale=self.line_scale * down,
        )

    def cropped(self, x: float, y: float) -> Rpc:
        """Return the RPC of the piece of the picture whose top-left corner is ``(x, y)``."""
        return replace(self, sample_offset=self.sample_offset - x, line_offset=self.line_offset - y)


def _numbers(name: str, value: float | Iterable[float], polynomial: bool) -> float | tuple[float, ...]:
    """Return a field of an RPC as plain floats, or raise why it cannot be."""
    try:
        numbers = tuple(float(item) for item in value) if isinstance(value, Iterable) else (float(value),)
    except (TypeError, ValueError) as error:
        raise DataError(f"RPC's {name} is not made of numbers", found=repr(value)) from error
    if polynomial and len(numbers) != len(TERMS):
        raise DataError(
            f"RPC's {name} has a wrong number of coefficients",
            expected=f"{len(TERMS)}, in RPC00B's order",
            found=str(len(numbers)),
        )
    if not np.all(np.isfinite(numbers)):
        raise DataError(f"RPC's {name} is not finite", found=str(numbers))
    return numbers if polynomial else numbers[0]


def _metres(height: float) -> str:
    # Adding zero makes the minus of -0.0 go.
    return f"{round(float(height), 1) + 0.0:.1f}"
