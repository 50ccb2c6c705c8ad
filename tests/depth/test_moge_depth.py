"""The adapter to MoGe, against a stand-in with the calls that its repository documents."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from toolkit.depth.moge_depth import MogeDepth
from toolkit.errors import DataError, MissingDependencyError, WeightsMissingError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.scene import Scene


class StandIn:
    """Depth of the picture's own red channel, infinite in the first row, as the masked sky of MoGe."""

    asked: SimpleNamespace

    def __init__(self) -> None:
        type(self).asked = SimpleNamespace()

    @classmethod
    def from_pretrained(cls, place: str, **options: Any) -> StandIn:
        if not Path(place).is_file():
            raise FileNotFoundError(f"{place} is not in the cache ({options})")
        torch.load(place, weights_only=True)
        made = cls()
        made.asked.place, made.asked.options = place, options
        return made

    def to(self, device: str) -> StandIn:
        self.asked.device = device
        return self

    def eval(self) -> StandIn:
        return self

    def infer(self, image: torch.Tensor, **options: Any) -> dict[str, torch.Tensor]:
        assert image.shape[0] == 3
        assert image.max() <= 1
        self.asked.infer = options
        depth = image[0] + 1
        depth[0] = torch.inf
        return {"depth": depth}


@pytest.fixture
def moge(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put the stand-in where the package would be."""

    class Metric(StandIn):
        scale_head = True

    for name, model in (("v1", StandIn), ("v2", Metric)):
        module = ModuleType(f"moge.model.{name}")
        module.MoGeModel = model
        monkeypatch.setitem(sys.modules, module.__name__, module)
    for name in ("moge", "moge.model"):
        package = ModuleType(name)
        package.__path__ = []
        monkeypatch.setitem(sys.modules, name, package)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    torch.save({}, tmp_path / "model.pt")
    return tmp_path / "model.pt"


@pytest.mark.usefixtures("moge")
@pytest.mark.parametrize(("version", "kind"), [("v1", "affine-depth"), ("v2", "metric")])
def test_the_answer_becomes_a_prediction(
    flat_scene: Callable[..., Scene], weights: Path, version: str, kind: str
) -> None:
    scene = flat_scene()
    provider = MogeDepth(str(weights.parent), version=version)
    prediction = provider.predict(scene, scene.frames[0])
    assert provider.name == f"moge-{version} {weights.parent}"
    assert prediction.kind == kind
    assert np.isnan(prediction.values[0]).all(), "what MoGe masks has no depth"
    assert np.isfinite(prediction.values[1:]).all()
    # 40 pixels wide with a focal length of 20: 90 degrees.
    asked = provider._model.asked
    assert asked.infer["fov_x"] == pytest.approx(90.0)
    assert asked.infer["use_fp16"] is False
    assert (asked.place, asked.options, asked.device) == (str(weights), {}, "cpu")


@pytest.mark.usefixtures("moge")
def test_a_camera_with_distortion_has_no_field_of_view_to_tell(
    flat_scene: Callable[..., Scene], weights: Path
) -> None:
    scene = flat_scene()
    scene = scene.replace(cameras={1: ColmapCamera("SIMPLE_RADIAL", 40, 30, (20, 20, 15, 0.01))})
    provider = MogeDepth(str(weights))
    provider.predict(scene, scene.frames[0])
    assert provider._model.asked.infer["fov_x"] is None


@pytest.mark.usefixtures("moge")
def test_missing_and_damaged_weights_are_told(tmp_path: Path) -> None:
    with pytest.raises(WeightsMissingError) as missing:
        MogeDepth()
    message = str(missing.value)
    assert message.startswith("Weights missing: no 'Ruicheng/moge-2-vitl'")
    assert "'local_files_only': True" in message
    assert "Run: hf download Ruicheng/moge-2-vitl model.pt, or set download, or set weights" in message
    with pytest.raises(WeightsMissingError, match=r"no .*model\.pt.*hf download Ruicheng/moge-vitl "):
        MogeDepth(str(tmp_path), version="v1")
    (tmp_path / "model.pt").write_bytes(b"nothing")
    with pytest.raises(DataError, match=r"model\.pt holds no weights of MoGe v2.*Check moge_version"):
        MogeDepth(str(tmp_path))


def test_without_the_package_the_message_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "moge", None)
    with pytest.raises(MissingDependencyError, match=r"'moge'.*pip install git\+https"):
        MogeDepth()


def test_a_package_without_the_version_is_told(monkeypatch: pytest.MonkeyPatch, moge: None) -> None:
    monkeypatch.setitem(sys.modules, "moge.model.v2", None)
    with pytest.raises(MissingDependencyError, match="no usable model of version v2.*Install it anew"):
        MogeDepth()


@pytest.mark.usefixtures("moge")
def test_depth_of_another_size_is_refused(
    flat_scene: Callable[..., Scene], weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = flat_scene()
    provider = MogeDepth(str(weights))
    monkeypatch.setattr(provider._model, "infer", lambda *_, **__: {"depth": torch.ones(3, 4)})
    with pytest.raises(DataError, match=r"depth of another size for frame 'oblique.png'.*\(3, 4\)"):
        provider.predict(scene, scene.frames[0])
