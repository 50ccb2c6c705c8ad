"""The figure of a mask covers what is masked, and nothing else."""

from __future__ import annotations

import base64
import io
import json

import numpy as np
import plotly.graph_objects as go
import pytest
from PIL import Image

from toolkit.errors import DataError
from toolkit.plots.masks import mask_figure

HEIGHT, WIDTH = 48, 64
FRAME = np.full((HEIGHT, WIDTH, 3), 100, dtype=np.uint8)


def masked() -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    mask[:, :16] = True
    return mask


def pixels(image: go.Image) -> np.ndarray:
    data = base64.b64decode(image.source.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)


def test_the_mask_covers_the_frame_where_it_is_true() -> None:
    undecided = np.zeros((HEIGHT, WIDTH), dtype=bool)
    undecided[:24, :32] = True
    figure = mask_figure(FRAME, masked(), undecided=undecided, name="frame_000012.jpg")
    (image,) = figure.data
    drawn = pixels(image)
    # JPEG blurs edges between colours by some pixels.
    orange, blue, bare = drawn[8:40, 4:12], drawn[4:20, 20:28], drawn[32:44, 36:60]
    assert (orange[..., 0] > orange[..., 2] + 60).all()
    assert (blue[..., 2] > blue[..., 0] + 60).all()
    assert np.abs(bare - 100).max() <= 3
    assert figure.layout.title.text == "frame_000012.jpg · 25.0 % left out, 12.5 % undecided"
    assert (image.x0, image.y0, image.dx, image.dy) == (0.5, 0.5, 1, 1)
    json.dumps(figure.to_plotly_json(), default=lambda array: array.tolist())


def test_statistics_stand_beside_it() -> None:
    ramp = np.tile(np.linspace(0, 255, WIDTH), (HEIGHT, 1))
    figure = mask_figure(FRAME / 255.0, masked(), mean=ramp, deviation=ramp / 10)
    assert [note.text for note in figure.layout.annotations] == [
        "mask over the frame",
        "mean over time",
        "deviation over time",
    ]
    mean, deviation = pixels(figure.data[1]), pixels(figure.data[2])
    assert np.abs(mean[24, :, 0] - ramp[24]).max() < 6
    # The deviation fills the range of grey whatever its size.
    assert np.abs(deviation[24, :, 0] - ramp[24]).max() < 10
    assert figure.layout.title.text == "25.0 % left out"


@pytest.mark.parametrize("what", ["mask", "undecided", "mean", "deviation"])
def test_arrays_of_another_size_are_refused(what: str) -> None:
    given = {"masked": masked(), what if what != "mask" else "masked": masked().T}
    with pytest.raises(
        DataError, match=rf"Frame and {what} have different sizes; expected \(48, 64\); found \(64, 48\)"
    ):
        mask_figure(FRAME, **given)
