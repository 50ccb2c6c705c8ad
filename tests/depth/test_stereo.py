"""The stage stereo: from a scene to a dense folder, what it takes up again, and what it refuses."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image

from toolkit.depth import colmap_stereo, stereo
from toolkit.depth.dense_folder import DenseFolder
from toolkit.depth.dense_record import read_record
from toolkit.depth.stereo import StereoResult, stereo_depth
from toolkit.depth.stereo_settings import StereoSettings
from toolkit.errors import Cancelled, CapabilityError, DataError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.progress import ProgressEvent
from toolkit.scene import Points

QUICK = StereoSettings().replace(
    {"search.radius": 3, "search.iterations": 2, "search.levels": 2, "choice.views": 3, "reject.border": 4}
)


@pytest.fixture(scope="module")
def made(slanted: Any, tmp_path_factory: pytest.TempPathFactory) -> StereoResult:
    return stereo_depth(slanted.scene, QUICK, tmp_path_factory.mktemp("stereo") / "dense", seed=1)


def maps(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((folder / "stereo" / "depth_maps").iterdir())}


def test_every_picture_gets_its_depth(made: StereoResult, slanted: Any) -> None:
    assert len(made.views) == 5
    for view in made.views:
        known = view.depth > 0
        error = np.abs(view.depth / slanted.depth[view.name] - 1)[known]
        # What is kept is right: the filter lets less than two percent of wrong pixels through.
        assert np.mean(error < 0.01) > 0.98
        assert known.mean() > 0.6
        assert view.confidence is not None
        assert view.confidence[known].min() >= 0.5
        assert view.normals is not None
        assert np.allclose(np.linalg.norm(view.normals[known], axis=1), 1, atol=1e-5)
        assert not known[:4].any()


def test_the_report_adds_up(made: StereoResult) -> None:
    report = made.to_dict()
    assert report["images"] == 5
    assert sum(report["pixels"].values()) == 5 * 96 * 72
    assert report["seconds_per_megapixel"] > 0
    assert 0.6 < report["coverage"] < 1
    assert all(len(frame["sources"]) == 3 for frame in report["frames"])


def test_only_final_maps_are_left(made: StereoResult) -> None:
    assert all(name.endswith(".geometric.bin") for name in maps(made.folder))


def test_a_cancelled_run_goes_on_where_it_was(slanted: Any, made: StereoResult, tmp_path: Path) -> None:
    def stop(event: ProgressEvent) -> None:
        if event.stage == "stereo.search" and event.done == 3:
            raise Cancelled("enough")

    folder = tmp_path / "dense"
    with pytest.raises(Cancelled):
        stereo_depth(slanted.scene, QUICK, folder, seed=1, progress=stop)
    before = {path.name: path.stat().st_mtime_ns for path in (folder / "stereo" / "depth_maps").iterdir()}
    assert len(before) == 3
    kept: list[int] = []

    def look(event: ProgressEvent) -> None:
        if event.stage == "stereo.search" and event.done == 5:
            now = {path.name: path.stat().st_mtime_ns for path in (folder / "stereo" / "depth_maps").iterdir()}
            kept.append(sum(now[name] == time for name, time in before.items()))

    stereo_depth(slanted.scene, QUICK, folder, seed=1, progress=look)
    assert kept == [3]
    assert maps(folder) == maps(made.folder)


def test_what_is_whole_is_not_done_again_unless_a_setting_changed(
    slanted: Any, made: StereoResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    monkeypatch.setattr(stereo._Search, "_photometric", lambda self, name: calls.append(name))
    again = stereo_depth(slanted.scene, QUICK, made.folder, seed=1)
    assert calls == []
    assert again.to_dict() == made.to_dict()
    key = stereo.scene_key(slanted.scene, QUICK, 1)
    assert stereo.scene_key(slanted.scene, QUICK, 2) != key
    assert stereo.scene_key(slanted.scene, QUICK.replace({"reject.edge": 1.0}), 1) != key
    moved = dataclasses.replace(slanted.scene.frames[0], cam_from_world=slanted.scene.frames[1].cam_from_world)
    assert stereo.scene_key(slanted.scene.replace(frames=(moved, *slanted.scene.frames[1:])), QUICK, 1) != key


def test_maps_of_other_settings_go(slanted: Any, tmp_path: Path) -> None:
    stereo.begin_record(tmp_path / "dense", "one")
    (tmp_path / "dense" / "stereo" / "depth_maps").mkdir(parents=True)
    (tmp_path / "dense" / "stereo" / "depth_maps" / "0.png.geometric.bin").touch()
    stereo.begin_record(tmp_path / "dense", "one")
    assert (tmp_path / "dense" / "stereo").is_dir()
    stereo.begin_record(tmp_path / "dense", "two")
    assert not (tmp_path / "dense" / "stereo").exists()
    (tmp_path / "dense" / "made_from.json").write_text("{", encoding="utf-8")
    stereo.begin_record(tmp_path / "dense", "two")
    with pytest.raises(StageError, match="is in the way"):
        stereo_depth(slanted.scene, QUICK, slanted.scene.image_dir)


def test_pictures_may_differ_in_size(plane_maker: Callable[..., Any], tmp_path: Path) -> None:
    plane = plane_maker(tmp_path / "plane", small=True)
    found = stereo_depth(plane.scene, QUICK, tmp_path / "dense")
    view = found.views[4]
    assert view.depth.shape == (54, 72)
    known = view.depth > 0
    assert known.mean() > 0.5
    assert np.median(np.abs(view.depth / plane.depth["4.png"] - 1)[known]) < 0.005


def test_masked_pixels_have_no_depth(slanted: Any, tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    mask = np.full((72, 96), 255, np.uint8)
    mask[:, :48] = 0
    Image.fromarray(mask).save(tmp_path / "masks" / "0.png.png")
    scene = slanted.scene.replace(mask_dir=tmp_path / "masks")
    few = scene.replace(frames=scene.frames[:3])
    found = stereo_depth(few, QUICK, tmp_path / "dense")
    assert not (found.views[0].depth[:, :50] > 0).any()  # and two pixels about it
    assert (found.views[0].depth > 0).any()
    assert found.frames[0].rejected["masked"] == 72 * 50


def test_bad_scenes_are_told(slanted: Any, tmp_path: Path) -> None:
    scene, folder = slanted.scene, tmp_path / "dense"
    with pytest.raises(StageError, match="two pictures with poses at least.*found 1 of 1"):
        stereo_depth(scene.replace(frames=scene.frames[:1]), QUICK, folder)
    with pytest.raises(StageError, match="Stereo needs sparse points"):
        stereo_depth(scene.replace(points=None), QUICK, folder)
    five = Points(scene.points.xyz[:5], scene.points.rgb[:5])
    with pytest.raises(StageError, match="No picture has another one.*sees only 5"):
        stereo_depth(scene.replace(points=five), QUICK, folder)
    fisheye = ColmapCamera("OPENCV_FISHEYE", 96, 72, (80.0, 80.0, 48.0, 36.0, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(CapabilityError, match="Take the distortion out"):
        stereo_depth(scene.replace(cameras={1: fisheye}), QUICK, folder)
    with pytest.raises(DataError, match="differ in size"):
        stereo_depth(scene.replace(cameras={1: ColmapCamera.pinhole(95, 72, 80.0)}), QUICK, folder)
    assert not (folder / "stereo" / "depth_maps").is_dir() or not maps(folder)


def test_a_picture_without_points_is_left_out_with_its_reason(slanted: Any, tmp_path: Path) -> None:
    scene = slanted.scene
    away = scene.frames[4].cam_from_world.centre
    turned = dataclasses.replace(scene.frames[4], cam_from_world=RigidTransform.look_at(away, away - (0, 0, 1)))
    found = stereo_depth(scene.replace(frames=(*scene.frames[:3], turned)), QUICK, tmp_path / "dense")
    assert len(found.views) == 3
    assert "sees only 0 of the scene's points" in found.frames[3].reason
    assert found.to_dict()["images"] == 3


def test_colmaps_own_search_is_refused_without_cuda(
    slanted: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pycolmap, "has_cuda", False)
    with pytest.raises(CapabilityError, match="pycolmap built with CUDA"):
        stereo_depth(slanted.scene, QUICK.replace({"method": "colmap-cuda"}), tmp_path / "dense")
    assert not (tmp_path / "dense").exists()


def test_colmaps_own_search_is_called_where_there_is_cuda(
    slanted: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []

    def search(root: Path, *, options: Any) -> None:
        asked.append(options)
        dense = DenseFolder(root)
        for name, depth in slanted.depth.items():
            if name in dense.fused_names:
                dense.write(name, depth.astype(np.float32), np.full((*depth.shape, 3), -0.577, np.float32), None)

    monkeypatch.setattr(pycolmap, "has_cuda", True)
    monkeypatch.setattr(pycolmap, "patch_match_stereo", search)
    settings = QUICK.replace({"method": "colmap-cuda", "reject.edge": 0.0})
    found = stereo_depth(slanted.scene, settings, tmp_path / "dense")
    assert asked[0].geom_consistency
    assert asked[0].window_radius == 3
    assert 1 < asked[0].depth_min < 3 < asked[0].depth_max < 6
    assert np.allclose(found.views[0].depth[4:-4, 4:-4], slanted.depth["0.png"][4:-4, 4:-4])
    assert found.frames[0].rejected["border"] > 0

    def fail(root: Path, *, options: Any) -> None:
        raise RuntimeError("no GPU left")

    monkeypatch.setattr(pycolmap, "patch_match_stereo", fail)
    with pytest.raises(StageError, match="no GPU left"):
        stereo_depth(slanted.scene, settings, tmp_path / "other")
    monkeypatch.setattr(pycolmap, "patch_match_stereo", lambda root, *, options: None)
    with pytest.raises(StageError, match="left out depth maps"):
        colmap_stereo.colmap_patch_match(DenseFolder(tmp_path / "other"), {"0.png": _choice()}, settings)


def _choice() -> Any:
    from toolkit.depth.view_choice import ViewChoice

    return ViewChoice("0.png", ("1.png",), (1.0, 2.0), 20)


def test_a_damaged_count_is_told(made: StereoResult) -> None:
    path = made.folder / "stereo" / "rejected" / "0.png.json"
    before = path.read_text(encoding="utf-8")
    path.write_text('{"kept": "many"}', encoding="utf-8")
    try:
        with pytest.raises(DataError, match="is damaged"):
            read_record(DenseFolder(made.folder), "0.png")
    finally:
        path.write_text(before, encoding="utf-8")
