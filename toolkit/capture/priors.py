"""Where the camera was and where it looked at the time of each frame, from telemetry."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from toolkit.capture.telemetry import Readings, Telemetry
from toolkit.errors import SettingsError, StageError
from toolkit.geometry.attitude import Attitude, cam_from_enu
from toolkit.scene import Georeference, PosePrior
from toolkit.scene.priors import GeodeticReading, priors_from_readings
from toolkit.settings import Choice, Number, Settings

Array = NDArray[np.float64]

# Rows: the camera's x (right), y (down) and z (forward) in body axes (forward, right, down).
_CAM_FROM_BODY = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


def _lever(where: str) -> Number:
    return Number(
        0.0,
        bounds=(-100.0, 100.0),
        unit="m",
        doc=f"How far the camera is {where} the receiver's antenna, in body axes.",
    )


def _boresight(axis: str, effect: str) -> Number:
    return Number(
        0.0,
        bounds=(-180.0, 180.0),
        unit="deg",
        doc=f"Turn of the camera about its own {axis} axis against the attitude in the log; positive {effect}.",
    )


class TelemetrySettings(Settings):
    """How telemetry is read, and how far it is trusted."""

    attitude_source = Choice(
        "gimbal",
        choices=("gimbal", "flight", "none"),
        doc="Which attitude is the camera's: the gimbal's, the airframe's (a camera that is fixed to it), or none.",
    )
    altitude_source = Choice(
        "absolute",
        choices=("absolute", "takeoff"),
        doc="Which height counts: the receiver's, or that above the place of take-off (the barometer's).",
    )
    takeoff_altitude = Number(
        0.0,
        bounds=(-1000.0, 9000.0),
        unit="m",
        doc="Height of the take-off above the ellipsoid, for heights above it.",
    )
    time_offset = Number(
        0.0, bounds=(-1e6, 1e6), unit="s", doc="Added to the time of a frame to get the telemetry's time."
    )
    max_gap = Number(
        2.0, bounds=(0.001, 3600.0), unit="s", doc="Nothing is interpolated between readings further apart."
    )
    horizontal_sigma = Number(
        1.0, bounds=(0.001, 100.0), unit="m", doc="Standard deviation of the position east and north."
    )
    vertical_sigma = Number(1.5, bounds=(0.001, 1000.0), unit="m", doc="Standard deviation of the height.")
    angle_sigma = Number(
        2.0, bounds=(0.01, 90.0), unit="deg", doc="Standard deviation of the attitude about each camera axis."
    )
    heading_bias = Number(
        0.0,
        bounds=(-180.0, 180.0),
        unit="deg",
        doc="How far headings in the log are clockwise of the truth (minus the declination for magnetic ones).",
    )
    lever_forward = _lever("ahead of")
    lever_right = _lever("to the right of")
    lever_down = _lever("below")
    boresight_x = _boresight("x (right)", "looks higher")
    boresight_y = _boresight("y (down)", "looks further right")
    boresight_z = _boresight("z (forward)", "lowers the right-hand side")


def telemetry_priors(
    telemetry: Telemetry, times: ArrayLike, settings: TelemetrySettings, origin: Georeference | None = None
) -> tuple[tuple[PosePrior | None, ...], Georeference, tuple[str, ...]]:
    """Return what telemetry says of the camera at the time of each frame.

    The sensor poses of "A-3DGS", section 3.2.2: GPS, height and north-aligned orientation in a local metric frame
    whose origin is the centre of the trajectory.

    Parameters
    ----------
    telemetry:
        The log.
    times:
        (N,) seconds of the frames by the log's clock, but for ``settings.time_offset``.
    settings:
        How it is read. The lever arm turns with the airframe's attitude; the boresight is a rotation vector about
        the camera's axes.
    origin:
        Of the local frame; by default the middle of the frames' positions.

    Returns
    -------
    A prior for each frame in metres east, north and up (None where nothing is known of it), the origin, and
    warnings. The position, or the rotation, of a prior is None where the log has a gap.

    Raises
    ------
    SettingsError
        Where the attitude or the height that the settings ask for is not in the log.
    StageError
        Where no frame has a position.
    """
    check_telemetry(telemetry, settings)
    wanted = np.asarray(times, dtype=np.float64) + settings.time_offset
    found = telemetry.at(wanted, settings.max_gap)
    above = settings.takeoff_altitude + found.height if settings.altitude_source == "takeoff" else found.altitude
    places = np.column_stack([found.latitude, found.longitude, above])
    placed = np.isfinite(places).all(axis=1)
    if not placed.any():
        raise StageError(
            "No frame has a position in the telemetry",
            expected=f"frames within its {telemetry.times[0]:.3f} to {telemetry.times[-1]:.3f} s",
            found=f"{len(wanted)} frames" + (f" from {wanted[0]:.3f} to {wanted[-1]:.3f} s" if len(wanted) else ""),
            todo="Set time_offset, or max_gap where readings are further apart",
        )
    where = origin or _middle(places[placed])
    cameras = _attitudes(found, settings.attitude_source, settings.heading_bias)
    sigma = (settings.horizontal_sigma, settings.horizontal_sigma, settings.vertical_sigma)
    readings = [
        GeodeticReading((place[0], place[1], place[2]) if known else None, camera, sigma, settings.angle_sigma)
        for place, known, camera in zip(places.tolist(), placed, cameras, strict=True)
    ]
    airframe = _attitudes(found, "flight", settings.heading_bias)
    made = priors_from_readings(readings, where)
    priors = tuple(_mounted(prior, body, settings) for prior, body in zip(made, airframe, strict=True))
    return priors, where, (*telemetry.warnings, *found.warnings, *_doubts(telemetry, settings, priors))


def check_telemetry(telemetry: Telemetry, settings: TelemetrySettings) -> None:
    """Raise :class:`SettingsError` where the log lacks an attitude or a height that the settings ask for."""
    named = telemetry.source or "the telemetry"
    has = [kind for kind in ("gimbal", "flight") if np.isfinite(getattr(telemetry, kind)).any()]
    if settings.attitude_source not in ("none", *has):
        raise SettingsError(
            f"There is no {settings.attitude_source} attitude in {named}",
            expected=f"attitude_source {' or '.join([*has, 'none'])}",
            found=f"attitude_source {settings.attitude_source}",
            todo="The flight attitude is the camera's only where the camera is fixed to the airframe"
            if has == ["flight"]
            else "",
        )
    heights = {"absolute": telemetry.altitude, "takeoff": telemetry.height}
    known = [kind for kind, values in heights.items() if np.isfinite(values).any()]
    if settings.altitude_source not in known:
        raise SettingsError(
            f"There is no {settings.altitude_source} height in {named}",
            expected=f"altitude_source {known[0]}" if known else "telemetry with heights",
            found=f"altitude_source {settings.altitude_source}",
        )
    if any(_lever_arm(settings)) and "flight" not in has:
        raise SettingsError(
            f"A lever arm needs the flight attitude, which is not in {named}",
            expected="lever_forward, lever_right and lever_down of 0",
            found=", ".join(f"{value:g} m" for value in _lever_arm(settings)),
        )


def _lever_arm(settings: TelemetrySettings) -> tuple[float, float, float]:
    return settings.lever_forward, settings.lever_right, settings.lever_down


def _middle(places: Array) -> Georeference:
    """Return the mean place; longitudes are averaged the short way round."""
    longitude = places[0, 1] + ((places[:, 1] - places[0, 1] + 180.0) % 360.0 - 180.0).mean()
    turned = (longitude + 180.0) % 360.0 - 180.0
    return Georeference(float(places[:, 0].mean()), float(turned), float(places[:, 2].mean()))


def _attitudes(found: Readings, source: str, heading_bias: float) -> list[Attitude | None]:
    if source == "none":
        return [None] * len(found)
    angles = found.gimbal if source == "gimbal" else found.flight
    return [
        Attitude(yaw - heading_bias, pitch, roll) if math.isfinite(yaw) else None
        for yaw, pitch, roll in angles.tolist()
    ]


def _mounted(prior: PosePrior | None, body: Attitude | None, settings: TelemetrySettings) -> PosePrior | None:
    """Move a prior from the antenna to the camera, and turn it by the boresight."""
    if prior is None:
        return None
    lever, position, rotation = np.array(_lever_arm(settings)), prior.position, prior.rotation
    if position is not None and lever.any():
        # Without the airframe's attitude the camera's place is not known.
        position = None if body is None else position + cam_from_enu(body).T @ (_CAM_FROM_BODY @ lever)
    turn = np.radians([settings.boresight_x, settings.boresight_y, settings.boresight_z])
    if rotation is not None and turn.any():
        rotation = Rotation.from_rotvec(-turn).as_matrix() @ rotation
    sigma = prior.position_sigma if position is not None else None
    moved = dataclasses.replace(prior, position=position, position_sigma=sigma, rotation=rotation)
    return None if position is None and rotation is None else moved


def _doubts(
    telemetry: Telemetry, settings: TelemetrySettings, priors: Sequence[PosePrior | None]
) -> tuple[str, ...]:
    """Say what the log does not, and what was taken for it."""
    doubts = []
    positions = sum(prior is not None and prior.position is not None for prior in priors)
    if positions < len(priors):
        doubts.append(f"{len(priors) - positions} of {len(priors)} frames have no position prior")
    rotations = sum(prior is not None and prior.rotation is not None for prior in priors)
    if settings.attitude_source != "none" and rotations < len(priors):
        doubts.append(f"{len(priors) - rotations} of {len(priors)} frames have no attitude prior")
    if rotations and telemetry.north == "unknown":
        doubts.append("The log does not say whether headings are from true or magnetic north: taken as true")
    if rotations and telemetry.north == "magnetic" and settings.heading_bias == 0.0:
        doubts.append("Headings are from magnetic north and heading_bias is 0: they are off by the declination")
    if settings.altitude_source == "takeoff":
        doubts.append(f"Heights are above the take-off, which is taken as {settings.takeoff_altitude:g} m high")
    elif telemetry.altitude_reference != "ellipsoid":
        about = (
            "are above the sea" if telemetry.altitude_reference == "sea level" else "do not say above what they are"
        )
        doubts.append(f"Altitudes {about}: taken as above the ellipsoid, which moves the whole scene up or down")
    return tuple(doubts)
