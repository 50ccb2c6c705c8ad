"""Take pictures of the city from orbit and write them as they would be delivered, with the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from toolkit.errors import DataError, SettingsError, StageError, ToolkitError
from toolkit.files import atomic_folder, read_json, write_json
from toolkit.geometry.ellipsoid import geodetic_from_enu
from toolkit.geometry.rpc_fit import RpcFit, fit_rpc
from toolkit.optional import require
from toolkit.progress import Progress, silent, track
from toolkit.samples.city.imager import Radiometry, expose
from toolkit.samples.city.model import City, build_city
from toolkit.samples.city.pushbroom import PushbroomCamera
from toolkit.samples.city.render import render
from toolkit.samples.city.sample import (
    DELIVERED,
    DSM,
    ORIGIN,
    RECORD,
    VIEWS,
    CitySample,
    CityView,
    picture_size,
    rigorous_cameras,
    view_angles,
)
from toolkit.samples.city.settings import CitySettings
from toolkit.scene.dsm_files import enu_from_map, map_from_enu, utm_crs, write_dsm
from toolkit.scene.folder import write_scene
from toolkit.scene.raster import Raster, stretched
from toolkit.scene.raster_io import write_raster
from toolkit.scene.rpc_files import RpcFile, tags_from_facts
from toolkit.scene.satellite import sun_direction

Array = NDArray[np.float64]

_DAYS, _BIASES = 4, 5  # streams of random numbers after those of the city and the passes
_FIT_PIXELS, _FIT_HEIGHTS = 9, 5  # samples of the volume that an RPC is fitted over
_MARGIN = 30.0  # metres that an RPC holds beyond the lowest and the highest place


def make_city(folder: Path, settings: CitySettings, *, seed: int = 0, progress: Progress = silent) -> CitySample:
    """Take pictures of a city, unless the folder holds these very pictures already.

    The folder holds ``satellite/``, the pictures as delivered: GeoTIFFs of 11-bit counts in 16 bits, as such
    sensors give them (in 8 bits shadows would have a dozen greys), with an RPC, time and sun in their tags;
    ``images/``, the same stretched to 8 bits band by band, for everything that takes no more; the scene of those
    with the RPCs as delivered (``scene.json``); ``truth/`` with ``views.json`` (each view's RPC and its bias,
    directions of satellite and sun, radiometry) and ``dsm.tif`` (the highest surface at the middles of UTM cells,
    metres above the ellipsoid); and ``sample.json``. It appears whole or not at all. The same settings and seed
    give the same pictures on the same machine. Everything stands still from one pass to the next, parked cars too.

    Raises
    ------
    SettingsError
        Where the smallest bias is larger than the largest.
    StageError
        When the folder holds something else.
    RunError
        When the disk is full or may not be written.
    MissingDependencyError
        When rasterio, pyproj or Open3D is missing.
    """
    if settings.imager.bias_least > settings.imager.bias_most:
        raise SettingsError(
            "The smallest error of an RPC is larger than the largest",
            expected="bias_least of at most bias_most",
            found=f"{settings.imager.bias_least:g} and {settings.imager.bias_most:g}",
        )
    record = {"kind": "city", "seed": seed, "settings": settings.to_dict()}
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        if not (folder / RECORD).is_file() or read_json(folder / RECORD) != record:
            raise StageError(
                f"{folder} is in the way",
                expected="a new or an empty folder, or the city with these settings and this seed",
                todo="Choose another or move it away",
            )
        return open_city(folder)
    require("rasterio")  # before the work of rendering
    require("pyproj")
    city, cameras = build_city(settings, seed), rigorous_cameras(settings, seed)
    if folder.exists():
        folder.rmdir()
    with atomic_folder(folder) as temporary:
        for name in (DELIVERED, "images", "truth"):
            (temporary / name).mkdir(parents=True)
        views = tuple(
            _take(temporary, city, camera, number, seed)
            for number, camera in enumerate(track(cameras, "sample.city", progress))
        )
        write_json(temporary / VIEWS, [view.to_dict() for view in views])
        write_scene(CitySample(temporary, settings, seed, views).scene, temporary)
        _write_surface(temporary / DSM, city)
        write_json(temporary / RECORD, record)
    return open_city(folder)


def open_city(folder: Path) -> CitySample:
    """Return the city in a folder that :func:`make_city` wrote.

    Raises
    ------
    DataError
        Where it is none, or damaged.
    """
    missing = [name for name in (RECORD, VIEWS, DSM) if not (folder / name).is_file()]
    record = None if missing else read_json(folder / RECORD)
    if not isinstance(record, dict) or record.get("kind") != "city":
        raise DataError(
            f"{folder} is no city seen from orbit",
            expected=f"{RECORD} of a city, {VIEWS} and {DSM}",
            found=f"no {' and no '.join(missing)}" if missing else f"{RECORD} of something else",
            todo="Make it again in a new folder",
        )
    try:
        settings, seed = CitySettings.from_dict(record["settings"]), int(record["seed"])
    except (KeyError, TypeError, ValueError, ToolkitError) as error:
        raise DataError(f"{folder / RECORD} is damaged", found=str(error)) from error
    path = folder / VIEWS
    listed = read_json(path)
    try:
        views = tuple(CityView.from_dict(item, f"{path}, view {number}") for number, item in enumerate(listed))
    except (KeyError, TypeError, ValueError, ToolkitError) as error:
        raise DataError(f"{path} is damaged", expected="the truth of each view", found=str(error)) from error
    if len(views) != settings.orbit.views:
        raise DataError(
            f"{path} does not fit to the settings",
            expected=f"{settings.orbit.views} views",
            found=str(len(views)),
        )
    return CitySample(folder, settings, seed, views)


def fit_rigorous(camera: PushbroomCamera, lowest: float, highest: float) -> RpcFit:
    """Return the RPC of a rigorous camera over its picture and places ``lowest`` to ``highest`` metres up."""
    axis = np.linspace(0, camera.width, _FIT_PIXELS)
    pixels = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    origins, directions = camera.ray(pixels)
    layers = [
        origins + ((up - origins[:, 2]) / directions[:, 2])[:, None] * directions
        for up in np.linspace(lowest, highest, _FIT_HEIGHTS)
    ]
    places = geodetic_from_enu(np.concatenate(layers), camera.origin)
    return fit_rpc(np.tile(pixels, (_FIT_HEIGHTS, 1)), places)


def _take(folder: Path, city: City, camera: PushbroomCamera, number: int, seed: int) -> CityView:
    """Take picture ``number``, write it, and return what is true of it."""
    settings = city.settings.imager
    angles = view_angles(camera)
    random = np.random.default_rng([seed, _DAYS, number])
    radiometry = Radiometry.draw(settings, random)
    light = render(city, camera, sun_direction(angles["sun_elevation"], angles["sun_azimuth"]))
    counts = expose(light, radiometry, settings, random).transpose(2, 0, 1)
    low, high = city.heights
    fit = fit_rigorous(camera, low - _MARGIN, high + _MARGIN)
    chance = np.random.default_rng([seed, _BIASES, number])
    size, way = chance.uniform(settings.bias_least, settings.bias_most), chance.uniform(0, 2 * np.pi)
    bias = (float(size * np.cos(way)), float(size * np.sin(way)))
    # An RPC that belongs to a crop a little beside the picture is one whose pixels are all off by the same.
    rpc = fit.rpc.cropped(-bias[0], -bias[1])
    name = f"view_{number:02d}"
    told = RpcFile(
        Path(name),
        "",
        rpc,
        acquired=camera.orbit.time,
        sun_elevation=angles["sun_elevation"],
        sun_azimuth=angles["sun_azimuth"],
    )
    write_raster(folder / DELIVERED / f"{name}.tif", counts, rpc=rpc, tags=tags_from_facts(told))
    shown = stretched(Raster(counts.astype(np.float32), np.ones(counts.shape[1:], bool)))
    Image.fromarray(shown).save(folder / "images" / f"{name}.png")
    return CityView(
        name=f"{name}.png",
        time=camera.orbit.time,
        rpc=rpc,
        bias=bias,
        fit_rms_px=fit.rms_px,
        fit_max_px=fit.max_px,
        radiometry=radiometry,
        **angles,
    )


def _write_surface(path: Path, city: City) -> None:
    """Write the true surface as a map in UTM: the highest surface at the middles of cells, above the ellipsoid."""
    origin = (ORIGIN.latitude, ORIGIN.longitude, ORIGIN.altitude)
    crs = utm_crs(*origin[:2])
    side, step = picture_size(city.settings), city.settings.imager.ground_sampling
    # The map's corner is a whole number of cells, as maps have it.
    middle = map_from_enu([[0.0, 0.0, 0.0]], origin, crs)[0, :2]
    left, bottom = np.floor((middle - side * step / 2) / step) * step
    top = bottom + side * step
    along = (np.arange(side) + 0.5) * step
    east, north = np.meshgrid(left + along, top - along)
    cells = np.stack([east, north, np.full_like(east, origin[2])], axis=-1)
    plane = enu_from_map(cells, origin, crs)[:, :2]
    heights = map_from_enu(np.column_stack([plane, city.surface_height(plane)]), origin, crs)[:, 2]
    write_dsm(path, heights.reshape(side, side), (float(left), float(top)), step, crs)
