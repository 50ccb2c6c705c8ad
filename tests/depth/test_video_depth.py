"""The adapter to Video Depth Anything, against a stand-in for the calls in its run.py and weights."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from toolkit.depth.providers import depth_provider
from toolkit.depth.settings import DepthSettings
from toolkit.depth.video_depth import INPUT_SIZE, VideoDepth
from toolkit.errors import DataError, MissingDependencyError, SettingsError, StageError, WeightsMissingError
from toolkit.scene import Scene

FILE = "video_depth_anything_vits.pth"


class StandIn(torch.nn.Module):
    """A tiny network: one weight for each colour; it adds the number of the frame, so that the order shows."""

    asked: list[tuple[tuple[int, ...], dict[str, Any]]]

    def __init__(self, encoder: str, features: int, out_channels: list[int], metric: bool = False) -> None:
        super().__init__()
        self.mix = torch.nn.Linear(3, 1)
        self.built_with = (encoder, features, out_channels, metric)
        self.asked = []

    def infer_video_depth(
        self,
        frames: NDArray[np.uint8],
        target_fps: float,
        input_size: int = 518,
        device: str = "",
        fp32: bool = False,
    ) -> tuple[NDArray[np.float32], float]:
        self.asked.append((frames.shape, {"input_size": input_size, "device": device, "fp32": fp32}))
        with torch.no_grad():
            depth = self.mix(torch.from_numpy(frames).float() / 255)[..., 0].numpy()
        return depth + np.arange(len(frames), dtype=np.float32)[:, None, None], target_fps


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Put the stand-in where the package would be."""
    top, module = ModuleType("video_depth_anything"), ModuleType("video_depth_anything.video_depth")
    top.__path__ = []
    module.VideoDepthAnything = StandIn
    monkeypatch.setitem(sys.modules, top.__name__, top)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return module


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """Random weights of the tiny network under a published name."""
    torch.manual_seed(0)
    torch.save(StandIn("vits", 1, []).state_dict(), tmp_path / FILE)
    return tmp_path / FILE


@pytest.mark.usefixtures("package")
@pytest.mark.parametrize(("name", "kind"), [(FILE, "affine-disparity"), ("metric_" + FILE, "metric")])
def test_all_frames_of_a_split_are_looked_at_together_once(
    flat_scene: Callable[..., Scene], weights: Path, name: str, kind: str
) -> None:
    weights.rename(weights.with_name(name))
    scene = flat_scene()
    provider = VideoDepth(str(weights.parent))
    predictions = [provider.predict(scene, frame) for frame in scene.frames]
    assert provider.name == f"video-depth-anything {weights.parent}"
    assert [prediction.kind for prediction in predictions] == [kind, kind]
    assert provider._model.built_with == ("vits", 64, [48, 96, 192, 384], kind == "metric")
    assert provider._model.asked == [((2, 30, 40, 3), {"input_size": INPUT_SIZE, "device": "cpu", "fp32": True})]
    # The network's own weights on the picture's own colours, and the frame's number: float32 on both sides.
    state = torch.load(weights.with_name(name), weights_only=True)
    for number, prediction in enumerate(predictions):
        colours = np.asarray(_picture(scene, number), dtype=np.float32) / 255
        expected = colours @ state["mix.weight"].numpy()[0] + state["mix.bias"].item() + number
        np.testing.assert_allclose(prediction.values, expected, atol=1e-5)


def _picture(scene: Scene, number: int) -> NDArray[np.uint8]:
    from toolkit.scene.pictures import load_picture

    return load_picture(scene.image_path(scene.frames[number]))


@pytest.mark.usefixtures("package")
def test_training_frames_are_never_looked_at_together_with_test_frames(
    flat_scene: Callable[..., Scene], weights: Path
) -> None:
    scene = flat_scene()
    first, second = scene.frames
    scene = scene.replace(frames=(replace(first, split="test"), second))
    provider = VideoDepth(str(weights))
    provider.predict(scene, scene.frames[1])
    assert [shape[0] for shape, _ in provider._model.asked] == [1]


@pytest.mark.usefixtures("package")
def test_large_pictures_are_shrunk_for_the_network_and_the_answer_is_of_their_size(
    flat_scene: Callable[..., Scene], weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("toolkit.depth.video_depth.INPUT_SIZE", 15)
    scene = flat_scene()
    provider = VideoDepth(str(weights))
    assert provider.predict(scene, scene.frames[0]).values.shape == (30, 40)
    assert provider._model.asked[0][0] == (2, 15, 20, 3)


@pytest.mark.usefixtures("package")
def test_missing_and_damaged_weights_are_told(tmp_path: Path, weights: Path) -> None:
    with pytest.raises(
        WeightsMissingError, match=r"no 'depth-anything/Video-Depth-Anything-Small'.*run: hf download"
    ):
        VideoDepth()
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(WeightsMissingError, match=r"does not hold one network.*found none"):
        VideoDepth(str(empty))
    with pytest.raises(WeightsMissingError, match="no file or folder 'nowhere'"):
        VideoDepth("nowhere")
    renamed = weights.rename(tmp_path / "best.pth")
    with pytest.raises(DataError, match=r"best\.pth does not say which network"):
        VideoDepth(str(renamed))
    weights.write_bytes(b"nothing")
    with pytest.raises(DataError, match=rf"{FILE} holds no weights of Video Depth Anything \(vits\)"):
        VideoDepth(str(weights))
    torch.save({"other": torch.zeros(1)}, weights)
    with pytest.raises(DataError, match=r"holds no weights.*mix\.weight"):
        VideoDepth(str(weights))


def test_without_the_package_the_message_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "video_depth_anything", None)
    with pytest.raises(MissingDependencyError, match=r"'video_depth_anything'.*git clone.*PYTHONPATH"):
        VideoDepth()


def test_an_old_version_of_the_package_is_told(
    package: ModuleType, weights: Path, flat_scene: Callable[..., Scene], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = flat_scene()
    provider = VideoDepth(str(weights))
    monkeypatch.setattr(provider._model, "infer_video_depth", lambda frames, target_fps: None)
    with pytest.raises(MissingDependencyError, match=r"cannot be used.*input_size.*present version"):
        provider.predict(scene, scene.frames[0])
    package.VideoDepthAnything = lambda encoder, features, out_channels: None
    with pytest.raises(MissingDependencyError, match=r"cannot be used.*metric"):
        VideoDepth(str(weights))


@pytest.mark.usefixtures("package")
@pytest.mark.parametrize(
    ("answer", "error", "message"),
    [
        (np.ones((2, 3, 4), np.float32), DataError, r"depth of another size.*\(2, 30, 40\).*\(2, 3, 4\)"),
        (np.full((2, 30, 40), np.nan, np.float32), StageError, "not finite.*found 2400"),
    ],
)
def test_answers_that_cannot_be_are_refused(
    flat_scene: Callable[..., Scene],
    weights: Path,
    monkeypatch: pytest.MonkeyPatch,
    answer: NDArray[np.float32],
    error: type[Exception],
    message: str,
) -> None:
    scene = flat_scene()
    provider = VideoDepth(str(weights))
    monkeypatch.setattr(provider._model, "infer_video_depth", lambda *_, **__: (answer, 1))
    with pytest.raises(error, match=message):
        provider.predict(scene, scene.frames[0])


@pytest.mark.usefixtures("package")
def test_the_settings_lead_to_it(weights: Path) -> None:
    settings = DepthSettings().replace({"provider": "video", "weights": str(weights)})
    assert isinstance(depth_provider(settings), VideoDepth)
    with pytest.raises(SettingsError, match="'video' says itself what its values are"):
        depth_provider(settings.replace({"kind": "metric"}))
