"""LPIPS, the learned perceptual distance of two pictures (Zhang et al. 2018), from weights that were checked.

The linear weights come with torchmetrics. The backbone's (AlexNet, VGG or SqueezeNet, trained on ImageNet) are a
file that torchvision publishes; its name ends in the first digits of its SHA-256, and only a file that keeps this
promise is read. Without it there is no number.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import CapabilityError, DataError, MissingDependencyError
from toolkit.metrics.image import checked_picture
from toolkit.progress import Progress, ProgressEvent, silent

if TYPE_CHECKING:
    import torch

    from toolkit.metrics.image import Image

Net = Literal["alex", "vgg", "squeeze"]

ENVIRONMENT = "TOOLKIT_LPIPS_WEIGHTS"
HUB = "https://download.pytorch.org/models/"
SMALLEST_SIDE = 32


@dataclass(frozen=True, slots=True)
class Backbone:
    """A network whose features LPIPS compares.

    Attributes
    ----------
    model:
        Its name in torchvision.
    file:
        Name of its weights as torchvision publishes them.
    layers:
        After which of the model's feature layers the features are taken.
    """

    model: str
    file: str
    layers: tuple[int, ...]


#: Layers as in Zhang et al. 2018: after each ReLU before a pooling (AlexNet, VGG), after the fire modules
#: (SqueezeNet); the last ones are also where the network may be cut.
BACKBONES: Mapping[Net, Backbone] = {
    "alex": Backbone("alexnet", "alexnet-owt-7be5be79.pth", (1, 4, 7, 9, 11)),
    "vgg": Backbone("vgg16", "vgg16-397923af.pth", (3, 8, 15, 22, 29)),
    "squeeze": Backbone("squeezenet1_1", "squeezenet1_1-b8a52dc0.pth", (1, 4, 7, 9, 10, 11, 12)),
}


class Lpips:
    """LPIPS version 0.1 with one backbone.

    Attributes
    ----------
    name:
        ``"lpips_alex"`` and so on, as a measure is to be recorded: numbers of different backbones do not compare.
        With a backbone file that is not torchvision's own the name ends in that file's hash.
    available:
        Whether there are weights.
    reason:
        Why there are none and what mends it; empty where there are.

    Parameters
    ----------
    net:
        Backbone.
    weights:
        The backbone's file, named ``<model>-<first 8 digits of its SHA-256>.pth``, or a folder with torchvision's
        file. Where left out, the file or folder in ``TOOLKIT_LPIPS_WEIGHTS``, then torch's own folder
        (``$TORCH_HOME/hub/checkpoints``).
    download:
        Fetch a missing file from torchvision's server into torch's own folder. Never done unasked.
    device:
        Where to compute.
    progress:
        Told of the download.

    Raises
    ------
    DataError
        For a file whose content is not what its name says, or no weights of this backbone.
    MissingDependencyError
        Where the download that was asked for fails.
    """

    def __init__(
        self,
        net: Net = "alex",
        weights: Path | None = None,
        *,
        download: bool = False,
        device: str = "cpu",
        progress: Progress = silent,
    ) -> None:
        if net not in BACKBONES:
            raise CapabilityError(f"No LPIPS with '{net}'", expected=", ".join(BACKBONES), found=net)
        self._device = device
        self.name = f"lpips_{net}"
        self.reason = ""
        self._layers: list[torch.nn.Module] = []
        self._linear: list[torch.Tensor] = []
        path = find_weights(net, weights)
        if path is None and download:
            path = _download(BACKBONES[net].file, progress)
        if path is None:
            self.reason = _how_to_mend(net, weights)
            return
        if path.name != BACKBONES[net].file:
            self.name += f"-{_promised_hash(path, net)}"
        self._layers = _load_backbone(net, path, device)
        self._linear = _load_linear(net, device)

    @property
    def available(self) -> bool:
        """Whether there are weights, and so numbers."""
        return bool(self._layers)

    def __call__(self, a: Image, b: Image) -> float | None:
        """Return the distance of two pictures (H, W, 3) in 0..1, at least 32x32; None without weights.

        Values are stretched to -1..1 first, as the authors' network expects.

        Raises
        ------
        DataError
            For shapes that differ or are too small, and values that are no fractions in 0..1.
        """
        first, second = checked_picture(a), checked_picture(b)
        if first.shape != second.shape or min(first.shape[:2]) < SMALLEST_SIDE:
            raise DataError(
                "LPIPS cannot compare these pictures",
                expected=f"two of the same size, at least {SMALLEST_SIDE}x{SMALLEST_SIDE}",
                found=f"{first.shape} and {second.shape}",
            )
        if not self.available:
            return None
        import torch

        # Layer by layer: all of VGG's features of a large picture together fill a gigabyte.
        with torch.inference_mode():
            return sum(
                float((((x - y) ** 2) * weight).sum(dim=1).mean(dtype=torch.float64))
                for x, y, weight in zip(self._features(first), self._features(second), self._linear, strict=True)
            )

    def _features(self, picture: NDArray[np.float64]) -> Iterator[torch.Tensor]:
        """Yield features (1, C, H', W') of each layer group, of unit length along C."""
        import torch

        pixels = torch.from_numpy(picture).to(self._device, torch.float32).permute(2, 0, 1)[None]
        # Mean and deviation of ImageNet in -1..1, rounded as the authors published them.
        shift = pixels.new_tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)
        scale = pixels.new_tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)
        activations = (2 * pixels - 1 - shift) / scale
        for layer in self._layers:
            activations = layer(activations)
            length = torch.sqrt(1e-8 + (activations**2).sum(dim=1, keepdim=True))
            yield activations / length


def lpips_available(net: Net = "alex", weights: Path | None = None) -> bool:
    """Whether there is a file of the backbone's weights, with ``weights`` as :class:`Lpips` takes it."""
    return find_weights(net, weights) is not None


def find_weights(net: Net, weights: Path | None = None) -> Path | None:
    """Return the backbone's file, or None where there is none. Its content is checked when it is loaded."""
    name = BACKBONES[net].file
    for place in _places(weights):
        path = place / name if place.is_dir() else place
        if path.is_file():
            return path
    return None


def _places(weights: Path | None) -> list[Path]:
    """Return where to look: only where the caller said, if he did."""
    if weights is not None:
        return [weights]
    from torch import hub

    named = os.environ.get(ENVIRONMENT)
    return [*([Path(named)] if named else []), Path(hub.get_dir()) / "checkpoints"]


def _how_to_mend(net: Net, weights: Path | None) -> str:
    name = BACKBONES[net].file
    looked = ", ".join(str(place) for place in _places(weights))
    return (
        f"LPIPS ({net}) is not available: no {name} in {looked}. Get {HUB}{name} and put it there, name its folder "
        f"in {ENVIRONMENT}, or ask for the download (Lpips('{net}', download=True))."
    )


def _download(name: str, progress: Progress) -> Path:
    """Fetch a file from torchvision's server into torch's folder and return its path."""
    from torch import hub

    path = Path(hub.get_dir()) / "checkpoints" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    progress(ProgressEvent("lpips.download", 0, 1, f"{HUB}{name}"))
    prefix = _HASH.fullmatch(name)
    assert prefix is not None
    try:
        hub.download_url_to_file(HUB + name, str(path), hash_prefix=prefix["hash"], progress=False)
    except (OSError, RuntimeError) as error:
        raise MissingDependencyError(
            f"Cannot download {HUB}{name}",
            found=str(error),
            todo=f"Put the file into {path.parent} by hand",
        ) from error
    progress(ProgressEvent("lpips.download", 1, 1))
    return path


_HASH = re.compile(r"(?P<model>.+)-(?P<hash>[0-9a-f]{8,64})\.pth")


def _promised_hash(path: Path, net: Net) -> str:
    """Return the digits of the SHA-256 in the file's name."""
    match = _HASH.fullmatch(path.name)
    if match is None:
        raise DataError(
            f"{path} does not say what it holds",
            expected=f"a name as {BACKBONES[net].file}, which ends in the first 8 digits of its SHA-256",
            found=path.name,
        )
    return match["hash"]


def _load_backbone(net: Net, path: Path, device: str) -> list[torch.nn.Module]:
    """Return the feature layers of the backbone in the groups that LPIPS compares, with the file's weights."""
    import torch
    import torchvision

    promised = _promised_hash(path, net)
    content = path.read_bytes()
    found = hashlib.sha256(content).hexdigest()
    if not found.startswith(promised):
        raise DataError(
            f"{path} is damaged or not what its name says",
            expected=f"a SHA-256 that starts with {promised}",
            found=found[: len(promised)],
            todo=f"Get it again from {HUB}{BACKBONES[net].file}",
        )
    # Without memory behind them, so that no random weights are drawn only to be replaced.
    with torch.device("meta"):
        features = getattr(torchvision.models, BACKBONES[net].model)(weights=None).features
    state = _read_state(content, path)
    mine = {key.removeprefix("features."): value for key, value in state.items() if key.startswith("features.")}
    try:
        features.load_state_dict(mine, strict=True, assign=True)
    except RuntimeError as error:
        raise DataError(
            f"{path} holds no weights of {BACKBONES[net].model}", found=" ".join(str(error).split())
        ) from error
    features = features.to(device, torch.float32).eval().requires_grad_(requires_grad=False)
    ends = [last + 1 for last in BACKBONES[net].layers]
    return [features[start:end] for start, end in zip([0, *ends], ends, strict=False)]


def _load_linear(net: Net, device: str) -> list[torch.Tensor]:
    """Return the weights (1, C, 1, 1) of each layer group's channels, version 0.1, from torchmetrics."""
    source = files("torchmetrics.functional.image").joinpath("lpips_models", f"{net}.pth")
    state = _read_state(source.read_bytes(), Path(str(source)))
    return [state[f"lin{i}.model.1.weight"].to(device) for i in range(len(BACKBONES[net].layers))]


def _read_state(content: bytes, path: Path) -> dict[str, torch.Tensor]:
    """Return the tensors of a weights file, of which nothing is run."""
    import pickle

    import torch

    try:
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, ValueError) as error:
        raise DataError(
            f"{path} is no file of weights", expected="a torch state dictionary", found=str(error)
        ) from error
    if not isinstance(state, dict) or not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise DataError(f"{path} is no file of weights", expected="a torch state dictionary of tensors")
    return state
