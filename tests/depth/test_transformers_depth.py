"""Networks of transformers: tiny ones with random weights go the whole real way, and bad files are refused."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toolkit.depth.transformers_depth import TransformersDepth
from toolkit.errors import CapabilityError, DataError, MissingDependencyError, WeightsMissingError
from toolkit.scene import Scene

transformers = pytest.importorskip(
    "transformers", reason="transformers is not installed: pip install .[transformers]"
)


@pytest.fixture(autouse=True)
def _no_network(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Keep every test away from the hub and from what this machine has of it."""
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    bars = transformers.utils.logging.is_progress_bar_enabled()
    transformers.utils.logging.disable_progress_bar()
    yield
    if bars:
        transformers.utils.logging.enable_progress_bar()


def tiny_dpt() -> Any:
    """Return a DPT of a few thousand random weights."""
    return transformers.DPTForDepthEstimation(
        transformers.DPTConfig(
            hidden_size=16,
            num_hidden_layers=4,
            num_attention_heads=2,
            intermediate_size=16,
            image_size=32,
            patch_size=8,
            backbone_out_indices=[0, 1, 2, 3],
            neck_hidden_sizes=[8, 8, 8, 8],
            fusion_hidden_size=8,
        )
    )


def tiny_depth_anything(**changes: Any) -> Any:
    """Return a Depth Anything of a few thousand random weights."""
    backbone = transformers.Dinov2Config(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        mlp_ratio=1,
        image_size=28,
        patch_size=14,
        out_features=["stage1", "stage2", "stage3", "stage4"],
        reshape_hidden_states=False,
    )
    return transformers.DepthAnythingForDepthEstimation(
        transformers.DepthAnythingConfig(
            backbone_config=backbone,
            reassemble_hidden_size=16,
            neck_hidden_sizes=[8, 8, 8, 8],
            fusion_hidden_size=8,
            head_hidden_size=4,
            **changes,
        )
    )


def save(model: Any, folder: Path, **processor: Any) -> Path:
    """Write a network with positive, varied output and its image processor as a hub folder has them."""
    import torch

    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(0.3 * torch.randn(parameter.shape, generator=generator))
        last = model.head.conv3 if hasattr(model.head, "conv3") else model.head.head[-2]
        last.bias.fill_(5.0)
    model.save_pretrained(folder)
    options = {
        "size": {"height": 28, "width": 28},
        "keep_aspect_ratio": True,
        "ensure_multiple_of": 14,
        **processor,
    }
    transformers.DPTImageProcessor(**options).save_pretrained(folder)
    return folder


def save_dpt(folder: Path) -> Path:
    return save(tiny_dpt(), folder, size={"height": 32, "width": 32}, keep_aspect_ratio=False, ensure_multiple_of=1)


def rewrite(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change the tensors of a saved network."""
    from safetensors.torch import load_file, save_file

    tensors = load_file(folder / "model.safetensors")
    change(tensors)
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})


@pytest.mark.parametrize(
    ("make", "kind", "type_name"),
    [
        (save_dpt, "affine-disparity", "dpt"),
        (lambda folder: save(tiny_depth_anything(), folder), "affine-disparity", "depth_anything"),
        (
            lambda folder: save(tiny_depth_anything(depth_estimation_type="metric", max_depth=80), folder),
            "metric",
            "depth_anything",
        ),
    ],
    ids=["dpt", "depth anything", "metric depth anything"],
)
def test_a_network_in_a_folder_predicts_depth_of_the_pictures_size(
    flat_scene: Callable[..., Scene], tmp_path: Path, make: Callable[[Path], Path], kind: str, type_name: str
) -> None:
    folder = make(tmp_path / "network")
    scene = flat_scene()
    provider = TransformersDepth(str(folder))
    prediction = provider.predict(scene, scene.frame("nadir.png"))
    assert provider.name == f"{type_name} {folder}"
    assert prediction.kind == kind
    assert prediction.values.shape == (30, 40)
    assert prediction.values.dtype == np.float32
    assert np.isfinite(prediction.values).all()
    assert prediction.values.std() > 0, "depends on the picture"
    again = TransformersDepth(str(folder)).predict(scene, scene.frame("nadir.png"))
    np.testing.assert_array_equal(again.values, prediction.values)
    other = provider.predict(scene, scene.frame("oblique.png"))
    assert np.abs(other.values - prediction.values).max() > 0


def test_the_output_is_that_of_transformers_own_pipeline(flat_scene: Callable[..., Scene], tmp_path: Path) -> None:
    import torch
    from PIL import Image

    folder = save_dpt(tmp_path / "network")
    scene = flat_scene()
    mine = TransformersDepth(str(folder)).predict(scene, scene.frame("nadir.png")).values
    picture = Image.open(scene.image_path(scene.frame("nadir.png")))
    processor = transformers.DPTImageProcessor.from_pretrained(folder)
    model = transformers.DPTForDepthEstimation.from_pretrained(folder).eval()
    with torch.inference_mode():
        raw = model(**processor(images=picture, return_tensors="pt")).predicted_depth
    assert raw.shape[1:] != mine.shape, "or the resampling would not be tested"
    expected = torch.nn.functional.interpolate(raw[:, None], size=(30, 40), mode="bilinear")[0, 0].numpy()
    np.testing.assert_allclose(mine, expected, rtol=1e-5, atol=1e-6)


def test_the_caller_may_say_what_the_values_mean(flat_scene: Callable[..., Scene], tmp_path: Path) -> None:
    scene = flat_scene()
    provider = TransformersDepth(str(save_dpt(tmp_path / "network")), kind="metric")
    assert provider.predict(scene, scene.frames[0]).kind == "metric"


def test_weights_that_are_not_there_are_named_with_what_mends_it(tmp_path: Path) -> None:
    with pytest.raises(WeightsMissingError) as missing:
        TransformersDepth()
    message = str(missing.value)
    assert message.startswith("Weights missing: no 'Intel/dpt-large' as safetensors")
    assert "cache (no download was asked)" in message
    assert "Run: hf download Intel/dpt-large, or set download, or set weights to a folder" in message
    assert isinstance(missing.value, MissingDependencyError)
    with pytest.raises(WeightsMissingError, match="there is no folder '.*nowhere'.*hf download Intel/dpt-large"):
        TransformersDepth(str(tmp_path / "nowhere"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(WeightsMissingError, match=r"no config\.json, no preprocessor_config\.json, no model\.safe"):
        TransformersDepth(str(tmp_path / "empty"))


def test_a_name_on_the_hub_is_taken_from_the_cache_without_a_network(
    flat_scene: Callable[..., Scene], tmp_path: Path
) -> None:
    cached = tmp_path / "hub" / "models--somebody--tiny-dpt"
    folder = save_dpt(cached / "snapshots" / ("0" * 40))
    (cached / "refs").mkdir()
    (cached / "refs" / "main").write_text("0" * 40)
    scene = flat_scene()
    by_name, by_folder = TransformersDepth("somebody/tiny-dpt"), TransformersDepth(str(folder))
    assert by_name.name == "dpt somebody/tiny-dpt"
    np.testing.assert_array_equal(
        by_name.predict(scene, scene.frames[0]).values, by_folder.predict(scene, scene.frames[0]).values
    )


def test_pickled_weights_are_not_read(tmp_path: Path) -> None:
    folder = save_dpt(tmp_path / "network")
    (folder / "model.safetensors").rename(folder / "pytorch_model.bin")
    with pytest.raises(WeightsMissingError, match=r"found no model\.safetensors"):
        TransformersDepth(str(folder))


def test_code_beside_the_weights_is_not_run(tmp_path: Path) -> None:
    folder = save_dpt(tmp_path / "network")
    config = json.loads((folder / "config.json").read_text())
    config |= {"model_type": "my_own", "auto_map": {"AutoConfig": "code.Config"}}
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "code.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\nclass Config: pass\n")
    with pytest.raises(DataError, match="cannot be loaded"):
        TransformersDepth(str(folder))
    assert not (tmp_path / "ran").exists()


def test_a_network_without_some_weights_is_refused_but_for_the_branch_that_is_never_run(
    flat_scene: Callable[..., Scene], tmp_path: Path
) -> None:
    scene = flat_scene()
    folder = save_dpt(tmp_path / "network")
    whole = TransformersDepth(str(folder)).predict(scene, scene.frames[0]).values

    def drop(start: str) -> Callable[[dict[str, Any]], None]:
        def change(tensors: dict[str, Any]) -> None:
            names = [name for name in tensors if name.startswith(start)]
            assert names
            for name in names:
                del tensors[name]

        return change

    # As in the published Intel/dpt-large.
    rewrite(folder, drop("neck.fusion_stage.layers.0.residual_layer1."))
    published = TransformersDepth(str(folder)).predict(scene, scene.frames[0]).values
    np.testing.assert_array_equal(published, whole)
    rewrite(folder, drop("neck.fusion_stage.layers.1.residual_layer1."))
    with pytest.raises(DataError, match="does not hold all weights.*4 missing: neck"):
        TransformersDepth(str(folder))


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    folder = save_dpt(tmp_path / "network")
    whole = (folder / "model.safetensors").read_bytes()
    (folder / "model.safetensors").write_bytes(whole[:1000])
    with pytest.raises(DataError, match="cannot be loaded.*Get its files again"):
        TransformersDepth(str(folder))
    (folder / "model.safetensors").write_bytes(whole)
    (folder / "config.json").write_text("{")
    with pytest.raises(DataError, match="cannot be loaded"):
        TransformersDepth(str(folder))


def test_weights_of_another_shape_are_refused(tmp_path: Path) -> None:
    folder = save_dpt(tmp_path / "network")
    rewrite(folder, lambda tensors: tensors.update({"head.head.0.bias": tensors["head.head.0.bias"][:-1].clone()}))
    with pytest.raises(DataError, match=r"network in .* cannot be loaded.*Get its files again"):
        TransformersDepth(str(folder))


def test_weights_that_give_nan_are_refused(flat_scene: Callable[..., Scene], tmp_path: Path) -> None:
    folder = save_dpt(tmp_path / "network")
    rewrite(folder, lambda tensors: tensors["head.head.0.bias"].fill_(float("nan")))
    scene = flat_scene()
    with pytest.raises(DataError, match=r"gave no depth for frame 'oblique.png'.*1200 that are not.*Check"):
        TransformersDepth(str(folder)).predict(scene, scene.frames[0])


def test_another_network_is_refused(tmp_path: Path) -> None:
    folder = save_dpt(tmp_path / "network")
    transformers.ViTConfig().save_pretrained(folder)
    with pytest.raises(CapabilityError, match="expected DPT or Depth Anything; found a model of type 'vit'"):
        TransformersDepth(str(folder))


def test_a_gpu_that_is_not_there_is_an_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(CapabilityError, match="on 'cuda'; expected a CUDA GPU.*Choose device=cpu"):
        TransformersDepth(str(save_dpt(tmp_path / "network")), device="cuda")
