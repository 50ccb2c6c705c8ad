"""The adapters to VGGT, DUSt3R, MASt3R and Depth Anything 3, against stand-ins with the calls they document."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file
from stand_in_networks import DepthAnything3, Mode, Vggt, asked, install_all, weights_folder, world_from_cam

from toolkit.errors import (
    CapabilityError,
    DataError,
    MissingDependencyError,
    SettingsError,
    StageError,
    WeightsMissingError,
)
from toolkit.geometry.cameras import ColmapCamera
from toolkit.poses.feedforward.map_plan import (
    MapPlan,
    cropped_to_smallest,
    depth_anything_plan,
    dust3r_plan,
    of_one_size,
    vggt_plan,
)
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.predictions_file import write_predictions
from toolkit.poses.feedforward.providers import network, predict
from toolkit.poses.feedforward.settings import FeedForwardSettings
from toolkit.poses.feedforward.weights import check_complete
from toolkit.scene import Frame, Scene

PROVIDERS = ("vggt", "dust3r", "mast3r", "depth-anything-3")


@pytest.fixture
def packages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Install the stand-ins."""
    install_all(monkeypatch)


def picture(width: int, height: int) -> np.ndarray:
    """Return a picture (H, W, 3) whose red says the column and green the row, as shares of the side."""
    rows, columns = np.indices((height, width)) + 0.5
    made = np.stack([255 * columns / width, 255 * rows / height, np.zeros_like(rows)], axis=-1)
    return np.rint(made).astype(np.uint8)


@pytest.mark.parametrize(
    ("plan", "scaled", "size", "corner"),
    [
        (vggt_plan(2048, 2048, pad=False), (518, 518), (518, 518), (0, 0)),
        (vggt_plan(640, 480, pad=False), (518, 392), (518, 392), (0, 0)),
        (vggt_plan(480, 640, pad=False), (518, 686), (518, 518), (0, -84)),
        (vggt_plan(480, 640, pad=True), (392, 518), (518, 518), (63, 0)),
        (vggt_plan(640, 480, pad=True), (518, 392), (518, 518), (0, 63)),
        (dust3r_plan(640, 480), (512, 384), (512, 384), (0, 0)),
        (dust3r_plan(2048, 2048), (512, 512), (512, 384), (0, -64)),
        (dust3r_plan(300, 1000), (154, 512), (144, 512), (-5, 0)),
        (depth_anything_plan(1600, 1200), (504, 378), (504, 378), (0, 0)),
        (depth_anything_plan(640, 350), (504, 280), (504, 280), (0, 0)),
        # 1000 x 694 becomes 504 x 350 and stays; 1000 x 680 becomes 504 x 343, half way between 336 and 350.
        (depth_anything_plan(1000, 680), (504, 350), (504, 350), (0, 0)),
    ],
)
def test_pictures_are_scaled_by_the_rules_of_each_package(
    plan: MapPlan, scaled: tuple[int, int], size: tuple[int, int], corner: tuple[int, int]
) -> None:
    assert (plan.scaled, plan.size, plan.corner) == (scaled, size, corner)


@pytest.mark.parametrize(
    "plan",
    [
        vggt_plan(200, 300, pad=False),
        vggt_plan(200, 300, pad=True),
        dust3r_plan(300, 300),
        depth_anything_plan(301, 187),
        of_one_size([vggt_plan(300, 200, pad=False), vggt_plan(300, 260, pad=False)])[0],
        cropped_to_smallest([depth_anything_plan(300, 200), depth_anything_plan(300, 260)])[1],
    ],
)
def test_a_pixel_of_a_map_shows_the_place_that_it_is_said_to_show(plan: MapPlan) -> None:
    source = picture(*plan.picture)
    shown = plan.apply(source, Image.Resampling.BICUBIC)
    assert shown.shape == (plan.size[1], plan.size[0], 3)
    rows, columns = np.indices(shown.shape[:2]) + 0.5
    sx, sy, ox, oy = plan.picture_from_map
    place = np.stack([sx * columns + ox, sy * rows + oy], axis=-1)
    told = shown[..., :2] / 255 * np.array(plan.picture)
    inside = plan.shown & (place > 6).all(axis=-1) & (place < np.array(plan.picture) - 6).all(axis=-1)
    assert inside.mean() > 0.5
    # Colours are whole numbers: half a 255th of a side of 300 pixels is 0.6 pixels; bias would show in the mean.
    off = (told - place)[inside]
    assert np.abs(off).max() < 1.3
    assert np.abs(off.mean(axis=0)).max() < 0.05


def test_padding_is_white_and_not_shown() -> None:
    plan = vggt_plan(100, 200, pad=True)
    made = plan.apply(picture(100, 200), Image.Resampling.BICUBIC)
    assert (made[~plan.shown] == 255).all()
    assert plan.shown.sum() == plan.scaled[0] * plan.scaled[1]


def test_a_picture_like_a_thread_is_refused() -> None:
    with pytest.raises(DataError, match="too narrow for the network.*found 4000x10 pixels"):
        vggt_plan(4000, 10, pad=False)


def check_poses(made: Prediction) -> None:
    for i, pose in enumerate(made.cam_from_world):
        # The stand-ins' poses are of single precision.
        np.testing.assert_allclose(pose.inverse().matrix, world_from_cam(i), atol=1e-6)


def check_rays(made: Prediction, k: np.ndarray, half: float) -> None:
    """Check that the pixel (10, 20) of each map and its place in the picture have the ray that ``k`` says."""
    own = np.array([[10.5, 20.5]])
    ray = np.linalg.solve(k, [10 + half, 20 + half, 1.0])
    for i, camera in enumerate(made.cameras):
        np.testing.assert_allclose(camera.project(ray[None]), made.to_picture(i, own), atol=1e-3)
        column, row = 10, 20
        point = made.cam_from_world[i].apply(made.points[i, row, column].astype(float)[None])[0]
        np.testing.assert_allclose(point / point[2], ray, atol=1e-5)


@pytest.mark.usefixtures("packages")
@pytest.mark.parametrize("fit", ["crop", "pad"])
def test_vggt(tmp_path: Path, fit: str) -> None:
    folder = weights_folder(tmp_path / "vggt", width=3)
    chosen = network(FeedForwardSettings(provider="vggt", weights=str(folder), fit=fit))
    made = chosen.predict([picture(480, 640), picture(480, 640)], ["a", "b"])
    height = width = 518
    assert asked.images.shape == (2, 3, height, width)
    assert 0 <= asked.images.min() <= asked.images.max() <= 1
    assert made.names == ("a", "b")
    assert (made.cameras[0].width, made.cameras[0].height) == (480, 640)
    k = np.array(
        [
            [width / 2 / np.tan(Vggt.FIELDS[1] / 2), 0, width / 2],
            [0, height / 2 / np.tan(Vggt.FIELDS[0] / 2), height / 2],
            [0, 0, 1],
        ]
    )
    check_poses(made)
    # Its principal point is the middle of the map with edges counted: centres at +0.5, as here.
    scale = 480 / 518 if fit == "crop" else 480 / 392
    np.testing.assert_allclose(made.cameras[0].params[0], k[0, 0] * scale, rtol=1e-6)
    # The map's middle is the picture's.
    np.testing.assert_allclose(made.cameras[0].params[2:], (240, 320), atol=1e-3)
    assert made.valid.mean() == pytest.approx(1.0 if fit == "crop" else 392 / 518)
    if fit == "crop":
        check_rays(made, k, 0.5)


@pytest.mark.usefixtures("packages")
def test_vggt_points_of_its_head_come_with_that_head_s_confidence(tmp_path: Path) -> None:
    folder = weights_folder(tmp_path / "vggt")
    settings = FeedForwardSettings(provider="vggt", weights=str(folder), points="head")
    made = network(settings).predict([picture(60, 40)], ["a"])
    assert (made.points == 0.25).all()
    assert (made.confidence == 3).all()
    assert (
        network(settings.replace({"points": "depth"})).predict([picture(60, 40)], ["a"]).confidence == 1.5
    ).all()


@pytest.mark.usefixtures("packages")
def test_vggt_pictures_of_several_sizes_are_padded_to_one(tmp_path: Path) -> None:
    folder = weights_folder(tmp_path / "vggt")
    settings = FeedForwardSettings(provider="vggt", weights=str(folder))
    made = network(settings).predict([picture(640, 480), picture(640, 320)], ["a", "b"])
    assert made.depth.shape == (2, 392, 518)
    # 518 x 259 is 18.5 patches high: halves go to the even number, 18 of 14 pixels, in the middle of 392 rows.
    assert made.valid[1].sum() == 518 * 252
    assert not made.valid[1, 0].any()
    np.testing.assert_allclose(made.to_picture(1, [[259, 196]]), [[320, 160]])


@pytest.mark.usefixtures("packages")
@pytest.mark.parametrize("name", ["model.pt", "model.safetensors"])
def test_vggt_takes_a_file(tmp_path: Path, name: str) -> None:
    state = {"layer.weight": torch.ones(1, 3), "layer.bias": torch.ones(1)}
    if name.endswith(".pt"):
        torch.save(state, tmp_path / name)
    else:
        save_file(state, tmp_path / name)
    settings = FeedForwardSettings(provider="vggt", weights=str(tmp_path / name))
    assert network(settings).name == f"VGGT {tmp_path / name}"


@pytest.mark.usefixtures("packages")
@pytest.mark.parametrize("provider", ["dust3r", "mast3r"])
@pytest.mark.parametrize("count", [2, 3])
def test_dust3r_and_mast3r(tmp_path: Path, provider: str, count: int) -> None:
    folder = weights_folder(tmp_path / provider)
    settings = FeedForwardSettings(provider=provider, weights=str(folder), steps=7, rate=0.02, pairs="swin-3")
    chosen = network(settings)
    before = torch.random.get_rng_state()
    made = chosen.predict([picture(640, 480)] * count, [f"{i}" for i in range(count)], seed=4)
    assert torch.equal(before, torch.random.get_rng_state())
    check_poses(made)
    # Pixel (i, j) of DUSt3R has its centre at (i, j): its ray is that of (i + 0.5, j + 0.5) here.
    check_rays(made, np.array([[300.0, 0, 256], [0, 300, 192], [0, 0, 1]]), 0.0)
    np.testing.assert_allclose(made.cameras[0].params, (375, 375, 256.5 * 1.25, 192.5 * 1.25))
    assert made.depth[1, 0, 0] == 3
    assert made.confidence[1, 0, 0] == 2
    view = asked.views[0]
    assert view["img"].shape == (1, 3, 384, 512)
    assert view["true_shape"].tolist() == [[384, 512]]
    assert -1 <= view["img"].min() < -0.9
    assert asked.scene_graph == "swin-3"
    if provider == "dust3r":
        assert asked.mode is (Mode.PairViewer if count == 2 else Mode.PointCloudOptimizer)
        if count == 3:
            assert asked.alignment == ("mst", 7, "cosine", 0.02)
    else:
        assert asked.options["niter2"] == 7
        assert asked.options["lr1"] == pytest.approx(0.14)


@pytest.mark.usefixtures("packages")
def test_the_seed_is_that_of_the_alignment(tmp_path: Path) -> None:
    chosen = network(FeedForwardSettings(provider="dust3r", weights=str(weights_folder(tmp_path / "d"))))
    found = []
    for seed in (1, 1, 2):
        chosen.predict([picture(64, 48)] * 3, ["a", "b", "c"], seed=seed)
        found.append(asked.noise)
    assert found[0] == found[1] != found[2]


@pytest.mark.usefixtures("packages")
@pytest.mark.parametrize("provider", ["dust3r", "mast3r"])
def test_one_picture_is_too_few_to_compare(tmp_path: Path, provider: str) -> None:
    chosen = network(FeedForwardSettings(provider=provider, weights=str(weights_folder(tmp_path / "d"))))
    with pytest.raises(StageError, match="compares pictures; expected at least 2; found 1"):
        chosen.predict([picture(64, 48)], ["a"])


@pytest.mark.usefixtures("packages")
def test_dust3r_maps_of_several_sizes_share_one_size(tmp_path: Path) -> None:
    chosen = network(FeedForwardSettings(provider="dust3r", weights=str(weights_folder(tmp_path / "d"))))
    made = chosen.predict([picture(640, 480), picture(480, 640)], ["a", "b"])
    assert made.depth.shape == (2, 512, 512)
    assert made.valid[0].sum() == made.valid[1].sum() == 512 * 384
    assert made.valid[0, :384].all()
    assert made.valid[1, :, :384].all()


@pytest.mark.usefixtures("packages")
def test_depth_anything_3(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = weights_folder(tmp_path / "da3")
    sky = np.zeros((2, 378, 504), dtype=bool)
    sky[:, :100] = True
    monkeypatch.setattr(DepthAnything3, "sky", sky)
    settings = FeedForwardSettings(provider="depth-anything-3", weights=str(folder))
    made = network(settings).predict([picture(1600, 1200)] * 2, ["a", "b"])
    assert asked.process == (504, "upper_bound_resize")
    assert asked.image[0].shape == (1200, 1600, 3)
    check_poses(made)
    k = np.array([[400.0, 0, 252], [0, 410, 189], [0, 0, 1]])
    np.testing.assert_allclose(made.cameras[0].params, (400 * 1600 / 504, 410 * 1200 / 378, 800, 600), rtol=1e-6)
    np.testing.assert_allclose(made.map_camera(0).intrinsics, k, atol=1e-4)
    assert not made.valid[:, :100].any()
    assert made.valid[:, 100:].all()


@pytest.mark.usefixtures("packages")
def test_a_map_of_another_size_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DepthAnything3, "size", (364, 504))
    chosen = network(
        FeedForwardSettings(provider="depth-anything-3", weights=str(weights_folder(tmp_path / "da3")))
    )
    with pytest.raises(DataError, match=r"another size \(depth of 'a'\); expected \(378, 504\)"):
        chosen.predict([picture(1600, 1200)], ["a"])


@pytest.mark.usefixtures("packages")
def test_depth_without_cameras_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DepthAnything3, "cameras", False)
    chosen = network(
        FeedForwardSettings(provider="depth-anything-3", weights=str(weights_folder(tmp_path / "da3")))
    )
    with pytest.raises(CapabilityError, match="gives no cameras; expected a network for any views"):
        chosen.predict([picture(1600, 1200)], ["a"])


@pytest.mark.parametrize("provider", PROVIDERS)
def test_a_missing_package_says_what_installs_it(provider: str, monkeypatch: pytest.MonkeyPatch) -> None:
    package = provider.replace("-", "_")
    monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(
        MissingDependencyError, match=rf"package '{package}' cannot be imported.*git.*provider=file"
    ):
        network(FeedForwardSettings(provider=provider))


@pytest.mark.usefixtures("packages")
@pytest.mark.parametrize("provider", PROVIDERS)
def test_missing_weights_are_told_as_such(provider: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    constants = pytest.importorskip("huggingface_hub.constants")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    with pytest.raises(WeightsMissingError, match=r"Weights missing: no '.*no download was asked.*hf download"):
        network(FeedForwardSettings(provider=provider))
    with pytest.raises(WeightsMissingError, match="Weights missing: there is no file or folder '/no/such'"):
        network(FeedForwardSettings(provider=provider, weights="/no/such"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(WeightsMissingError, match="holds none; expected model.safetensors"):
        network(FeedForwardSettings(provider=provider, weights=str(tmp_path / "empty")))


@pytest.mark.usefixtures("packages")
@pytest.mark.parametrize("provider", PROVIDERS)
def test_the_hub_is_asked_for_tensors_only(provider: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hub = pytest.importorskip("huggingface_hub")
    folder = weights_folder(tmp_path / "snapshot")
    seen: dict[str, Any] = {}

    def snapshot(name: str, **options: Any) -> str:
        seen.update(options, name=name)
        return str(folder)

    monkeypatch.setattr(hub, "snapshot_download", snapshot)
    network(FeedForwardSettings(provider=provider, weights="owner/model", download=True))
    assert seen == {
        "name": "owner/model",
        "allow_patterns": ["config.json", "*.safetensors"],
        "local_files_only": False,
    }


@pytest.mark.usefixtures("packages")
@pytest.mark.parametrize("provider", ["dust3r", "mast3r", "depth-anything-3"])
def test_a_checkpoint_that_would_be_run_is_refused(provider: str, tmp_path: Path) -> None:
    (tmp_path / "model.pth").write_bytes(b"code")
    with pytest.raises(CapabilityError, match="runs code that the file names; expected a folder with config.json"):
        network(FeedForwardSettings(provider=provider, weights=str(tmp_path / "model.pth")))


@pytest.mark.usefixtures("packages")
def test_damaged_weights_are_told(tmp_path: Path) -> None:
    def load(provider: str, path: Path) -> None:
        network(FeedForwardSettings(provider=provider, weights=str(path)))

    (tmp_path / "model.pt").write_bytes(b"nothing")
    with pytest.raises(DataError, match=r"model\.pt cannot be loaded"):
        load("vggt", tmp_path / "model.pt")
    torch.save([1, 2], tmp_path / "model.pt")
    with pytest.raises(DataError, match="holds no weights; expected named tensors; found list"):
        load("vggt", tmp_path / "model.pt")
    torch.save({"layer.weight": torch.ones(1, 3)}, tmp_path / "model.pt")
    with pytest.raises(DataError, match=r"cannot be loaded.*layer\.bias"):
        load("vggt", tmp_path / "model.pt")
    folder = weights_folder(tmp_path / "folder", depth=4)
    for provider in PROVIDERS:
        with pytest.raises(DataError, match="cannot be loaded.*unexpected keyword argument 'depth'"):
            load(provider, folder)
    (folder / "config.json").write_text("[]")
    with pytest.raises(DataError, match="no settings of a network; expected a table in JSON; found list"):
        load("vggt", folder)
    (folder / "config.json").write_text("{")
    with pytest.raises(DataError, match=r"config\.json cannot be loaded"):
        load("vggt", folder)
    (folder / "config.json").write_text("{}")
    (folder / "model.safetensors").write_bytes(b"nothing")
    for provider in PROVIDERS:
        with pytest.raises(DataError, match="cannot be loaded"):
            load(provider, folder)


@pytest.mark.usefixtures("packages")
@pytest.mark.parametrize("provider", ["dust3r", "mast3r", "depth-anything-3"])
def test_weights_of_another_network_are_told(provider: str, tmp_path: Path) -> None:
    folder = weights_folder(tmp_path / "other")
    save_file({"other.weight": torch.ones(1, 3)}, folder / "model.safetensors")
    with pytest.raises(DataError, match=r"of another network; expected 2 tensors; found 2 missing: layer\.weight"):
        network(FeedForwardSettings(provider=provider, weights=str(folder)))


class Large(torch.nn.Module):
    """Forty layers, one of them under two names, and a tensor for training only."""

    def __init__(self) -> None:
        super().__init__()
        self.blocks = torch.nn.ModuleList([torch.nn.Linear(2, 2) for _ in range(40)])
        self.again = self.blocks[3]
        self.mask_token = torch.nn.Parameter(torch.zeros(1, 2))


def test_of_all_tensors_only_shared_and_unused_ones_may_be_missing(tmp_path: Path) -> None:
    model = Large()
    state = {name: tensor for name, tensor in model.state_dict().items() if name.startswith("blocks.")}
    assert len(state) == len(model.state_dict()) - 3
    save_file(state, tmp_path / "model.safetensors")
    check_complete(model, tmp_path)
    # One of eighty, which another file beside it has: packages read one file.
    save_file({"blocks.7.bias": state.pop("blocks.7.bias")}, tmp_path / "other.safetensors")
    save_file(state, tmp_path / "model.safetensors")
    with pytest.raises(DataError, match=r"incomplete.*expected 83 tensors; found 1 missing: blocks\.7\.bias\. Get"):
        check_complete(model, tmp_path)
    # Neither name of a shared one.
    del state["blocks.3.weight"]
    save_file(state, tmp_path / "model.safetensors")
    with pytest.raises(DataError, match=r"3 missing: blocks\.3\.weight, blocks\.7\.bias, again\.weight"):
        check_complete(model, tmp_path)
    (tmp_path / "model.safetensors").unlink()
    with pytest.raises(DataError, match=r"model\.safetensors cannot be loaded"):
        check_complete(model, tmp_path)


@pytest.mark.usefixtures("packages")
@pytest.mark.parametrize("provider", PROVIDERS)
def test_a_gpu_that_is_not_there_is_told(provider: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    folder = weights_folder(tmp_path / "folder")
    with pytest.raises(CapabilityError, match="cannot run on 'cuda'.*Choose device=cpu"):
        network(FeedForwardSettings(provider=provider, weights=str(folder), device="cuda"))


def scene_of(folder: Path) -> Scene:
    folder.mkdir()
    for name in ("a.png", "b.png"):
        Image.fromarray(picture(60, 40)).save(folder / name)
    frames = (Frame("a.png", 1), Frame("b.png", 1))
    return Scene(folder, {1: ColmapCamera.pinhole(60, 40, 50)}, frames)


@pytest.mark.usefixtures("packages")
def test_a_scene_s_pictures_are_predicted_and_kept_in_a_file(tmp_path: Path) -> None:
    scene = scene_of(tmp_path / "images")
    folder = weights_folder(tmp_path / "vggt")
    messages: list[str] = []
    made = predict(
        scene,
        FeedForwardSettings(provider="vggt", weights=str(folder)),
        progress=lambda event: messages.append(event.message),
    )
    assert made.names == ("a.png", "b.png")
    assert messages == ["loading", f"VGGT {folder}", ""]
    write_predictions(tmp_path / "predictions.npz", made)
    again = predict(scene, FeedForwardSettings(provider="file", file=str(tmp_path / "predictions.npz")))
    np.testing.assert_array_equal(again.points, made.points)
    assert again.provider == made.provider


def test_no_file_and_no_pictures_are_told(tmp_path: Path) -> None:
    scene = scene_of(tmp_path / "images")
    with pytest.raises(SettingsError, match="'file' needs a file; expected file=<path"):
        predict(scene, FeedForwardSettings(provider="file"))
    with pytest.raises(SettingsError, match="'file' is no network"):
        network(FeedForwardSettings(provider="file"))
    with pytest.raises(DataError, match="has no pictures"):
        predict(scene.replace(frames=()), FeedForwardSettings(provider="file"))
