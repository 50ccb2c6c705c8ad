"""Recipes vggt-ba and dust3r-views on a small computed city, with predictions simulated from its truth."""

from __future__ import annotations

import csv
import dataclasses
import importlib.util
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from toolkit.errors import DataError, MissingDependencyError, SettingsError, StageError, WeightsMissingError
from toolkit.geometry.alignment import align
from toolkit.poses.feedforward import providers
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.predictions_file import write_predictions
from toolkit.poses.feedforward.simulated import SimulatedNoiseSettings
from toolkit.poses.feedforward.simulated_satellite import near_camera, simulate_satellite_prediction
from toolkit.poses.satellite import ground_box, with_affine_cameras
from toolkit.progress import silent
from toolkit.recipes import available, dust3r_views, vggt_ba
from toolkit.recipes.available import missing_here
from toolkit.recipes.base import Recipe, RecipeContext, RecipeInput, RecipeResult
from toolkit.recipes.dust3r_views import TABLE, Dust3rViewsSettings
from toolkit.recipes.feedforward_ground import CLOUD
from toolkit.recipes.feedforward_steps import choose_views
from toolkit.recipes.registry import find_recipe
from toolkit.recipes.satellite_measure import DSM_FILE
from toolkit.recipes.vggt_ba import BEFORE, VggtBaSettings
from toolkit.runs.measures import better
from toolkit.samples.city import CitySample, CitySettings, make_city
from toolkit.samples.city.seen import seen_points
from toolkit.scene import Frame, Scene
from toolkit.scene.dataset import open_capture
from toolkit.scene.mesh_files import read_cloud
from toolkit.views.settings import ViewSelectionSettings
from toolkit.workspace import Workspace

pytest.importorskip("rasterio", reason="satellite pictures need rasterio (extra 'geo')")
SMALL = {"plan.size": 64.0, "plan.tallest": 20.0, "orbit.views": 7}
EXACT = dict.fromkeys(("rotation", "translation", "focal", "focal_each", "depth", "depth_scale"), 0.0)
RECIPES = ("vggt-ba", "dust3r-views")


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> CitySample:
    return make_city(tmp_path_factory.mktemp("city") / "small", CitySettings().replace(SMALL), seed=3)


@pytest.fixture(scope="module")
def data(city: CitySample) -> RecipeInput:
    capture = open_capture(city.folder)
    return RecipeInput(capture.scene, capture.reference, "city")


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the runs that share what comes before the network."""
    return tmp_path_factory.mktemp("work")


def context(work: Path, folder: Path) -> RecipeContext:
    for name in ("artifacts", "checkpoint"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    return RecipeContext(Workspace(work), folder / "artifacts", folder / "checkpoint", 0, "cpu", silent)


def box_of(city: CitySample) -> np.ndarray:
    half = 0.5 * city.settings.plan.size
    low, high = city.city.heights
    return np.array([[-half, -half, low], [half, half, high]])


def simulated(
    city: CitySample, names: Sequence[str], noise: dict[str, Any] | None = None, **more: Any
) -> Prediction:
    """Return what a network might say of these pictures."""
    numbers = {frame.name: i for i, frame in enumerate(city.true_scene.frames)}
    frames = tuple(frame for frame in city.true_scene.frames if frame.name in names)

    def points_of(frame: Frame) -> np.ndarray:
        return seen_points(city, numbers[frame.name])

    settings = SimulatedNoiseSettings(**(noise or {}))
    scene = city.true_scene.replace(frames=frames)
    return simulate_satellite_prediction(scene, points_of, box_of(city), settings, **more)


def chosen(scene: Scene, count: int, spread: str) -> tuple[str, ...]:
    return choose_views(scene, ViewSelectionSettings(count=count, spread=spread), 0).names


@pytest.fixture(scope="module")
def files(city: CitySample, data: RecipeInput, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Predictions of two and four views, most and least spread; that of two least spread ones is nonsense."""
    folder = tmp_path_factory.mktemp("predictions")
    for count in (2, 4):
        for spread in ("most", "least"):
            said = simulated(city, chosen(data.scene, count, spread))
            if (count, spread) == (2, "least"):
                depth = np.random.default_rng(0).uniform(1.0, 100.0, said.depth.shape).astype(np.float32)
                said = dataclasses.replace(said, depth=depth).with_points_from_depth()
            write_predictions(folder / f"{spread}-{count}.npz", said)
    return folder


def by_file(path: Path) -> dict[str, Any]:
    return {"network.provider": "file", "network.file": str(path)}


@pytest.fixture(scope="module")
def adjusted(data: RecipeInput, files: Path, work: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The result of vggt-ba on tracks, and its artifacts."""
    settings = VggtBaSettings().replace({**by_file(files / "most-4.npz"), "adjust.method": "tracks"})
    folder = tmp_path_factory.mktemp("adjusted")
    return vggt_ba.run(data, settings, context(work, folder)), folder / "artifacts"


def test_adjustment_makes_cameras_agree_and_heights_better(adjusted: tuple[RecipeResult, Path]) -> None:
    metrics = adjusted[0].metrics
    # Errors as VGGT shows are some pixels of half a metre here; matched features agree to a fraction of one.
    assert metrics["adjust.error_before_px"] > 2.0
    assert metrics["adjust.error_px"] < 0.5
    assert metrics["align.inliers"] > 0.9 > 0.8 > metrics["align_before.inliers"]
    # What is left is depth between the tracks, and what a lens shows that an orbit does not: heights to a pixel or
    # three.
    assert metrics["dsm.median_absolute"] < 1.5
    assert metrics["dsm.median_absolute"] < 0.75 * metrics["dsm_before.median_absolute"]
    assert metrics["dsm.mae"] < metrics["dsm_before.mae"]
    assert metrics["sfm.images"] == metrics["sfm.registered"] == 4.0
    assert metrics["prediction.seconds"] is None
    assert better("adjust.error_px") == better("align.rms_m") == "lower"


def test_the_scene_has_the_views_and_their_points_on_the_ground(
    adjusted: tuple[RecipeResult, Path], city: CitySample, data: RecipeInput
) -> None:
    result, artifacts = adjusted
    scene = result.scene
    assert {frame.name for frame in scene.registered} == set(chosen(data.scene, 4, "most"))
    assert scene.georeference == data.scene.georeference
    assert len(scene) == 7
    assert scene.points is not None
    assert np.abs(np.median(scene.points.xyz[:, :2], axis=0)).max() < 10.0
    cloud = read_cloud(artifacts / CLOUD)
    np.testing.assert_allclose(cloud.xyz, scene.points.xyz, atol=1e-6)
    assert cloud.rgb is not None
    assert cloud.rgb.std() > 5  # the pictures' colours, which the file does not have
    assert (artifacts / DSM_FILE).is_file()
    assert (artifacts / BEFORE / DSM_FILE).is_file()
    # Views lean by 20 degrees and more; ties that are right to a metre or two leave a turn of some degrees.
    for frame in scene.registered:
        view = next(view for view in city.views if view.name == frame.name)
        assert frame.cam_from_world is not None
        towards = frame.cam_from_world.centre / np.linalg.norm(frame.cam_from_world.centre)
        assert np.degrees(np.arccos(towards @ view.satellite)) < 5.0
    assert {"views", "adjust", "align", "align_before", "dsm", "dsm_before"} < result.reports.keys()
    assert result.to_dict()["reports"]["align"]["agreeing"] == result.metrics["align.inliers"]


class Oracle:
    """A network that knows the city."""

    name = "oracle"

    def __init__(self, city: CitySample, **noise: Any) -> None:
        self._city, self._noise = city, noise
        self.seen: list[tuple[str, ...]] = []

    def predict(self, pictures: Sequence[np.ndarray], names: Sequence[str], *, seed: int = 0) -> Prediction:
        assert all(picture.shape == (128, 128, 3) for picture in pictures)
        self.seen.append(tuple(names))
        if len(names) > 3:
            raise MemoryError("too many for an oracle")
        return simulated(self._city, names, self._noise, seed=seed)


def test_the_paper_s_adjustment_is_the_default_and_makes_points_fit_their_own_pixels(
    city: CitySample, data: RecipeInput, work: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    oracle = Oracle(city, points="head")
    monkeypatch.setattr(providers, "network", lambda settings: oracle)
    settings = VggtBaSettings().replace({"views.count": 3, "adjust.paper.steps": 45})
    result = vggt_ba.run(data, settings, context(work, tmp_path))
    told = result.reports["adjust"]
    assert told["method"] == "paper"
    # A point head does not agree with the camera head: that, and nothing else, is what this adjustment mends.
    assert told["after_px"] < 0.5 * told["before_px"]
    assert result.metrics["prediction.seconds"] > 0
    assert len(oracle.seen) == 1
    assert set(oracle.seen[0]) == set(chosen(data.scene, 3, "most"))
    assert oracle.seen[0] == tuple(sorted(oracle.seen[0]))  # in the scene's order
    again = vggt_ba.run(data, settings, context(work, tmp_path))
    assert len(oracle.seen) == 1
    assert again.metrics == result.metrics


def test_a_prediction_that_fits_nowhere_before_its_adjustment_has_no_heights_then(
    data: RecipeInput, files: Path, work: Path, tmp_path: Path
) -> None:
    strict = {"ground.align.max_error": 2.0, "ground.align.min_share": 60.0, "adjust.method": "tracks"}
    settings = VggtBaSettings().replace({**by_file(files / "most-4.npz"), **strict})
    result = vggt_ba.run(data, settings, context(work, tmp_path))
    assert "No similarity brings the points together" in result.reports["align_before"]["reason"]
    assert not [name for name in result.metrics if name.startswith(("dsm_before", "align_before"))]
    assert result.metrics["dsm.median_absolute"] < 1.5


@pytest.fixture(scope="module")
def budgets(data: RecipeInput, files: Path, work: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The result of dust3r-views on files, one of which is nonsense and two are missing, and its artifacts."""
    settings = Dust3rViewsSettings().replace({**by_file(files), "budgets": "4, 2, 5, 8"})
    folder = tmp_path_factory.mktemp("budgets")
    return dust3r_views.run(data, settings, context(work, folder)), folder / "artifacts"


def test_each_number_of_views_has_a_row_for_most_and_least_spread(budgets: tuple[RecipeResult, Path]) -> None:
    result, artifacts = budgets
    rows = list(csv.DictReader((artifacts / TABLE).read_text().splitlines()))
    assert [(row["views"], row["spread"]) for row in rows] == [
        (count, spread) for count in ("2", "4", "5") for spread in ("most", "least")
    ]
    assert result.reports["left_out"] == ["8 views: there are 6 training pictures"]
    for row in (rows[0], *rows[2:4]):
        mae = result.metrics[f"views.{row['views']}.{row['spread']}.dsm_mae"]
        assert float(row["dsm_mae"]) == pytest.approx(mae, rel=1e-4)
        assert row["reason"] == row["seconds"] == ""
    for name in ("dsm_mae", "dsm_median_absolute", "align_rms_m", "seconds"):
        assert better(f"views.4.most.{name}") == "lower"
    assert better("views.4.most.dsm_within_1m") == better("views.4.most.align_inliers") == "higher"


def test_a_combination_that_fits_nowhere_is_a_row_with_its_reason(budgets: tuple[RecipeResult, Path]) -> None:
    result, artifacts = budgets
    rows = list(csv.DictReader((artifacts / TABLE).read_text().splitlines()))
    assert "No similarity brings the points together" in rows[1]["reason"]
    assert rows[1]["dsm_mae"] == ""
    assert result.metrics["views.2.least.dsm_mae"] is None
    assert [bool(row["reason"]) for row in result.reports["budgets"]] == [False, True, False, False, True, True]
    assert re.search(r"There is no prediction .*least-5\.npz; expected one of view_01\.png, ", rows[5]["reason"])


def test_the_result_is_that_of_the_most_views_that_spread_most(
    budgets: tuple[RecipeResult, Path], data: RecipeInput
) -> None:
    result, artifacts = budgets
    assert result.reports["scene"] == "4 views, most spread"
    assert {frame.name for frame in result.scene.registered} == set(chosen(data.scene, 4, "most"))
    assert result.metrics["dsm.mae"] == result.metrics["views.4.most.dsm_mae"]
    assert (artifacts / CLOUD).is_file()
    assert (artifacts / "budgets" / "least-4" / DSM_FILE).is_file()
    assert [time.name for time in result.times if time.name.startswith("prediction")] == [
        *("prediction 2 most", "prediction 2 least", "prediction 4 most", "prediction 4 least"),
    ]


def test_a_network_without_memory_for_many_views_is_a_row_and_times_are_the_network_s(
    city: CitySample, data: RecipeInput, work: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    oracle = Oracle(city)
    monkeypatch.setattr(providers, "network", lambda settings: oracle)
    result = dust3r_views.run(data, Dust3rViewsSettings().replace({"budgets": "3,4"}), context(work, tmp_path))
    rows = result.reports["budgets"]
    assert [row["reason"][:41] for row in rows] == ["", "", *["The memory does not suffice for 4 views: "] * 2]
    assert result.metrics["views.3.most.seconds"] > 0
    assert result.metrics["views.4.most.seconds"] is None
    assert result.reports["scene"] == "3 views, most spread"
    (tmp_path / "only").mkdir()
    with pytest.raises(StageError, match=r"No prediction could be laid.*4 views, least spread: The memory"):
        dust3r_views.run(data, Dust3rViewsSettings().replace({"budgets": "4"}), context(work, tmp_path / "only"))
    assert "too many for an oracle" in (tmp_path / "only" / "artifacts" / TABLE).read_text()


@pytest.mark.parametrize("name", RECIPES)
def test_a_missing_package_is_told_before_any_work(
    name: str, data: RecipeInput, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = find_recipe(name)
    package = recipe.settings_type().network.provider
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingDependencyError, match=f"package '{package}' cannot be imported"):
        recipe.run(data, recipe.settings_type(), context(tmp_path / "work", tmp_path))
    assert not (tmp_path / "work").exists()


def test_missing_weights_are_told_before_any_work(
    data: RecipeInput, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("vggt", "vggt.models", "vggt.models.vggt", "vggt.utils", "vggt.utils.pose_enc"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setattr(sys.modules["vggt.models.vggt"], "VGGT", object, raising=False)
    monkeypatch.setattr(sys.modules["vggt.utils.pose_enc"], "pose_encoding_to_extri_intri", None, raising=False)
    settings = VggtBaSettings().replace({"network.weights": "/nowhere/vggt.pt"})
    with pytest.raises(WeightsMissingError, match=r"no file or folder '/nowhere/vggt\.pt'"):
        vggt_ba.run(data, settings, context(tmp_path / "work", tmp_path))
    assert not (tmp_path / "work").exists()


@pytest.mark.parametrize("name", RECIPES)
def test_what_is_missing_is_known_without_a_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = find_recipe(name)
    settings = recipe.settings_type()
    package = settings.network.provider
    there: set[str] = set()
    monkeypatch.setattr(importlib.util, "find_spec", lambda wanted: object() if wanted in there else None)
    assert missing_here(settings) == f"package missing: {package}"
    there.add(package)
    monkeypatch.setattr(available, "_in_hub_cache", lambda wanted: False)
    assert missing_here(settings).startswith("weights missing: no '")
    assert "set network.download or network.weights" in missing_here(settings)
    assert missing_here(settings.replace({"network.download": True})) == ""
    assert missing_here(settings.replace({"network.weights": str(tmp_path)})) == ""
    by = settings.replace({"network.provider": "file"})
    assert missing_here(by) == "predictions missing: network.file names no file or folder"
    assert missing_here(by.replace({"network.file": str(tmp_path)})) == ""


@pytest.mark.parametrize("name", RECIPES)
def test_pictures_without_rpcs_are_refused(name: str, city: CitySample, tmp_path: Path) -> None:
    recipe: Recipe = find_recipe(name)
    local, _ = with_affine_cameras(city.true_scene, ground_box(city.true_scene, heights=(0.0, 25.0)))
    settings = recipe.settings_type().replace(by_file(tmp_path))
    with pytest.raises(StageError, match="has no RPC camera.*found AffineCamera"):
        recipe.run(RecipeInput(local, None, "x"), settings, context(tmp_path / "work", tmp_path))
    with pytest.raises(StageError, match="has no RPC camera"):
        simulate_satellite_prediction(
            local, lambda frame: np.zeros((1, 1, 3)), box_of(city), SimulatedNoiseSettings()
        )


def test_files_of_other_pictures_are_told_before_any_work(data: RecipeInput, files: Path, tmp_path: Path) -> None:
    place = context(tmp_path / "work", tmp_path)
    settings = VggtBaSettings().replace({**by_file(files / "most-4.npz"), "views.count": 3})
    names = ", ".join(sorted(chosen(data.scene, 3, "most")))
    with pytest.raises(
        DataError, match=rf"of other pictures.*expected {names}; found .*Predict these .* no others"
    ):
        vggt_ba.run(data, settings, place)
    with pytest.raises(DataError, match="There is no file"):
        vggt_ba.run(data, VggtBaSettings().replace(by_file(tmp_path / "none.npz")), place)
    with pytest.raises(SettingsError, match="provider 'file' needs a file"):
        vggt_ba.run(data, VggtBaSettings().replace({"network.provider": "file"}), place)
    with pytest.raises(
        DataError, match=r"holds no predictions; expected a folder with most-2\.npz.*together: most-2"
    ):
        dust3r_views.run(data, Dust3rViewsSettings().replace(by_file(tmp_path)), place)
    assert not (tmp_path / "work").exists()


@pytest.mark.parametrize(
    ("budgets", "kind", "message"),
    [
        ("two", SettingsError, "no list of numbers of views; expected whole numbers from 2 on.*found 'two'"),
        ("1, 4", SettingsError, "found '1, 4'"),
        ("", SettingsError, "found ''"),
        ("7, 9", StageError, "expected at least 7 training pictures; found 6"),
    ],
)
def test_budgets_that_are_none_are_told(
    budgets: str, kind: type[Exception], message: str, data: RecipeInput, tmp_path: Path
) -> None:
    settings = Dust3rViewsSettings().replace({**by_file(tmp_path), "budgets": budgets})
    with pytest.raises(kind, match=message):
        dust3r_views.run(data, settings, context(tmp_path / "work", tmp_path))


def test_what_pixels_show_is_where_the_true_cameras_see_it(city: CitySample) -> None:
    scene = city.true_scene
    places = seen_points(city, 2)
    rows, columns = np.indices(places.shape[:2]) + 0.5
    found = scene.camera_of(scene.frames[2]).project(places[::9, ::9].reshape(-1, 3))
    own = np.stack([columns[::9, ::9].ravel(), rows[::9, ::9].ravel()], axis=1)
    # RPCs fit the rigorous cameras to 0.01 px.
    np.testing.assert_allclose(found, own, atol=0.02)


def test_a_near_camera_sees_the_middle_plane_as_the_rpc_does(city: CitySample) -> None:
    scene, box = city.true_scene, box_of(city)
    for frame in scene.frames[:3]:
        rpc = scene.camera_of(frame)
        camera, pose = near_camera(rpc, box)
        assert camera.width == rpc.width
        right, down = pose.rotation[:2]
        plane = np.mean(box, axis=0) + np.outer([-20.0, 0.0, 15.0], right) + np.outer([5.0, 0.0, -20.0], down)
        # Lines and columns of a satellite's picture are not quite square to each other, and not of one scale.
        np.testing.assert_allclose(camera.project(pose.apply(plane)), rpc.project(plane), atol=6.0)
        middle = plane[1:2]
        np.testing.assert_allclose(camera.project(pose.apply(middle)), rpc.project(middle), atol=0.05)


def test_a_longer_lens_errs_less_where_nothing_else_does(city: CitySample) -> None:
    names = [frame.name for frame in city.true_scene.frames[:2]]
    truth = np.stack([seen_points(city, i) for i in (0, 1)])
    errors = []
    for angle in (30.0, 3.0, 0.3):
        said = simulated(city, names, EXACT, field_of_view=angle)
        assert np.mean(said.cameras[0].params[:2]) == pytest.approx(64 / np.tan(np.radians(angle / 2)), rel=1e-6)
        source, target = said.points[said.valid].astype(np.float64), truth[said.valid]
        off = align(source, target, with_scale=True).apply(source) - target
        errors.append(float(np.sqrt((off**2).sum(axis=1).mean())))
    assert errors[0] > 4 * errors[1]
    assert errors[1] > errors[2]
    assert errors[2] < 1.0
