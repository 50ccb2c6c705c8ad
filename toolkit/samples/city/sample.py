"""A city in its folder, with everything that is known of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.ellipsoid import enu_axes
from toolkit.geometry.geodesy import Origin, geodetic_from_ecef
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.rpc import Rpc
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.samples.city.imager import Radiometry
from toolkit.samples.city.model import City, build_city
from toolkit.samples.city.orbit import plan_passes
from toolkit.samples.city.pushbroom import PushbroomCamera
from toolkit.samples.city.settings import CitySettings
from toolkit.samples.city.sun import sun_angles
from toolkit.scene import Frame, Georeference, Scene
from toolkit.scene.dsm_files import SurfaceModel, read_dsm
from toolkit.scene.rpc_fields import fields_from_rpc, rpc_from_fields

Array = NDArray[np.float64]

ORIGIN = Georeference(latitude=30.3, longitude=-81.7, altitude=-22.0)
"""Where the middle of the city is said to lie: in Jacksonville, where the paper's DFC2019 pictures were taken."""

RECORD, VIEWS, DSM = "sample.json", "truth/views.json", "truth/dsm.tif"
DELIVERED = "satellite"
"""Folder of the pictures as a satellite's owner delivers them."""

PASSES = 3
"""Stream of random numbers of the passes; those below are the city's."""


@dataclass(frozen=True, slots=True, eq=False)
class CityView:
    """What is true of one picture.

    Attributes
    ----------
    name:
        Of the frame; the delivered GeoTIFF has the same stem.
    time:
        When its middle line was taken, UTC.
    rpc:
        As delivered: it puts every place ``bias`` pixels (x, y) from where the picture shows it.
    fit_rms_px, fit_max_px:
        How far the RPC without the bias is from the rigorous camera, in pixels, over the fit's grid.
    satellite:
        (3,) unit vector, east, north, up, from the city's middle to the satellite.
    zenith_angle, azimuth, off_nadir:
        Degrees: of the satellite seen from the city, from the vertical and clockwise from north; and of the city
        seen from the satellite, from the ellipsoid's normal there.
    sun_azimuth, sun_elevation:
        Degrees clockwise from north and above the horizon.
    radiometry:
        How counts come from light.
    """

    name: str
    time: datetime
    rpc: Rpc
    bias: tuple[float, float]
    fit_rms_px: float
    fit_max_px: float
    satellite: Array
    zenith_angle: float
    azimuth: float
    off_nadir: float
    sun_azimuth: float
    sun_elevation: float
    radiometry: Radiometry

    @property
    def correction(self) -> tuple[float, ...]:
        """What makes the delivered RPC true: :attr:`toolkit.geometry.rpc_camera.RpcCamera.correction`."""
        return (-self.bias[0], 0.0, 0.0, -self.bias[1], 0.0, 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values from which :meth:`from_dict` makes the same view, to the bit."""
        return {
            "name": self.name,
            "time": self.time.isoformat(),
            "rpc": fields_from_rpc(self.rpc),
            "bias_px": list(self.bias),
            "fit_rms_px": self.fit_rms_px,
            "fit_max_px": self.fit_max_px,
            "satellite_direction": self.satellite.tolist(),
            "zenith_angle": self.zenith_angle,
            "azimuth": self.azimuth,
            "off_nadir": self.off_nadir,
            "sun_azimuth": self.sun_azimuth,
            "sun_elevation": self.sun_elevation,
            "radiometry": asdict(self.radiometry),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], where: str) -> CityView:
        """Return a view of what :meth:`to_dict` gave; ``where`` says in errors where that comes from.

        Raises
        ------
        KeyError, TypeError, ValueError, DataError
            For what is none.
        """
        across, down = values["bias_px"]
        east, north, up = values["satellite_direction"]
        return cls(
            name=str(values["name"]),
            time=datetime.fromisoformat(values["time"]),
            rpc=rpc_from_fields(values["rpc"], where),
            bias=(float(across), float(down)),
            satellite=np.array([east, north, up], dtype=np.float64),
            radiometry=Radiometry(**values["radiometry"]),
            **{name: float(values[name]) for name in _NUMBERS},
        )


_NUMBERS = (*("fit_rms_px", "fit_max_px", "zenith_angle", "azimuth", "off_nadir", "sun_azimuth", "sun_elevation"),)


@dataclass(frozen=True, eq=False)
class CitySample:
    """A city seen by a satellite, and its truth. The world is metres east, north and up of the city's middle.

    Attributes
    ----------
    folder:
        Where its files are.
    settings, seed:
        What it was made with.
    views:
        What is true of each picture, in order of time.
    """

    folder: Path
    settings: CitySettings
    seed: int
    views: tuple[CityView, ...]

    @property
    def origin(self) -> Origin:
        """Latitude, longitude and height above the ellipsoid of the world's 0, 0, 0."""
        return (ORIGIN.latitude, ORIGIN.longitude, ORIGIN.altitude)

    @cached_property
    def scene(self) -> Scene:
        """All pictures with their RPCs as delivered, which are wrong by 1 to 3 pixels."""
        return self._scene(true=False)

    @cached_property
    def true_scene(self) -> Scene:
        """All pictures with their RPCs corrected by the true bias."""
        return self._scene(true=True)

    def _scene(self, *, true: bool) -> Scene:
        side = picture_size(self.settings)
        still = (0.0,) * 6
        cameras = {
            number: RpcCamera(view.rpc, side, side, self.origin, view.correction if true else still)
            for number, view in enumerate(self.views, start=1)
        }
        frames = tuple(
            Frame(
                view.name, number, RigidTransform.identity(), time=(view.time - self.views[0].time).total_seconds()
            )
            for number, view in enumerate(self.views, start=1)
        )
        return Scene(self.folder / "images", cameras, frames, georeference=ORIGIN)

    @property
    def dsm_map(self) -> Path:
        """The file of the true surface: a GeoTIFF in UTM, heights above the ellipsoid."""
        return self.folder / DSM

    @cached_property
    def dsm(self) -> SurfaceModel:
        """The true surface: heights above the ellipsoid of the highest places at the middles of UTM cells.

        The same without cells, in the world's metres, is :attr:`city`: ``city.surface_height(places)``.
        """
        model = read_dsm(self.dsm_map)
        side = picture_size(self.settings)
        if model.heights.shape != (side, side):
            raise DataError(
                f"{self.dsm_map} is not this city's",
                expected=f"{side} x {side} cells",
                found=" x ".join(map(str, model.heights.shape)),
            )
        return model

    def delivered(self, i: int) -> Path:
        """Return the path of picture ``i`` as delivered: GeoTIFF, 11 bits, with the biased RPC in its tags."""
        return self.folder / DELIVERED / f"{Path(self.views[i].name).stem}.tif"

    @cached_property
    def cameras(self) -> tuple[PushbroomCamera, ...]:
        """The rigorous camera of each picture."""
        return rigorous_cameras(self.settings, self.seed)

    @cached_property
    def city(self) -> City:
        """The city, built again: its triangles and rays cast against them."""
        return build_city(self.settings, self.seed)


def picture_size(settings: CitySettings) -> int:
    """Return the pixels of a picture's side, and the cells of the surface's."""
    return max(1, round(settings.plan.size / settings.imager.ground_sampling))


def rigorous_cameras(settings: CitySettings, seed: int) -> tuple[PushbroomCamera, ...]:
    """Return the rigorous cameras of the pictures of a city, in order of time."""
    origin = (ORIGIN.latitude, ORIGIN.longitude, ORIGIN.altitude)
    focal = 1000 * settings.orbit.altitude / settings.imager.ground_sampling
    passes = plan_passes(settings.orbit, origin, np.random.default_rng([seed, PASSES]))
    side = picture_size(settings)
    return tuple(PushbroomCamera.aimed(one, origin, np.zeros(3), side, focal) for one in passes)


def view_angles(camera: PushbroomCamera) -> dict[str, Any]:
    """Return what :class:`CityView` tells of where satellite and sun stood at a picture's middle."""
    middle = camera.satellite([0.5 * camera.height])[0]
    satellite = middle / np.linalg.norm(middle)
    place = camera.orbit.position(np.zeros(1))
    normal = enu_axes(*geodetic_from_ecef(place)[0, :2])[0, 2]
    back = camera.earth_centred(satellite[None])[0]
    azimuth, elevation = sun_angles(camera.orbit.time, *camera.origin[:2])
    return {
        "satellite": satellite,
        "zenith_angle": float(np.degrees(np.arccos(satellite[2]))),
        "azimuth": float(np.degrees(np.arctan2(satellite[0], satellite[1])) % 360),
        "off_nadir": float(np.degrees(np.arccos(np.clip(back @ normal, -1, 1)))),
        "sun_azimuth": azimuth,
        "sun_elevation": elevation,
    }
