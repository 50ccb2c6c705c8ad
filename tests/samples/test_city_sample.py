"""A city's folder: whole or absent, the same from the same seed, and true."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import map_coordinates

from toolkit.errors import Cancelled, DataError, RunError, SettingsError, StageError
from toolkit.geometry.ellipsoid import geodetic_from_enu
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.progress import ProgressEvent
from toolkit.samples.city import CitySample, CitySettings, make_city, open_city
from toolkit.samples.surfaces import sample_folder, true_depth, true_surface
from toolkit.scene.dsm_files import enu_from_map, write_dsm
from toolkit.scene.folder import read_scene
from toolkit.scene.raster_io import open_raster
from toolkit.scene.rpc_files import read_rpc
from toolkit.scene.satellite import read_satellite, sun_direction

SMALL = CitySettings().replace({"orbit.views": 4, "plan.size": 40.0, "plan.tallest": 20.0})
TINY = CitySettings().replace({"orbit.views": 1, "plan.size": 32.0, "plan.tallest": 20.0, "orbit.off_nadir": 5.0})


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> CitySample:
    return make_city(tmp_path_factory.mktemp("samples") / "city", SMALL, seed=2)


def places(count: int) -> np.ndarray:
    random = np.random.default_rng(7)
    return random.uniform([-20, -20, -3], [20, 20, 25], (count, 3))


def _spanned(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return np.asarray(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])


def contents(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_the_delivered_rpc_is_the_rigorous_camera_but_for_the_bias(made: CitySample) -> None:
    xyz = places(2000)
    geodetic = geodetic_from_enu(xyz, made.origin)
    sizes = []
    for view, rigorous in zip(made.views, made.cameras, strict=True):
        off = view.rpc.project(geodetic) - rigorous.project(xyz)
        # Asked for are 0.01 px; over so small a scene cubic polynomials are exact to rounding.
        np.testing.assert_allclose(off, np.broadcast_to(view.bias, off.shape), atol=1e-5)
        assert view.fit_rms_px <= view.fit_max_px < 1e-5
        sizes.append(np.hypot(*view.bias))
    assert min(sizes) >= 1
    assert max(sizes) <= 3
    assert np.ptp(sizes) > 0.1


def test_the_scene_has_the_rpcs_as_delivered_and_the_true_scene_has_them_mended(made: CitySample) -> None:
    xyz = places(50)
    assert len(made.scene) == len(made.true_scene) == 4
    for view, rigorous, frame in zip(made.views, made.cameras, made.scene.frames, strict=True):
        biased, true = made.scene.camera_of(frame), made.true_scene.camera_of(frame)
        assert isinstance(biased, RpcCamera)
        assert isinstance(true, RpcCamera)
        assert biased.correction == (0.0,) * 6
        assert true.correction == view.correction
        assert frame.cam_from_world is not None
        np.testing.assert_array_equal(frame.cam_from_world.matrix, np.eye(4)[: len(frame.cam_from_world.matrix)])
        np.testing.assert_allclose(true.project(xyz), rigorous.project(xyz), atol=1e-5)
        np.testing.assert_allclose(
            biased.project(xyz) - true.project(xyz), np.broadcast_to(view.bias, (50, 2)), atol=1e-9
        )
        with Image.open(made.scene.image_path(frame)) as picture:
            assert picture.size == (biased.width, biased.height) == (80, 80)
            assert picture.mode == "RGB"
    times = [frame.time for frame in made.scene.frames]
    assert times[0] == 0
    assert times == sorted(times)
    assert sample_folder(made.scene) == made.folder


def test_the_satellite_is_where_the_truth_says(made: CitySample) -> None:
    for view, rigorous in zip(made.views, made.cameras, strict=True):
        origins, directions = rigorous.ray([[40.0, 40.0]])
        np.testing.assert_allclose(view.satellite, -directions[0], atol=1e-12)
        assert np.degrees(np.arccos(view.satellite[2])) == pytest.approx(view.zenith_angle, abs=1e-9)
        assert np.degrees(np.arctan2(*view.satellite[:2])) % 360 == pytest.approx(view.azimuth, abs=1e-9)
        assert 600e3 < np.linalg.norm(origins[0]) < 760e3
    # The RPC, bias or not, looks the same way: straight lines through 150 m of polynomials.
    for view, camera in zip(made.views, made.true_scene.cameras.values(), strict=True):
        np.testing.assert_allclose(-camera.ray([[40.0, 40.0]])[1][0], view.satellite, atol=1e-9)


def test_the_delivered_pictures_have_11_bits_and_tell_rpc_time_and_sun(made: CitySample) -> None:
    geodetic = geodetic_from_enu(places(20), made.origin)
    for i, view in enumerate(made.views):
        with open_raster(made.delivered(i)) as dataset:
            counts = dataset.read()
        assert counts.shape == (3, 80, 80)
        assert counts.dtype == np.uint16
        assert counts.max() <= 2047
        assert np.ptp(counts) > 300
        told = read_rpc(made.delivered(i))
        # GeoTIFF tags keep 15 digits of each number.
        np.testing.assert_allclose(told.rpc.project(geodetic), view.rpc.project(geodetic), atol=1e-6)
        assert told.acquired == view.time
        assert (told.sun_azimuth, told.sun_elevation) == (view.sun_azimuth, view.sun_elevation)


def test_what_is_read_back_is_the_same_to_the_bit(made: CitySample) -> None:
    again = open_city(made.folder)
    for one, other in zip(made.views, again.views, strict=True):
        assert (one.rpc, one.bias, one.time, one.radiometry) == (
            other.rpc,
            other.bias,
            other.time,
            other.radiometry,
        )
        np.testing.assert_array_equal(one.satellite, other.satellite)
    # Straight from the making, without a file between.
    stored = json.loads((made.folder / "truth/views.json").read_text())
    assert [float(item["rpc"]["LINE_OFF"]) for item in stored] == [view.rpc.line_offset for view in made.views]


def test_the_true_surface_is_what_rays_from_above_meet(made: CitySample) -> None:
    mesh, model = true_surface(made.folder), made.dsm
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    assert model.heights.shape == (80, 80)
    east, north = model.centres()
    random = np.random.default_rng(0)
    for row, column in random.integers(0, 80, (60, 2)):
        place = enu_from_map([[east[column], north[row], made.origin[2]]], made.origin, model.crs)[0, :2]
        # In double precision, by the signs of the areas that the place spans with each triangle's sides.
        area = [_spanned(q[:, :2] - p[:, :2], place - p[:, :2]) for p, q in ((b, c), (c, a), (a, b))]
        total = sum(area)
        over = np.flatnonzero((np.min(area, axis=0) >= 0) | (np.max(area, axis=0) <= 0))
        over = over[np.abs(total[over]) > 1e-9]
        share = np.stack([part[over] for part in area], axis=1) / total[over, None]
        highest = np.max(np.sum(share * np.stack([a[over, 2], b[over, 2], c[over, 2]], axis=1), axis=1))
        # Within 28 m of the origin the ellipsoid falls by less than 0.1 mm. Single precision within 150 m.
        assert model.heights[row, column] - made.origin[2] == pytest.approx(highest, abs=1e-3)
        assert made.city.surface_height(place[None])[0] == pytest.approx(highest, abs=1e-3)


def test_the_map_of_the_surface_is_utm_around_the_middle(made: CitySample) -> None:
    import pyproj

    with open_raster(made.dsm_map) as dataset:
        crs, transform, nodata = dataset.crs, dataset.transform, dataset.nodata
    assert crs.to_epsg() == 32617
    assert (transform.a, transform.e) == (0.5, -0.5)
    assert (transform.c % 0.5, transform.f % 0.5) == (0, 0)
    assert np.isnan(nodata)
    # The middle of the map is that of the city to within a cell.
    utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32617", always_xy=True)
    east, north = utm.transform(made.origin[1], made.origin[0])
    assert 0 <= east - (transform.c + 20) < 0.5
    assert 0 <= north - (transform.f - 20) < 0.5


def test_pictures_rpcs_and_surface_fit_together(made: CitySample) -> None:
    # The surface's places coloured by two pictures agree best where the true RPCs say, not half a pixel beside.
    axis = np.arange(-14.75, 15, 0.5)
    plane = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    grid = np.column_stack([plane, made.city.surface_height(plane)])
    start = grid + np.array([0.0, 0.0, 0.05])
    lit, greens = np.ones(len(grid), bool), []
    for i, view in enumerate(made.views):
        for way in (view.satellite, sun_direction(view.sun_elevation, view.sun_azimuth)):
            lit &= ~made.city.caster.blocked(start, np.broadcast_to(way, start.shape))
        with open_raster(made.delivered(i)) as dataset:
            greens.append(dataset.read(2).astype(float))
    assert lit.sum() > 500
    frames = made.true_scene.frames
    own = [made.true_scene.camera_of(frame).project(grid[lit]) - 0.5 for frame in frames]
    first = map_coordinates(greens[0], own[0].T[::-1], order=1)
    for pixels, green in zip(own[1:], greens[1:], strict=True):
        alike = [
            np.corrcoef(first, map_coordinates(green, (pixels + shift).T[::-1], order=1))[0, 1]
            for shift in ([0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5])
        ]
        assert np.argmax(alike) == 0
        assert alike[0] > 0.5


def test_the_folder_is_a_scene_and_the_delivered_pictures_are_satellite_views(made: CitySample) -> None:
    scene = read_scene(made.folder)
    assert [frame.name for frame in scene.frames] == [view.name for view in made.views]
    for frame in scene.frames:
        assert scene.camera_of(frame) == made.scene.camera_of(made.scene.frame(frame.name))
        assert scene.image_path(frame).is_file()
    told = read_satellite(made.folder / "satellite")
    assert len(told.scene) == 4
    assert not told.warnings
    assert [frame.time for frame in told.scene.frames] == pytest.approx([frame.time for frame in scene.frames])


def test_a_city_has_no_depth_maps(made: CitySample) -> None:
    with pytest.raises(DataError, match=r"is a city seen from orbit.*Compare heights"):
        true_depth(made.folder, made.scene.frames[0])


def test_the_same_seed_gives_the_same_files_and_another_does_not(tmp_path: Path) -> None:
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        make_city(tmp_path / name, TINY, seed=seed)
    a, b, c = (contents(tmp_path / name) for name in "abc")
    assert a == b
    assert a.keys() == c.keys()
    assert all(a[name] != c[name] for name in a)


def test_what_is_there_is_opened_and_not_made_again(made: CitySample) -> None:
    before = contents(made.folder)
    events: list[ProgressEvent] = []
    again = make_city(made.folder, SMALL, seed=2, progress=events.append)
    assert again.views[0].rpc == made.views[0].rpc
    assert not events
    assert contents(made.folder) == before
    for settings, seed in ((TINY, 2), (SMALL, 3)):
        with pytest.raises(StageError, match=r"is in the way; expected a new or an empty folder, or the city"):
            make_city(made.folder, settings, seed=seed)


def test_one_band_is_panchromatic(tmp_path: Path) -> None:
    city = make_city(tmp_path / "pan", TINY.replace({"imager.bands": "pan"}))
    with open_raster(city.delivered(0)) as dataset:
        assert dataset.read().shape == (1, 64, 64)
    with Image.open(tmp_path / "pan/images/view_00.png") as picture:
        red, green, blue = picture.split()
        assert red.tobytes() == green.tobytes() == blue.tobytes()


def test_a_cancelled_city_leaves_nothing(tmp_path: Path) -> None:
    def stop(event: ProgressEvent) -> None:
        if event.done:
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        make_city(tmp_path / "city", TINY, progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_biases_must_be_in_order(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="bias_least of at most bias_most; found 4 and 3"):
        make_city(tmp_path / "city", TINY.replace({"imager.bias_least": 4.0}))


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("here")
    with pytest.raises(RunError, match="Something is in the way while writing"):
        make_city(tmp_path / "file" / "city", TINY)


def test_what_is_no_city_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"is no city seen from orbit.*found no sample.json and no truth/views.json"
    ):
        open_city(tmp_path)


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("sample.json", {"kind": "engine"}, "found sample.json of something else"),
        ("sample.json", {"settings": {"views": 3}}, r"sample.json is damaged; found Unknown setting 'views'"),
        ("sample.json", {"seed": None}, "sample.json is damaged"),
        ("truth/views.json", [], r"views.json does not fit to the settings; expected 4 views; found 0"),
        ("truth/views.json", [{"name": "view_00.png"}], r"views.json is damaged; expected the truth of each view"),
        ("truth/views.json", 3, r"views.json is damaged"),
        ("truth/views.json", "not JSON", "Cannot read"),
    ],
)
def test_damage_is_told(made: CitySample, tmp_path: Path, name: str, change: object, said: str) -> None:
    for path in ("sample.json", "truth/views.json", "truth/dsm.tif"):
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_bytes((made.folder / path).read_bytes())
    if isinstance(change, dict):
        change = json.loads((tmp_path / name).read_text()) | change
    (tmp_path / name).write_text(change if isinstance(change, str) else json.dumps(change))
    with pytest.raises(DataError, match=said):
        open_city(tmp_path)


def test_a_damaged_surface_is_told(made: CitySample, tmp_path: Path) -> None:
    copy = CitySample(tmp_path, made.settings, made.seed, made.views)
    path = tmp_path / "truth/dsm.tif"
    with pytest.raises(DataError, match=r"dsm.tif is missing"):
        _ = copy.dsm
    path.parent.mkdir()
    path.write_bytes(b"none")
    with pytest.raises(DataError, match=r"dsm.tif is cut off, damaged or neither GeoTIFF nor NITF"):
        _ = copy.dsm
    write_dsm(path, np.zeros((3, 4)), (0.0, 0.0), 0.5, "EPSG:32617")
    with pytest.raises(DataError, match=r"dsm.tif is not this city's; expected 80 x 80 cells; found 3 x 4"):
        _ = copy.dsm
