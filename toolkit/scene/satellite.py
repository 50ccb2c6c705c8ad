"""Satellite pictures with their RPCs as a scene: every view has its camera, and the ground gives the origin."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.geometry.ellipsoid import geodetic_from_enu
from toolkit.geometry.geodesy import Origin
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.scene.colmap_model import check_name
from toolkit.scene.footprints import named_footprint, overlapping_groups
from toolkit.scene.pictures import RPC_TAG, open_picture
from toolkit.scene.raster_io import NITF_ENDINGS, RASTER_ENDINGS, open_raster
from toolkit.scene.rpc_files import RpcFile, by_name, picture_rpc, side_file
from toolkit.scene.scene import Frame, Georeference, Scene

Array = NDArray[np.float64]


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
        files: pictures, and RPC files of their names where these lie in no picture's folder. A file beside the
        picture counts most, then one in the list, then tags (:func:`toolkit.scene.rpc_files.picture_rpc`).

    Raises
    ------
    DataError
        Where there is no picture, one has no RPC or is damaged, an RPC file in the list belongs to no picture or to
        two of one name, or no two views overlap on the ground. In a folder, maps with real numbers (surface models)
        are left out, with a warning.
    MissingDependencyError
        Where rasterio is not installed.
    """
    image_dir, found, warnings = _folder_views(source) if isinstance(source, Path) else _listed_views(list(source))
    origin = _origin(found)
    views = {name: RpcCamera(view.rpc, *_size(view), origin) for name, view in found.items()}
    groups = overlapping_groups(views)
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
    frames = tuple(
        Frame(name, number, RigidTransform.identity(), time=times[name] - start if name in times else None)
        for number, name in enumerate(found, start=1)
    )
    scene = Scene(image_dir, dict(enumerate(views.values(), start=1)), frames, georeference=Georeference(*origin))
    return SatelliteViews(scene, found, warnings)


def is_satellite(folder: Path) -> bool:
    """Return whether a folder holds a picture with an RPC, in its tags or in a file of its name."""
    pictures, beside = _pictures(folder)
    return any(_has_rpc(picture, beside) for picture in pictures)


def sun_direction(elevation: float, azimuth: float) -> Array:
    """Return the unit vector (3,), east-north-up, to the sun: degrees above horizon and clockwise from north."""
    up, around = np.radians(elevation), np.radians(azimuth)
    return np.array([np.sin(around) * np.cos(up), np.cos(around) * np.cos(up), np.sin(up)])


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
        view = picture_rpc(picture, side_file(picture, beside))
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
    sides = _listed_side_files(pictures, others)
    found = {}
    for picture in pictures:
        view = picture_rpc(picture, sides[picture])
        if view is None:
            raise _no_rpc(picture)
        found[_checked_name(picture.absolute().relative_to(root).as_posix())] = view
    used = {path.absolute() for path in sides.values() if path is not None}
    idle = [path for path in others if path.absolute() not in used]
    if idle:
        raise DataError(
            f"{idle[0]} belongs to no picture by its name",
            expected="names like a.tif and a.RPB, a_RPC.TXT, a.geom or a.json, IMG_a_R1C1.TIF and RPC_a.XML, for a "
            "picture without such a file in its own folder",
            found=_some(path.name for path in pictures),
        )
    return root, found, ()


def _listed_side_files(pictures: Sequence[Path], others: Sequence[Path]) -> dict[Path, Path | None]:
    """Return the RPC file of each picture: from its own folder, else a listed one that lies in no picture's folder.

    Raises
    ------
    DataError
        Where a listed file fits two pictures of one name.
    """
    folders = {picture.parent.absolute() for picture in pictures}
    beside = {folder: by_name(sorted(folder.iterdir())) for folder in folders}
    elsewhere = by_name(path for path in others if path.parent.absolute() not in folders)
    sides: dict[Path, Path | None] = {}
    taken: dict[tuple[Path, str], Path] = {}
    for picture in pictures:
        side = side_file(picture, beside[picture.parent.absolute()])
        if side is None and (side := side_file(picture, elsewhere)) is not None:
            # Tiles of one picture share a file; pictures of the same name do not.
            other = taken.setdefault((side, picture.stem.lower()), picture)
            if other != picture:
                raise DataError(
                    f"{side} fits two pictures by its name",
                    expected="an RPC file for each picture",
                    found=f"{other} and {picture}",
                    todo="Put each RPC file into the folder of its picture",
                )
        sides[picture] = side
    return sides


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
            return RPC_TAG in getattr(opened, "tag_v2", {})
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
    first = next(iter(found.values())).rpc
    near = (first.latitude_offset, first.longitude_offset, altitude)
    corners = [
        named_footprint(name, RpcCamera(view.rpc, *_size(view), near), altitude) for name, view in found.items()
    ]
    # The mean is taken in metres: longitudes jump at the date line.
    latitude, longitude, _ = geodetic_from_enu(np.concatenate(corners).mean(axis=0), near)[0]
    return float(latitude), float(longitude), altitude


def _place(view: RpcFile) -> str:
    return f"{view.rpc.latitude_offset:.4f}, {view.rpc.longitude_offset:.4f}"


def _some(names: Iterable[str]) -> str:
    listed = list(names)
    return ", ".join(listed[:5]) + (", ..." if len(listed) > 5 else "")
