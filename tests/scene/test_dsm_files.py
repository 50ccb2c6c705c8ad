"""Surface models as GeoTIFF, and maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from toolkit.errors import DataError, RunError
from toolkit.scene.dsm_files import enu_from_map, map_from_enu, read_dsm, utm_crs, write_dsm
from toolkit.scene.raster_io import write_raster

rasterio = pytest.importorskip("rasterio", reason="rasterio is not installed: pip install 'sightline-toolkit[geo]'")
pyproj = pytest.importorskip("pyproj", reason="pyproj is not installed: pip install 'sightline-toolkit[geo]'")

ORIGIN = (43.26, 5.44, 120.0)


def hills(rows: int = 30, columns: int = 40) -> np.ndarray:
    heights = np.random.default_rng(0).normal(size=(rows, columns)).astype(np.float32) * 50 + 100
    heights[3:6, 7:9] = np.nan
    return heights


def test_a_surface_model_comes_back_to_the_bit(tmp_path: Path) -> None:
    write_dsm(tmp_path / "a.tif", hills(), (698053.031, 4792984.069), 0.5, "EPSG:32631")
    model = read_dsm(tmp_path / "a.tif")
    np.testing.assert_array_equal(model.heights, hills())
    assert model.heights.dtype == np.float32
    assert (model.origin, model.resolution, model.crs) == ((698053.031, 4792984.069), 0.5, "EPSG:32631")
    east, north = model.centres()
    assert (east[0], north[0]) == (698053.281, 4792983.819)
    assert (len(east), len(north)) == (40, 30)
    assert east[1] - east[0] == pytest.approx(0.5)
    assert north[1] - north[0] == pytest.approx(-0.5)


def test_other_programs_see_map_and_holes(tmp_path: Path) -> None:
    write_dsm(tmp_path / "a.tif", hills(), (500000.0, 4000000.0), 2.0, "EPSG:32733")
    with rasterio.open(tmp_path / "a.tif") as dataset:
        assert dataset.crs.to_epsg() == 32733
        assert dataset.bounds == (500000.0, 4000000.0 - 60, 500000.0 + 80, 4000000.0)
        assert np.isnan(dataset.nodata)
        assert dataset.read_masks(1).min() == 0


def test_a_number_for_no_data_becomes_nan(tmp_path: Path) -> None:
    grid = np.full((4, 5), 3.0, np.float32)
    grid[1, 2] = -9999
    with rasterio.open(
        tmp_path / "a.tif", "w", driver="GTiff", width=5, height=4, count=1, dtype="float32", nodata=-9999,
        crs="EPSG:32631", transform=rasterio.Affine(1, 0, 10, 0, -1, 20),
    ) as dataset:  # fmt: skip
        dataset.write(grid, 1)
    heights = read_dsm(tmp_path / "a.tif").heights
    assert np.argwhere(np.isnan(heights)).tolist() == [[1, 2]]
    assert np.nanmin(heights) == 3


@pytest.mark.parametrize(
    ("latitude", "longitude", "code"),
    [
        (43.26, 5.44, "EPSG:32631"),
        (30.35, -81.66, "EPSG:32617"),
        (-34.5, -58.6, "EPSG:32721"),
        (0.0, -180.0, "EPSG:32601"),
        (10.0, 180.0, "EPSG:32601"),
        (10.0, 179.9, "EPSG:32660"),
        (10.0, 365.44, "EPSG:32631"),
    ],
)
def test_the_zone_of_a_place(latitude: float, longitude: float, code: str) -> None:
    assert utm_crs(latitude, longitude) == code


@pytest.mark.parametrize(
    ("latitude", "longitude"), [(85.0, 0.0), (-81.0, 0.0), (float("nan"), 0.0), (0.0, float("inf"))]
)
def test_there_are_no_zones_at_the_poles(latitude: float, longitude: float) -> None:
    with pytest.raises(DataError, match=r"No UTM zone for this place; expected a latitude of -80 to 84 degrees"):
        utm_crs(latitude, longitude)


def test_metres_of_the_scene_and_of_the_map_undo_each_other() -> None:
    enu = np.random.default_rng(1).uniform(-2000, 2000, (50, 3))
    places = map_from_enu(enu, ORIGIN, utm_crs(*ORIGIN[:2]))
    np.testing.assert_allclose(enu_from_map(places, ORIGIN, "EPSG:32631"), enu, rtol=0, atol=1e-6)
    # UTM's scale is within 0.1 % of 1; its north is off by the meridian's convergence, here 1.7 degrees.
    flat = np.array([[0.0, 0.0, 0.0], [1000.0, 0.0, 0.0], [0.0, 1000.0, 0.0]])
    corner, east, north = map_from_enu(flat, ORIGIN, "EPSG:32631")
    assert np.linalg.norm((east - corner)[:2]) == pytest.approx(1000, rel=1e-3)
    assert np.degrees(np.arctan2((corner - north)[0], (north - corner)[1])) == pytest.approx(1.67, abs=0.05)
    # Up is up, and the ground falls away from the tangent plane by d^2 / 2R.
    assert corner[2] == pytest.approx(120, abs=1e-6)
    assert east[2] - 120 == pytest.approx(1000**2 / (2 * 6.38e6), rel=0.01)


def test_an_unknown_map_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"Unknown map 'EPSG:1'; expected a code like EPSG:32631"):
        map_from_enu(np.zeros((1, 3)), ORIGIN, "EPSG:1")
    with pytest.raises(DataError, match=r"Unknown map 'EPSG:1'"):
        enu_from_map(np.zeros((1, 3)), ORIGIN, "EPSG:1")
    with pytest.raises(DataError, match=r"Unknown map 'moon'"):
        write_dsm(tmp_path / "a.tif", hills(), (0.0, 0.0), 1.0, "moon")


@pytest.mark.parametrize(
    ("heights", "origin", "resolution", "message"),
    [
        (np.zeros(5), (0.0, 0.0), 1.0, r"No surface model; expected \(H, W\) heights"),
        (np.zeros((0, 4)), (0.0, 0.0), 1.0, r"No surface model"),
        (np.full((3, 3), np.inf), (0.0, 0.0), 1.0, r"No surface model"),
        (np.zeros((3, 3)), (np.nan, 0.0), 1.0, r"surface model without place; expected a corner and a cell"),
        (np.zeros((3, 3)), (0.0, 0.0), 0.0, r"surface model without place"),
    ],
)
def test_what_is_no_surface_model_is_refused(
    tmp_path: Path, heights: np.ndarray, origin: tuple[float, float], resolution: float, message: str
) -> None:
    with pytest.raises(DataError, match=message):
        write_dsm(tmp_path / "a.tif", heights, origin, resolution, "EPSG:32631")
    assert not list(tmp_path.iterdir())


def test_other_pictures_are_no_surface_models(tmp_path: Path) -> None:
    write_raster(tmp_path / "a.tif", np.zeros((1, 4, 4), np.float32))
    with pytest.raises(DataError, match=r"a\.tif is no surface model; .*found 1 bands, no map"):
        read_dsm(tmp_path / "a.tif")
    with rasterio.open(
        tmp_path / "b.tif", "w", driver="GTiff", width=5, height=4, count=1, dtype="float32",
        crs="EPSG:32631", transform=rasterio.Affine(1, 0.5, 10, 0, -1, 20),
    ) as dataset:  # fmt: skip
        dataset.write(np.zeros((4, 5), np.float32), 1)
    with pytest.raises(DataError, match=r"grid of .*b\.tif is turned or not square; .*Warp it"):
        read_dsm(tmp_path / "b.tif")


def test_a_file_cut_off_is_an_error(tmp_path: Path) -> None:
    write_dsm(tmp_path / "a.tif", hills(), (10.0, 20.0), 1.0, "EPSG:32631")
    whole = (tmp_path / "a.tif").read_bytes()
    for length in (0, 8, len(whole) // 2, len(whole) - 200):
        (tmp_path / "b.tif").write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"b\.tif is (cut off|no surface model)"):
            read_dsm(tmp_path / "b.tif")
    with pytest.raises(DataError, match=r"gone\.tif is missing"):
        read_dsm(tmp_path / "gone.tif")


def test_a_folder_that_is_a_file_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="Something is in the way"):
        write_dsm(tmp_path / "file" / "a.tif", hills(), (10.0, 20.0), 1.0, "EPSG:32631")


@pytest.mark.real
def test_the_reference_model_of_another_program_is_read(real_data: Path) -> None:
    model = read_dsm(real_data / "sat_pleiades_s2p" / "triplet" / "expected_dsm.tif")
    assert model.heights.shape == (855, 865)
    assert (model.resolution, model.crs) == (0.5, "EPSG:32631")
    # The README: 80 to 290 m.
    assert 80 < np.nanmin(model.heights) < np.nanmax(model.heights) < 290
    assert utm_crs(43.262, 5.443) == model.crs
