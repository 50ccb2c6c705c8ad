"""LPIPS: a number from checked weights, or none with the reason. The weights here are random: mechanics only."""

from __future__ import annotations

import hashlib
import io
import random
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torchvision

from toolkit.errors import CapabilityError, DataError, MissingDependencyError
from toolkit.metrics import lpips as module
from toolkit.metrics.lpips import BACKBONES, Lpips, find_weights, lpips_available
from toolkit.progress import ProgressEvent

Picture = np.ndarray[Any, np.dtype[np.float32]]


@pytest.fixture(autouse=True)
def _nothing_of_this_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TOOLKIT_LPIPS_WEIGHTS", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))


def _save(folder: Path, content: bytes) -> Path:
    """Write a file under the name that its hash promises."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"squeezenet1_1-{hashlib.sha256(content).hexdigest()[:8]}.pth"
    path.write_bytes(content)
    return path


def _pickled(value: Any) -> bytes:
    buffer = io.BytesIO()
    torch.save(value, buffer)
    return buffer.getvalue()


@pytest.fixture(scope="module")
def state() -> dict[str, torch.Tensor]:
    """Weights of a SqueezeNet, random but with enough spread that all layers answer."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return torchvision.models.squeezenet1_1(weights=None).state_dict()


@pytest.fixture(scope="module")
def weights(state: dict[str, torch.Tensor], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _save(tmp_path_factory.mktemp("weights"), _pickled(state))


@pytest.fixture(scope="module")
def pictures() -> tuple[Picture, Picture]:
    rng = np.random.default_rng(0)
    a = rng.random((48, 64, 3), dtype=np.float32)
    return a, np.clip(a + rng.normal(scale=0.2, size=a.shape), 0, 1).astype(np.float32)


def _official(monkeypatch: pytest.MonkeyPatch, weights: Path) -> None:
    """Let the file at hand pass for the one that torchvision publishes."""
    backbone = BACKBONES["squeeze"]
    other = module.Backbone(backbone.model, weights.name, backbone.layers)
    monkeypatch.setattr(module, "BACKBONES", {**BACKBONES, "squeeze": other})


def test_file_names_are_those_of_torchvision() -> None:
    models = torchvision.models
    published = {
        "alex": models.AlexNet_Weights.DEFAULT,
        "vgg": models.VGG16_Weights.DEFAULT,
        "squeeze": models.SqueezeNet1_1_Weights.DEFAULT,
    }
    for net, of_torchvision in published.items():
        assert of_torchvision.url == module.HUB + BACKBONES[net].file


def test_checked_weights_give_a_repeatable_finite_distance(
    weights: Path, pictures: tuple[Picture, Picture]
) -> None:
    measure = Lpips("squeeze", weights)
    assert measure.available
    assert measure.reason == ""
    first = measure(*pictures)
    assert first is not None
    assert np.isfinite(first)
    assert first > 0
    assert measure(*pictures) == first
    assert Lpips("squeeze", weights)(*pictures) == first


def test_identical_pictures_have_no_distance(weights: Path, pictures: tuple[Picture, Picture]) -> None:
    assert Lpips("squeeze", weights)(pictures[0], pictures[0]) == 0.0


def test_distance_is_symmetric_and_grows_with_noise(weights: Path, pictures: tuple[Picture, Picture]) -> None:
    measure = Lpips("squeeze", weights)
    a, b = pictures
    half = (a + b) / 2
    assert measure(a, b) == pytest.approx(measure(b, a), rel=1e-6)
    distances = measure(a, half), measure(a, b)
    assert distances[0] is not None
    assert distances[1] is not None
    assert distances[0] < distances[1]


def test_torch_pictures_give_the_same_distance(weights: Path, pictures: tuple[Picture, Picture]) -> None:
    measure = Lpips("squeeze", weights)
    tensors = [torch.from_numpy(picture) for picture in pictures]
    assert measure(*tensors) == measure(*pictures)


@pytest.mark.parametrize("net", ["alex", "vgg", "squeeze"])
def test_distance_agrees_with_torchmetrics(
    net: Any, tmp_path: Path, pictures: tuple[Picture, Picture], monkeypatch: pytest.MonkeyPatch
) -> None:
    from torchmetrics.functional.image.lpips import learned_perceptual_image_patch_similarity

    model = BACKBONES[net].model
    # The feature layers alone: the classifier is most of AlexNet and VGG, and LPIPS does not use it.
    with torch.device("meta"):
        features = getattr(torchvision.models, model)(weights=None).features
    features.to_empty(device="cpu")
    generator = torch.Generator().manual_seed(1)
    for parameter in features.parameters():
        fan_in = parameter[0].numel()
        torch.nn.init.normal_(parameter, std=(2 / fan_in) ** 0.5, generator=generator)
    content = _pickled({f"features.{key}": value for key, value in features.state_dict().items()})
    path = tmp_path / f"{model}-{hashlib.sha256(content).hexdigest()[:8]}.pth"
    path.write_bytes(content)
    ours = Lpips(net, path)(*pictures)

    # torchmetrics asks torchvision for the pretrained network: hand it the same one.
    monkeypatch.setattr(torchvision.models, model, lambda weights: types.SimpleNamespace(features=features))
    x, y = (torch.from_numpy(picture).permute(2, 0, 1)[None] for picture in pictures)
    judge = learned_perceptual_image_patch_similarity(x, y, net_type=net, normalize=True)
    assert ours is not None
    assert ours > 0.001
    # Single precision in another order of sums.
    assert ours == pytest.approx(float(judge), abs=1e-6)


def test_name_says_the_net_and_a_file_that_is_not_the_published_one(
    weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    digits = weights.stem.removeprefix("squeezenet1_1-")
    assert Lpips("squeeze", weights).name == f"lpips_squeeze-{digits}"
    _official(monkeypatch, weights)
    assert Lpips("squeeze", weights).name == "lpips_squeeze"
    assert Lpips("alex").name == "lpips_alex"


def test_wrong_hash_is_refused(weights: Path, tmp_path: Path) -> None:
    path = tmp_path / "squeezenet1_1-b8a52dc0.pth"
    path.write_bytes(weights.read_bytes())
    with pytest.raises(DataError) as caught:
        Lpips("squeeze", path)
    found = weights.stem.removeprefix("squeezenet1_1-")
    assert str(caught.value) == (
        f"{path} is damaged or not what its name says; expected a SHA-256 that starts with b8a52dc0; found {found}"
        ". Get it again from https://download.pytorch.org/models/squeezenet1_1-b8a52dc0.pth."
    )


def test_file_whose_name_promises_nothing_is_refused(weights: Path, tmp_path: Path) -> None:
    path = tmp_path / "squeezenet.pth"
    path.write_bytes(weights.read_bytes())
    with pytest.raises(
        DataError, match=r"does not say what it holds; .* first 8 digits of its SHA-256; found squeezenet"
    ):
        Lpips("squeeze", path)


class _Malicious:
    """Pickles as a call of a function."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self._path,)


def test_file_that_would_run_code_is_refused_and_runs_none(tmp_path: Path) -> None:
    trace = tmp_path / "trace"
    path = _save(tmp_path, _pickled({"features.0.weight": _Malicious(trace)}))
    with pytest.raises(DataError, match="is no file of weights; expected a torch state dictionary"):
        Lpips("squeeze", path)
    assert not trace.exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is no file of weights"),
        (random.Random(0).randbytes(1000), "is no file of weights"),
        (_pickled([torch.zeros(3)]), "is no file of weights; expected a torch state dictionary of tensors"),
        (_pickled({"features.0.weight": 3}), "is no file of weights; expected a torch state dictionary of tensors"),
        (_pickled({}), "holds no weights of squeezenet1_1; found Error"),
        (_pickled({"features.0.weight": torch.zeros(3)}), "holds no weights of squeezenet1_1; found Error"),
    ],
)
def test_file_that_holds_no_weights_of_the_net_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = _save(tmp_path, content)
    with pytest.raises(DataError, match=message):
        Lpips("squeeze", path)


def test_weights_of_another_precision_are_taken(
    state: dict[str, torch.Tensor], tmp_path: Path, weights: Path, pictures: tuple[Picture, Picture]
) -> None:
    path = _save(tmp_path, _pickled({key: value.double() for key, value in state.items()}))
    assert Lpips("squeeze", path)(*pictures) == Lpips("squeeze", weights)(*pictures)


@pytest.mark.parametrize("net", ["alex", "vgg", "squeeze"])
def test_missing_weights_give_no_number_and_the_way_to_get_them(
    net: Any, tmp_path: Path, pictures: tuple[Picture, Picture]
) -> None:
    measure = Lpips(net)
    assert not lpips_available(net)
    assert not measure.available
    assert measure(*pictures) is None
    name = BACKBONES[net].file
    assert measure.name == f"lpips_{net}"
    assert measure.reason == (
        f"LPIPS ({net}) is not available: no {name} in {tmp_path / 'torch' / 'hub' / 'checkpoints'}. "
        f"Get https://download.pytorch.org/models/{name} and put it there, name its folder in TOOLKIT_LPIPS_WEIGHTS"
        f", or ask for the download (Lpips('{net}', download=True))."
    )


def test_missing_named_file_is_not_replaced_by_another(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _official(monkeypatch, weights)
    monkeypatch.setenv("TOOLKIT_LPIPS_WEIGHTS", str(weights.parent))
    assert lpips_available("squeeze")
    measure = Lpips("squeeze", tmp_path / "missing.pth")
    assert not measure.available
    assert f"in {tmp_path / 'missing.pth'}." in measure.reason


def test_weights_are_found_in_the_named_folder_then_in_torchs(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _official(monkeypatch, weights)
    assert not lpips_available("squeeze")
    checkpoints = tmp_path / "torch" / "hub" / "checkpoints"
    in_torch = _save(checkpoints, weights.read_bytes())
    assert find_weights("squeeze") == in_torch
    monkeypatch.setenv("TOOLKIT_LPIPS_WEIGHTS", str(tmp_path / "empty"))
    assert find_weights("squeeze") == in_torch
    monkeypatch.setenv("TOOLKIT_LPIPS_WEIGHTS", str(weights.parent))
    assert find_weights("squeeze") == weights
    monkeypatch.setenv("TOOLKIT_LPIPS_WEIGHTS", str(weights))
    assert find_weights("squeeze") == weights
    assert find_weights("squeeze", checkpoints) == in_torch
    assert Lpips("squeeze").available


def test_download_happens_only_when_asked_and_is_checked(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pictures: tuple[Picture, Picture]
) -> None:
    _official(monkeypatch, weights)
    monkeypatch.setattr(module, "HUB", weights.parent.as_uri() + "/")
    assert not Lpips("squeeze").available
    events: list[ProgressEvent] = []
    measure = Lpips("squeeze", download=True, progress=events.append)
    assert measure(*pictures) == Lpips("squeeze", weights)(*pictures)
    assert [(event.stage, event.done, event.total) for event in events] == [
        ("lpips.download", 0, 1),
        ("lpips.download", 1, 1),
    ]
    assert (tmp_path / "torch" / "hub" / "checkpoints" / weights.name).is_file()
    # Now it is there and is not fetched again.
    events.clear()
    assert Lpips("squeeze", download=True, progress=events.append).available
    assert events == []


def test_download_of_something_else_is_refused_and_leaves_no_file(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "server").mkdir()
    (tmp_path / "server" / "squeezenet1_1-b8a52dc0.pth").write_bytes(weights.read_bytes())
    monkeypatch.setattr(module, "HUB", (tmp_path / "server").as_uri() + "/")
    with pytest.raises(MissingDependencyError, match="Cannot download file:.*; found invalid hash value"):
        Lpips("squeeze", download=True)
    assert list((tmp_path / "torch" / "hub" / "checkpoints").iterdir()) == []


def test_download_that_fails_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "HUB", (tmp_path / "nowhere").as_uri() + "/")
    with pytest.raises(MissingDependencyError) as caught:
        Lpips("squeeze", download=True)
    assert str(caught.value).startswith(f"Cannot download {module.HUB}squeezenet1_1-b8a52dc0.pth; found ")
    assert str(caught.value).endswith(f"Put the file into {tmp_path / 'torch' / 'hub' / 'checkpoints'} by hand.")


def test_unknown_net_is_refused() -> None:
    with pytest.raises(CapabilityError, match="No LPIPS with 'resnet'; expected alex, vgg, squeeze; found resnet"):
        Lpips("resnet")


@pytest.mark.parametrize("with_weights", [True, False])
def test_unsound_pictures_are_refused_with_and_without_weights(weights: Path, with_weights: bool) -> None:
    measure = Lpips("squeeze", weights if with_weights else None)
    good = np.full((32, 32, 3), 0.5)
    with pytest.raises(
        DataError, match=r"LPIPS cannot compare these pictures; .* found \(32, 32, 3\) and \(32, 33, 3\)"
    ):
        measure(good, np.full((32, 33, 3), 0.5))
    with pytest.raises(DataError, match="two of the same size, at least 32x32"):
        measure(good[:31], good[:31])
    with pytest.raises(DataError, match="Picture has values out of range"):
        measure(good, good * 3)
    assert measure(good, good) == (0.0 if with_weights else None)


def test_making_the_measure_draws_no_random_numbers(weights: Path, pictures: tuple[Picture, Picture]) -> None:
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    Lpips("squeeze", weights)(*pictures)
    torch.testing.assert_close(torch.rand(3), expected, rtol=0, atol=0)
