"""Satellite recipes on a small computed city: cameras that agree, a surface model, what is missing."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from toolkit.depth.monocular import DepthPrediction
from toolkit.errors import CapabilityError, StageError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.ground_grid import GroundGrid
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.poses.satellite import ground_box, pictures_to_match, require_rpc_cameras, with_affine_cameras
from toolkit.progress import silent
from toolkit.recipes import held_depth, sat_colmap_3dgs, sat_splat
from toolkit.recipes.base import RecipeContext, RecipeInput, RecipeResult
from toolkit.recipes.sat_colmap_3dgs import SatColmap3dgsSettings
from toolkit.recipes.sat_heights import SatHeightsSettings, run
from toolkit.recipes.satellite_measure import DIFFERENCE_FILE, DSM_FILE, true_surface_model
from toolkit.samples.city import CitySample, CitySettings, make_city
from toolkit.scene import Frame, Scene
from toolkit.scene.dataset import open_capture
from toolkit.scene.dsm_files import read_dsm
from toolkit.scene.pictures import load_mask, load_picture
from toolkit.scene.raster import read_raster
from toolkit.scene.raster_io import write_raster
from toolkit.scene.satellite import open_satellite
from toolkit.splat import elevation
from toolkit.workspace import Workspace

pytest.importorskip("rasterio", reason="satellite pictures need rasterio (extra 'geo')")
SMALL = {"plan.size": 64.0, "plan.tallest": 20.0, "orbit.views": 7}


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> CitySample:
    return make_city(tmp_path_factory.mktemp("city") / "small", CitySettings().replace(SMALL), seed=3)


def context(folder: Path, work: Path | None = None) -> RecipeContext:
    for name in ("artifacts", "checkpoint"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    return RecipeContext(
        Workspace(work or folder / "work"), folder / "artifacts", folder / "checkpoint", 0, "cpu", silent
    )


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("run")


@pytest.fixture(scope="module")
def made(city: CitySample, place: Path) -> RecipeResult:
    capture = open_capture(city.folder)
    settings = SatHeightsSettings().replace({"heights.search.levels": 3, "heights.search.iterations": 2})
    return run(RecipeInput(capture.scene, capture.reference, "city"), settings, context(place))


def test_tie_points_make_the_cameras_agree(city: CitySample, made: RecipeResult) -> None:
    # The RPCs come 1 to 3 pixels wrong; matches are good to some tenths.
    assert made.metrics["rpc.rms_before_px"] > 1.0
    assert made.metrics["rpc.rms_px"] < 0.6
    cameras = require_rpc_cameras(made.scene)
    found = np.array([camera.correction for camera in cameras])[:, [0, 3]]
    true = np.array([view.correction for view in city.views])[:, [0, 3]]
    # A common shift of all pictures is the ground's, which tie points leave open: to 3 m here, or 6 pixels.
    slopes = np.stack([camera.jacobian(np.zeros((1, 3)))[0] for camera in cameras])
    shift = np.linalg.lstsq(slopes.reshape(-1, 3), (true - found).ravel(), rcond=None)[0]
    assert np.abs(found + slopes @ shift - true).max() < 0.35
    assert np.linalg.norm(shift) < 3.0


def test_the_surface_model_is_near_the_true_one(made: RecipeResult, place: Path) -> None:
    # Half a pixel of parallax is about half a metre; walls are wrong by a cell or two.
    assert made.metrics["dsm.median_absolute"] < 0.35
    assert made.metrics["dsm.mae"] < 2.0
    model, off = (read_dsm(place / "artifacts" / name) for name in (DSM_FILE, DIFFERENCE_FILE))
    assert model.crs == off.crs == "EPSG:32617"
    assert np.nanmean(np.abs(off.heights)) == pytest.approx(made.metrics["dsm.mae"], rel=1e-3)
    assert made.reports["dsm"]["truth"] == "dsm.tif"
    assert made.metrics["affine.rms_px"] < 0.05


def test_a_splat_of_the_city_has_its_heights(city: CitySample, place: Path, made: RecipeResult) -> None:
    capture = open_capture(city.folder)
    few = {"heights.search.levels": 3, "heights.search.iterations": 2, "train.steps": 60, "max_points": 4000}
    settings = sat_splat.SatSplatSettings().replace(few)
    result = sat_splat.run(RecipeInput(capture.scene, capture.reference, "city"), settings, context(place))
    # All but what the splat needs.
    assert {time.name for time in result.times if time.reused} == {
        *("pictures", "features", "matches", "refine", "affine", "heights")
    }
    # Held-out pictures of other suns, after some steps: more than a grey picture, which has 13 dB.
    assert result.metrics["test.psnr"] > 15.0
    assert len(result.test_views) == 1
    assert result.metrics["dsm.median_absolute"] < 0.7
    assert result.metrics["sfm.registered"] == 7
    assert result.gaussians is not None


def test_a_splat_that_is_nowhere_opaque_has_no_heights_and_says_so(
    city: CitySample, place: Path, made: RecipeResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nothing(gaussians: object, grid: GroundGrid, settings: object, *, device: str) -> np.ndarray:
        return np.full((grid.rows, grid.columns), np.nan, np.float32)

    monkeypatch.setattr(elevation, "splat_heights", nothing)
    capture = open_capture(city.folder)
    few = {"heights.search.levels": 3, "heights.search.iterations": 2, "train.steps": 2, "max_points": 500}
    settings = sat_splat.SatSplatSettings().replace(few)
    run = context(place / "nothing", work=place / "work")
    result = sat_splat.run(RecipeInput(capture.scene, capture.reference, "city"), settings, run)
    assert result.reports["dsm"] == {"reason": "the splat is nowhere opaque from above"}
    assert not any(name.startswith("dsm.") for name in result.metrics)
    assert result.metrics["heights.filled"] == 1.0


@pytest.mark.parametrize("changes", [{}, {"train.backend": "cuda"}])
def test_a_splat_on_the_gpu_is_refused_before_any_work(
    city: CitySample, tmp_path: Path, changes: dict[str, str]
) -> None:
    run = dataclasses.replace(context(tmp_path), device="cpu" if changes else "cuda")
    settings = sat_splat.SatSplatSettings().replace(changes)
    with pytest.raises(CapabilityError, match=r"Affine cameras are drawn on the CPU alone; expected device cpu"):
        sat_splat.run(RecipeInput(open_capture(city.folder).scene, None, "city"), settings, run)
    assert not any((tmp_path / "work").rglob("*.png"))


def test_what_holds_no_data_is_masked_and_stretched_from_what_does(city: CitySample, tmp_path: Path) -> None:
    """A picture that was turned on its way has a collar, which would be the darkest and sharpest thing in it."""
    for i in range(2):
        pixels = read_raster(city.delivered(i)).values.astype(np.uint16)
        pixels[:, :, :40] = 0
        write_raster(tmp_path / f"{i}.tif", pixels, rpc=city.views[i].rpc, nodata=0)
    scene = pictures_to_match(open_satellite(tmp_path), tmp_path / "made")
    assert [frame.name for frame in scene.frames] == ["0.png", "1.png"]
    for frame in scene.frames:
        mask, picture = load_mask(scene, frame), load_picture(scene.image_path(frame))
        assert mask is not None
        assert not mask[:, :40].any()
        assert mask[:, 40:].all()
        assert not picture[:, :40].any()
        # A percent is cut at either end.
        assert (picture[:, 40:] == 255).mean() == pytest.approx(0.01, abs=0.005)


class Ramp:
    """Stands in for a network: depth that grows from left to right."""

    name = "a ramp"

    def predict(self, scene: Scene, frame: Frame) -> DepthPrediction:
        camera = scene.camera_of(frame)
        row = np.arange(camera.width, dtype=np.float32)
        return DepthPrediction(np.tile(row, (camera.height, 1)), "affine-disparity")


def test_colmap_places_few_pictures_and_says_so(
    city: CitySample, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = open_capture(city.folder)
    data = RecipeInput(capture.scene, capture.reference, "city")
    few = SatColmap3dgsSettings().replace({"train.steps": 12})
    plain = sat_colmap_3dgs.run(data, few, context(place / "plain"))
    assert plain.metrics["sfm.images"] == 7
    # Nearly parallel rays and unknown focal lengths: COLMAP finds pairs and no more.
    assert 2 <= plain.metrics["sfm.registered"] < 7
    assert {camera.model for camera in plain.scene.cameras.values()} == {"OPENCV"}
    train = [frame for frame in plain.scene.of_split("train") if frame.cam_from_world is not None]
    assert plain.metrics["training.views"] == len(train)
    assert 0 < plain.metrics["training.l1"] < 0.5
    assert plain.metrics["training.psnr"] > 5
    monkeypatch.setattr(held_depth, "depth_provider", lambda settings: Ramp())
    settings = few.replace({"depth_loss.weight": 0.5})
    held = sat_colmap_3dgs.run(data, settings, context(place / "held", work=place / "plain" / "work"))
    assert [time.name for time in held.times if not time.reused][:2] == ["depth-maps", "compile"]
    assert held.reports["depth-maps"] == {"images": len(train), "source": "a ramp", "kinds": ["affine-disparity"]}
    assert held.metrics["training.l1"] != plain.metrics["training.l1"]


def test_affine_cameras_are_where_rpcs_are(city: CitySample) -> None:
    scene = city.true_scene
    box = ground_box(scene, heights=(0.0, 25.0))
    local, fitted = with_affine_cameras(scene, box)
    point = np.array([[3.0, -4.0, 12.0]])
    for before, after in zip(scene.frames, local.frames, strict=True):
        camera, rpc = local.camera_of(after), scene.camera_of(before)
        assert isinstance(camera, AffineCamera)
        assert isinstance(rpc, RpcCamera)
        assert after.cam_from_world is not None
        np.testing.assert_allclose(camera.project(after.cam_from_world.apply(point)), rpc.project(point), atol=0.05)
    assert max(one.max_px for one in fitted) < 0.05
    with pytest.raises(StageError, match="range of heights is not known"):
        ground_box(scene)
    with pytest.raises(StageError, match="has no RPC camera.*found AffineCamera"):
        require_rpc_cameras(local)


def test_what_is_no_satellite_picture_is_told(tmp_path: Path, city: CitySample) -> None:
    local, _ = with_affine_cameras(city.true_scene, ground_box(city.true_scene, heights=(0.0, 25.0)))
    with pytest.raises(StageError, match="has no RPC camera"):
        run(RecipeInput(local, None, "x"), SatHeightsSettings(), context(tmp_path))
    assert true_surface_model(tmp_path) is None
    assert true_surface_model(city.folder / "images") == city.folder / "truth" / "dsm.tif"
