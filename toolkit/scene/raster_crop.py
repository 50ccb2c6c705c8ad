"""A part of a satellite picture as a picture of its own, with the RPC of the part."""

from __future__ import annotations

from pathlib import Path

from toolkit.errors import DataError
from toolkit.scene.raster_io import Box, open_raster, read_pixels, write_raster
from toolkit.scene.rpc_files import RpcFile, picture_rpc, read_rpc, side_file, tags_from_facts


def crop_raster(path: Path, box: Box, target: Path) -> RpcFile:
    """Write a part of a picture as a GeoTIFF whose RPC is that of the part.

    Parameters
    ----------
    path:
        Of a GeoTIFF or NITF with an RPC in it or beside it (:func:`toolkit.scene.rpc_files.picture_rpc`).
    box:
        Left, top, right and bottom edge in pixels of the part.
    target:
        GeoTIFF, replaced in one step. Pixels keep their type and their value for no data; sun and time of the view
        are in its tags.

    Returns
    -------
    What :func:`toolkit.scene.rpc_files.read_rpc` reads from ``target``.

    Raises
    ------
    DataError
        As :func:`toolkit.scene.raster.read_raster`, and where the picture has no RPC.
    RunError
        When the disk is full or the folder may not be written.
    """
    whole = picture_rpc(path, side_file(path))
    if whole is None:
        raise DataError(
            f"Picture {path} has no RPC",
            expected="one in its tags or in a file beside it",
            todo="Without one, any program can cut it",
        )
    with open_raster(path) as dataset:
        pixels, _ = read_pixels(dataset, path, box)
        nodata = dataset.nodata
    rpc = whole.rpc.cropped(box[0], box[1])
    write_raster(target, pixels, rpc=rpc, nodata=nodata, tags=tags_from_facts(whole))
    return read_rpc(target)
