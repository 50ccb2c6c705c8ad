"""Meshes of recipes: written, and measured where the truth is known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from shapes import CAMERA, around, ball

from toolkit.depth.mesh_tsdf import TsdfSettings, tsdf_mesh
from toolkit.errors import DataError, StageError
from toolkit.geometry.alignment import Similarity
from toolkit.geometry.surface import Mesh
from toolkit.geometry.triangles import moved
from toolkit.progress import silent
from toolkit.recipes.base import RecipeContext, RecipeInput, RecipeResult
from toolkit.recipes.registry import find_recipe
from toolkit.recipes.splat_mesh import SplatMeshSettings
from toolkit.recipes.surface_steps import MESH_FILE, mesh_artifacts, sparse_points, surface_errors
from toolkit.samples.engine import EngineSettings, make_engine
from toolkit.samples.surfaces import true_surface
from toolkit.scene import Frame, Points, Scene
from toolkit.scene.mesh_files import read_mesh
from toolkit.splat.gaussians import Gaussians
from toolkit.workspace import Workspace


@pytest.fixture
def context(tmp_path: Path) -> RecipeContext:
    return RecipeContext(Workspace(tmp_path / "w"), tmp_path / "artifacts", tmp_path / "c", 0, "cpu", silent)


@pytest.fixture(scope="module")
def engine(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    small = {"borescope.image_width": 120, "borescope.image_height": 90}
    settings = EngineSettings().replace({**small, "film.frames": 4, "film.stride": 30})
    return make_engine(tmp_path_factory.mktemp("sample") / "engine", settings).scene


def test_the_truth_in_another_world_is_without_error(engine: Scene, context: RecipeContext) -> None:
    truth = true_surface(engine.image_dir.parent)
    elsewhere = Similarity(7.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([3.0, 4.0, 5.0]))
    frames = tuple(
        replace(frame, cam_from_world=elsewhere.apply_to_pose(frame.cam_from_world))
        for frame in engine.frames
        if frame.cam_from_world is not None
    )
    posed = engine.replace(frames=frames, points=None)
    data = RecipeInput(engine.without_poses(), engine, "engine")
    found = moved(truth, elsewhere)
    metrics, report = mesh_artifacts(found, data, context, scene=posed)
    assert json.loads(json.dumps([metrics, report], allow_nan=False)) == [metrics, report]
    assert metrics["mesh.faces"] == len(truth.faces) == report["faces"]
    # Metres; the alignment of four cameras and single-precision rays.
    assert metrics["mesh.accuracy"] is not None
    assert metrics["mesh.accuracy"] < 1e-6
    assert metrics["mesh.f_score"] == 1.0
    assert "casting rays" in report["errors"]["scope"]
    assert report["errors"]["left_out"]["truth"] > 0.5  # four pictures see a piece of the ring
    # The page gets fewer faces than were measured.
    assert report["faces_in_file"] <= 200_000 < report["faces"]
    assert len(read_mesh(context.artifacts / MESH_FILE).faces) == report["faces_in_file"]


def test_a_surface_that_is_off_is_measured_in_metres(engine: Scene) -> None:
    truth = true_surface(engine.image_dir.parent)
    data = RecipeInput(engine.without_poses(), engine, "engine")
    up = moved(truth, Similarity(1.0, np.eye(3), np.array([0.0, 0.0, 0.002])))
    errors = surface_errors(up, data, scene=engine, samples=5_000)
    # Two millimetres along the axis are at most that far from the surface, and less where it does not lie level.
    assert errors.accuracy.max() <= 0.002 + 1e-6
    assert 0.0003 < errors.accuracy.mean() < 0.002


def test_without_a_truth_the_report_says_so(tmp_path: Path, context: RecipeContext) -> None:
    scene = Scene(tmp_path / "images", {1: CAMERA}, (Frame("a.jpg", 1),))
    for reference in (None, scene):
        metrics, report = mesh_artifacts(ball(), RecipeInput(scene, reference, "x"), context, scene=scene)
        assert metrics == {"mesh.faces": 8.0 * 4**5}
        assert "The data have no true surface" in report["reason"]
    assert read_mesh(context.artifacts / MESH_FILE).rgb is not None
    bare = Mesh(np.zeros((3, 3)), np.zeros((0, 3), np.int32))
    with pytest.raises(DataError, match="A mesh without faces is not written to mesh.ply"):
        mesh_artifacts(bare, RecipeInput(scene, None, "x"), context, scene=scene)


def test_poses_that_cannot_be_aligned_are_told(engine: Scene, context: RecipeContext) -> None:
    one = engine.replace(frames=engine.frames[:1], points=None)
    _, report = mesh_artifacts(ball(), RecipeInput(one, engine, "x"), context, scene=one)
    assert "align" in report["reason"].lower()


def test_sparse_points_are_needed_where_they_are_asked_for(engine: Scene) -> None:
    assert sparse_points(engine).shape[1] == 3
    with pytest.raises(StageError, match="no sparse points; .*Triangulate points first"):
        sparse_points(engine.replace(points=None))


def splat_ball() -> Gaussians:
    """Return disks that lie on a sphere."""
    sphere = ball(finer=4)
    assert sphere.normals is not None
    normals = sphere.normals
    # The turn from +z onto the normal: w = 1 + cos, axis = z x normal.
    turns = np.column_stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals))])
    turns[turns[:, 0] < 1e-9] = (0, 1, 0, 0)
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    count = len(normals)
    scales = np.tile(np.log([0.06, 0.06, 0.001]), (count, 1))
    as_float = {"dtype": torch.float32}
    return Gaussians(
        torch.tensor(sphere.vertices, **as_float),
        torch.tensor(turns, **as_float),
        torch.tensor(scales, **as_float),
        torch.full((count,), 4.0),
        torch.full((count, 1, 3), 1.0),
    )


def pictures_of_the_ball(folder: Path, count: int = 14) -> Scene:
    from PIL import Image

    folder.mkdir()
    frames = []
    for number, pose in enumerate(around(count, 3.0)):
        Image.new("RGB", (CAMERA.width, CAMERA.height), (9, 9, 9)).save(folder / f"{number}.png")
        frames.append(Frame(f"{number}.png", 1, pose))
    points = Points(ball(finer=3).vertices, np.zeros((258, 3), np.uint8))
    return Scene(folder, {1: CAMERA}, tuple(frames), points=points)


def test_a_splat_on_a_sphere_becomes_a_sphere(tmp_path: Path) -> None:
    from toolkit.splat.depth_views import splat_depth_views

    scene = pictures_of_the_ball(tmp_path / "images")
    views = list(splat_depth_views(splat_ball(), scene, SplatMeshSettings().train))
    assert [view.name for view in views] == [frame.name for frame in scene.frames]
    mesh = tsdf_mesh(views, TsdfSettings())
    radius = np.linalg.norm(mesh.vertices, axis=1)
    # Disks of sigma 0.06 lie in the tangent planes: at two sigma they are 0.007 off; voxels are 0.02.
    assert abs(radius.mean() - 1) < 0.01
    assert np.abs(radius - 1).mean() < 0.01
    assert mesh.rgb is not None
    # 255 (0.5 + 1 / (2 sqrt(pi))) = 199.4, less what shows of the black behind.
    assert np.median(mesh.rgb) > 190


def test_masked_pixels_of_a_splat_have_no_depth(tmp_path: Path) -> None:
    from PIL import Image

    from toolkit.splat.depth_views import splat_depth_views

    scene = pictures_of_the_ball(tmp_path / "images", 1)
    (tmp_path / "masks").mkdir()
    mask = np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
    mask[:, :80] = 0
    Image.fromarray(mask).save(tmp_path / "masks" / "0.png.png")
    (view,) = splat_depth_views(splat_ball(), scene.replace(mask_dir=tmp_path / "masks"), SplatMeshSettings().train)
    assert not view.depth[:, :80].any()
    assert (view.depth[:, 80:] > 0).sum() > 1000


def test_the_recipe_meshes_what_the_splat_recipe_trained(
    tmp_path: Path, context: RecipeContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    from toolkit.recipes import splat_mesh

    scene = pictures_of_the_ball(tmp_path / "images")
    trained = RecipeResult(scene, splat_ball(), (), {"test.psnr": 20.0}, {"train": {}})
    # Training takes minutes: the poses are the true ones, and the splat lies on the sphere already.
    monkeypatch.setattr(splat_mesh, "train_and_measure", lambda *arguments: trained)
    recipe = find_recipe("splat-mesh")
    assert SplatMeshSettings().train.kind == "2d"
    data = RecipeInput(scene.without_poses(), scene, "ball")
    settings = SplatMeshSettings().replace({"scene.way": "given", "clip.spacings": 0.3})
    result = recipe.run(data, settings, context)
    assert result.metrics["test.psnr"] == 20.0
    assert result.metrics["mesh.faces"] == len(read_mesh(context.artifacts / MESH_FILE).faces)
    assert [time.name for time in result.times] == ["mesh", "measure mesh"]
    assert result.reports["mesh"]["clipped_faces"] > 0
    whole = recipe.run(data, settings.replace({"clip.spacings": 0}), context)
    assert whole.reports["mesh"]["clipped_faces"] == 0
    assert whole.metrics["mesh.faces"] == result.metrics["mesh.faces"] + result.reports["mesh"]["clipped_faces"]
