"""What RPCs say and what simpler cameras make of them, for every RPC in the folders of real satellite data.

``TOOLKIT_DATA=<folder> python tests/benchmarks/rpc_cameras.py`` prints, for each file with an RPC under
``sat_rpc_only``, ``sat_rpc_shareloc`` and ``sat_pleiades_s2p``:

- the greatest difference to GDAL over 500 pixels and heights: projection in pixels, localisation in metres;
- rms and max in pixels of an affine and a perspective camera over 500 m x 500 m x 100 m at the picture's middle;
- zenith angle and azimuth to the satellite from the exact ray, and the paper's off-nadir angle and azimuth.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning
from rasterio.transform import RPCTransformer

from toolkit.errors import DataError
from toolkit.geometry.geodesy import enu_from_geodetic
from toolkit.geometry.rpc import Rpc
from toolkit.geometry.rpc_angles import paper_angles, viewing_ray
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.geometry.rpc_fit import fit_affine_camera, fit_perspective_camera
from toolkit.scene.rpc_files import RpcFile, read_rpc

FOLDERS = ("sat_rpc_only", "sat_rpc_shareloc", "sat_pleiades_s2p")
ENDINGS = (".json", ".xml", ".txt", ".rpc", ".rpc_adj", ".geom", ".ntf", ".tif")
#: Half sides of the box in metres east, north and up.
HALF = np.array([250.0, 250.0, 50.0])
SAMPLES = 500


def gdal_transformer(rpc: Rpc) -> RPCTransformer:
    """Return GDAL's transformer, whose inverse iterates until the pixel is met to 1e-7."""
    described = rasterio.rpc.RPC(
        line_num_coeff=list(rpc.line_num),
        line_den_coeff=list(rpc.line_den),
        samp_num_coeff=list(rpc.sample_num),
        samp_den_coeff=list(rpc.sample_den),
        line_off=rpc.line_offset,
        line_scale=rpc.line_scale,
        samp_off=rpc.sample_offset,
        samp_scale=rpc.sample_scale,
        lat_off=rpc.latitude_offset,
        lat_scale=rpc.latitude_scale,
        long_off=rpc.longitude_offset,
        long_scale=rpc.longitude_scale,
        height_off=rpc.height_offset,
        height_scale=rpc.height_scale,
    )
    return RPCTransformer(described, RPC_PIXEL_ERROR_THRESHOLD=1e-7, RPC_MAX_ITERATIONS=100)


def size_of(file: RpcFile) -> tuple[Rpc, int, int]:
    """Return RPC, width and height; where the file tells no size, the picture is what the RPC's scales span."""
    rpc = file.rpc
    if file.width and file.height:
        return rpc, file.width, file.height
    half = np.abs([rpc.sample_scale, rpc.line_scale])
    corner = np.array([rpc.sample_offset, rpc.line_offset]) + 0.5 - half
    width, height = np.ceil(2 * half).astype(int).tolist()
    return rpc.cropped(*corner), width, height


def against_gdal(rpc: Rpc, width: int, height: int) -> tuple[float, float]:
    """Return the greatest difference of projection in pixels, and of localisation in metres."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, [width, height], (SAMPLES, 2))
    heights = rng.uniform(*rpc.height_range, SAMPLES)
    ground = rpc.locate(pixels, heights)
    with gdal_transformer(rpc) as transformer:
        rows, columns = transformer.rowcol(ground[:, 1], ground[:, 0], zs=heights, op=lambda value: value)
        longitudes, latitudes = transformer.xy(pixels[:, 1], pixels[:, 0], zs=heights, offset="ul")
    projected = np.abs(np.stack([columns, rows], axis=1) - rpc.project(ground)).max()
    theirs = np.stack([latitudes, longitudes, heights], axis=1)
    place = (float(ground[0, 0]), float(ground[0, 1]), float(ground[0, 2]))
    located = np.linalg.norm(enu_from_geodetic(theirs, place) - enu_from_geodetic(ground, place), axis=1).max()
    return float(projected), float(located)


def row(file: RpcFile) -> str:
    """Return the line of one file."""
    rpc, width, height = size_of(file)
    middle = (width / 2, height / 2)
    pixels, metres = against_gdal(rpc, width, height)
    ray = viewing_ray(rpc, middle)
    latitude, longitude, altitude = ray.ground.tolist()
    camera = RpcCamera(rpc, width, height, (latitude, longitude, altitude))
    affine = fit_affine_camera(camera, [-HALF, HALF])
    perspective = fit_perspective_camera(camera, [-HALF, HALF])
    paper = paper_angles(file.rpc)
    return (
        f"{pixels:8.1e} {metres:8.1e}  {affine.rms_px:6.4f} {affine.max_px:6.4f}  "
        f"{perspective.rms_px:6.4f} {perspective.max_px:6.4f}  {ray.zenith_deg:6.2f} {ray.azimuth_deg:6.2f}  "
        f"{paper.off_nadir_deg:6.2f} {paper.azimuth_deg:6.2f}"
    )


def main() -> None:
    """Print the table."""
    data = os.environ.get("TOOLKIT_DATA")
    if not data:
        print("TOOLKIT_DATA is not set: it names the folder with the real pictures. Nothing was measured.")
        return
    warnings.simplefilter("ignore", NotGeoreferencedWarning)
    heads = ("difference to GDAL", "affine", "perspective", "exact", "paper")
    print(" " * 55 + "  ".join(f"{head:^{width}}" for head, width in zip(heads, (17, 13, 13, 13, 13), strict=True)))
    residuals = f"{'rms':>6} {'max':>6}  " * 2
    print(f"{'':54} {'px':>8} {'m':>8}  {residuals}zenith azimuth   off azimuth")
    for folder in FOLDERS:
        for path in sorted((Path(data) / folder).rglob("*")):
            if path.suffix.lower() not in ENDINGS:
                continue
            name = f"{folder[4:]}/{path.name}"[-54:]
            try:
                file = read_rpc(path)
            except DataError as error:
                print(f"{name:54} no RPC: {str(error)[:90]}")
                continue
            print(f"{name:54} {row(file)}", flush=True)


if __name__ == "__main__":
    main()
