"""Satellite pictures with their RPCs as a scene: every view has its camera, and the ground gives the origin."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.geodesy import Origin, ecef_from_geodetic, enu_from_geodetic, geodetic_from_ecef
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.rpc import Rpc
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.scene.colmap_model import check_name
from toolkit.scene.pictures import open_picture
from toolkit.scene.raster_io import NITF_ENDINGS, RASTER_ENDINGS, open_raster
from toolkit.scene.rpc_files import RpcFile, by_name, picture_rpc, side_file
from toolkit.scene.scene import Frame, Georeference, Scene

Array = NDArray[np.float64]

# Heights at which footprints are compared: so many over the range of all RPCs, and each one's middle.
_HEIGHTS = 9
# RPCCoefficientTag.
_RPC_TAG = 50844


@dataclass(frozen=True, slots=True)
class SatelliteViews:
    """Pictures with an RPC, opened.

    Attributes
    ----------
    scene:
        A frame with an :class:`RpcCamera` for each picture.
    views:
        What the files told of each picture (sun, time), by the frame's name.
    warnings:
        What the user should know, a sentence each.
    """

    scene: Scene
    views: Mapping[str, RpcFile]
    warnings: tuple[str, ...]


def open_satellite(source: Path | Sequence[Path]) -> Scene:
    """Return satellite pictures as a scene: :func:`read_satellite` without sun, times and warnings."""
    return read_satellite(source).scene


def read_satellite(source: Path | Sequence[Path]) -> SatelliteViews:
    """Open satellite pictures with an RPC in their tags or in a file of their name.

    The world is east-north-up in metres; its origin, the scene's georeference, is the middle of the pictures'
    footprints at the mean of the RPCs' height offsets. Camera coordinates of an RPC camera are this world's, so
    that every ``cam_from_world`` is the identity. Times count from the first picture.

    Parameters
    ----------
    source:
        A folder, whose pictures (``.tif``, ``.tiff``, ``.ntf``, ``.nitf``) lie in ``images/`` or directly in it; or
        files: pictures, and RPC files of their names where these lie elsewhere. A file beside or in the list counts
        more than tags (:func:`toolkit.scene.rpc_files.picture_rpc`).

    Raises
    ------
    DataError
        Where there is no picture, one has no RPC or is damaged, an RPC file in the list belongs to no picture, or
        no two views overlap on the ground. In a folder, maps with real numbers (surface models) are left out, with
        a warning.
    MissingDependencyError
        Where rasterio is not installed.
    """
    image_dir, found, warnings = _folder_views(source) if isinstance(source, Path) else _listed_views(list(source))
    origin = _origin(found)
    groups = overlapping_groups({name: (view.rpc, *_size(view)) for name, view in found.items()}, origin)
    if len(groups) == len(found) > 1:
        raise DataError(
            f"The views in {image_dir} do not overlap on the ground",
            expected="pictures of one place",
            found=", ".join(f"{name} at {_place(view)}" for name, view in list(found.items())[:4]),
            todo="Open the pictures of each place by themselves",
        )
    if len(groups) > 1:
        alone = sorted(name for group in groups[1:] for name in group)
        warnings += (
            f"{len(alone)} of {len(found)} views do not overlap on the ground with the rest: {_some(alone)}",
        )
    times = {name: view.acquired.timestamp() for name, view in found.items() if view.acquired is not None}
    start = min(times.values(), default=0.0)
    cameras = {
        number: RpcCamera(view.rpc, *_size(view), origin) for number, view in enumerate(found.values(), start=1)
    }
    frames = tuple(
        Frame(name, number, RigidTransform.identity(), time=times[name] - start if name in times else None)
        for number, name in enumerate(found, start=1)
    )
    scene = Scene(image_dir, cameras, frames, georeference=Georeference(*origin))
    return SatelliteViews(scene, found, warnings)


def is_satellite(folder: Path) -> bool:
    """Return whether a folder holds a picture with an RPC, in its tags or in a file of its name."""
    pictures, beside = _pictures(folder)
    return any(_has_rpc(picture, beside) for picture in pictures)


def sun_direction(elevation: float, azimuth: float) -> Array:
    """Return the unit vector (3,), east-north-up, to the sun: degrees above horizon and clockwise from north."""
    up, around = np.radians(elevation), np.radians(azimuth)
    return np.array([np.sin(around) * np.cos(up), np.cos(around) * np.cos(up), np.sin(up)])


def footprint(rpc: Rpc, width: int, height: int, altitude: float) -> Array:
    """Return latitude, longitude, height (4, 3) of a picture's corners at metres above the ellipsoid.

    The corners are those of the image, clockwise from the top left one; the altitude may be outside the RPC's
    range.
    """
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float64)
    return rpc.locate(corners, altitude, extrapolate=True)


def _named_footprint(name: str, rpc: Rpc, width: int, height: int, altitude: float) -> Array:
    try:
        return footprint(rpc, width, height, altitude)
    except DataError as error:
        raise DataError(f"The RPC of {name} has no footprint", found=str(error).rstrip(".")) from error


def overlapping_groups(views: Mapping[str, tuple[Rpc, int, int]], origin: Origin) -> list[list[str]]:
    """Return which views hang together by overlapping on the ground, the largest group first.

    Two views overlap where their footprints do at some height that both RPCs were made for: what does not overlap
    by this shows no place in common.

    Parameters
    ----------
    views:
        RPC, width and height of each by its name.
    origin:
        Of the local frame that footprints are compared in.
    """
    ranges = [rpc.height_range for rpc, _, _ in views.values()]
    lowest, highest = min(low for low, _ in ranges), max(high for _, high in ranges)
    middles = [rpc.height_offset for rpc, _, _ in views.values()]
    altitudes = np.unique([*np.linspace(lowest, highest, _HEIGHTS), *middles])
    corners = {
        name: {
            altitude: enu_from_geodetic(_named_footprint(name, rpc, width, height, altitude), origin)[:, :2]
            for altitude in altitudes.tolist()
            if rpc.height_range[0] <= altitude <= rpc.height_range[1]
        }
        for name, (rpc, width, height) in views.items()
    }
    group = {name: {name} for name in views}
    for one, other in itertools.combinations(views, 2):
        common = corners[one].keys() & corners[other].keys()
        if other not in group[one] and any(_overlap(corners[one][at], corners[other][at]) for at in common):
            joined = group[one] | group[other]
            group |= dict.fromkeys(joined, joined)
    order = {name: i for i, name in enumerate(views)}
    sets = {min(names, key=order.__getitem__): names for names in group.values()}
    return sorted((sorted(names, key=order.__getitem__) for names in sets.values()), key=len, reverse=True)


def _overlap(one: Array, other: Array) -> bool:
    """Return whether two convex polygons (n, 2) meet: no side keeps them apart (separating axis theorem)."""
    sides = np.concatenate([np.roll(polygon, -1, axis=0) - polygon for polygon in (one, other)])
    normals = np.stack([-sides[:, 1], sides[:, 0]])
    mine, theirs = one @ normals, other @ normals
    return bool(np.all((mine.max(axis=0) >= theirs.min(axis=0)) & (theirs.max(axis=0) >= mine.min(axis=0))))


def _pictures(folder: Path) -> tuple[list[Path], dict[str, Path]]:
    """Return the pictures of a folder, in order of their names, and by name all files that may hold their RPCs."""
    image_dir = folder / "images" if (folder / "images").is_dir() else folder
    try:
        inside = sorted(path for path in image_dir.iterdir() if path.is_file() and not path.name.startswith("."))
        outside = sorted(path for path in folder.iterdir() if path.is_file()) if image_dir != folder else []
    except OSError as error:
        raise DataError(f"Cannot read folder {folder}", found=str(error)) from error
    return [path for path in inside if path.suffix.lower() in RASTER_ENDINGS], by_name(inside + outside)


def _folder_views(folder: Path) -> tuple[Path, dict[str, RpcFile], tuple[str, ...]]:
    pictures, beside = _pictures(folder)
    found, maps = {}, []
    for picture in pictures:
        view = picture_rpc(picture, beside)
        if view is not None:
            found[_checked_name(picture.name)] = view
        elif _is_map(picture):
            maps.append(picture.name)
        else:
            raise _no_rpc(picture)
    if not found:
        raise DataError(
            f"No satellite pictures in {folder}",
            expected=f"pictures ({', '.join(RASTER_ENDINGS)}) with RPCs, in it or in images/",
            found=_some(maps or [path.name for path in beside.values()]) or "an empty folder",
        )
    warnings = (f"left out, being maps and no pictures: {_some(maps)}",) if maps else ()
    return folder / "images" if (folder / "images").is_dir() else folder, found, warnings


def _listed_views(files: list[Path]) -> tuple[Path, dict[str, RpcFile], tuple[str, ...]]:
    pictures = [path for path in files if path.suffix.lower() in RASTER_ENDINGS]
    others = [path for path in files if path not in pictures]
    missing = next((path for path in files if not path.is_file()), None)
    if missing is not None:
        raise DataError(f"{missing} is missing", expected="a picture or its RPC")
    if not pictures:
        raise DataError(
            "No satellite pictures among the files",
            expected=", ".join(RASTER_ENDINGS),
            found=_some(map(str, others)),
        )
    root = Path(os.path.commonpath([path.parent.absolute() for path in pictures]))
    found, used = {}, set()
    for picture in pictures:
        view = picture_rpc(picture, by_name([*others, *sorted(picture.parent.iterdir())]))
        if view is None:
            raise _no_rpc(picture)
        used.add(view.path)
        found[_checked_name(picture.absolute().relative_to(root).as_posix())] = view
    idle = [path for path in others if path not in used]
    if idle:
        raise DataError(
            f"{idle[0]} belongs to no picture by its name",
            expected="names like a.tif and a.RPB, a_RPC.TXT, a.geom or a.json, IMG_a_R1C1.TIF and RPC_a.XML",
            found=_some(path.name for path in pictures),
        )
    return root, found, ()


def _has_rpc(picture: Path, among: Mapping[str, Path]) -> bool:
    """Return whether a picture has an RPC beside it or in its tags, without GDAL and without reading it.

    Tags are seen in GeoTIFFs, and taken for granted in NITF files; a damaged picture has none.
    """
    if side_file(picture, among) is not None:
        return True
    if picture.suffix.lower() in NITF_ENDINGS:
        return True
    try:
        with open_picture(picture) as opened:
            return _RPC_TAG in getattr(opened, "tag_v2", {})
    except DataError:
        return False


def _is_map(picture: Path) -> bool:
    with open_raster(picture) as dataset:
        return dataset.crs is not None and all(kind.startswith("float") for kind in dataset.dtypes)


def _no_rpc(picture: Path) -> DataError:
    return DataError(
        f"Picture {picture} has no RPC",
        expected="one in its tags, or a file beside it: .RPB, _RPC.TXT, .rpc, .geom, .xml or .json",
        todo="Put the RPC file that came with the picture beside it, or take the picture out",
    )


def _checked_name(name: str) -> str:
    check_name(name)
    return name


def _size(view: RpcFile) -> tuple[int, int]:
    """Return a picture's size, which is always known of a picture that was opened."""
    assert view.width is not None
    assert view.height is not None
    return view.width, view.height


def _origin(found: Mapping[str, RpcFile]) -> Origin:
    """Return the middle of all footprints at the mean height offset."""
    altitude = float(np.mean([view.rpc.height_offset for view in found.values()]))
    corners = [_named_footprint(name, view.rpc, *_size(view), altitude) for name, view in found.items()]
    # The mean is taken in earth-centred coordinates: longitudes jump at the date line.
    latitude, longitude, _ = geodetic_from_ecef(ecef_from_geodetic(np.concatenate(corners)).mean(axis=0))[0]
    return float(latitude), float(longitude), altitude


def _place(view: RpcFile) -> str:
    return f"{view.rpc.latitude_offset:.4f}, {view.rpc.longitude_offset:.4f}"


def _some(names: Iterable[str]) -> str:
    listed = list(names)
    return ", ".join(listed[:5]) + (", ..." if len(listed) > 5 else "")
