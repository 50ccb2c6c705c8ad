"""Cards of test pictures: the error map says what its scale promises."""

from __future__ import annotations

import base64
import io
import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from fake_recipe import MakeRun
from PIL import Image

from toolkit.runs.compare import compare_runs
from toolkit.runs.report_html import run_dots
from toolkit.runs.report_views import ERROR_SCALE, PictureBook, error_picture, view_card, views_by_name


def plain(level: int, size: tuple[int, int] = (4, 3)) -> Image.Image:
    return Image.new("RGB", size, (level, level, level))


@pytest.mark.parametrize(
    ("error", "colour"),
    [(0, (0, 0, 0)), (16, (74, 24, 110)), (32, (190, 55, 84)), (64, (255, 255, 240)), (200, (255, 255, 240))],
)
def test_an_error_has_the_colour_of_its_level(error: int, colour: tuple[int, int, int]) -> None:
    for first, second in ((plain(0), plain(error)), (plain(error), plain(0))):
        pixels = np.asarray(error_picture(first, second))
        assert pixels.shape == (3, 4, 3)
        assert (pixels == colour).all()


def test_larger_errors_are_brighter() -> None:
    levels = [np.asarray(error_picture(plain(0), plain(level)), int).sum() for level in range(65)]
    assert all(after >= before for before, after in itertools.pairwise(levels))


def test_channels_count_by_their_mean() -> None:
    red = Image.new("RGB", (2, 2), (48, 0, 0))
    assert (np.asarray(error_picture(plain(0, (2, 2)), red)) == (74, 24, 110)).all()  # a third of 48 is 16


def test_pictures_of_different_sizes_are_compared_in_the_size_of_the_render(tmp_path: Path) -> None:
    plain(10, (40, 30)).save(tmp_path / "photo.png")
    plain(10, (20, 15)).save(tmp_path / "render.png")
    made = PictureBook(720).errors(tmp_path / "photo.png", tmp_path / "render.png", "error")
    assert made is not None
    source = re.search(r'src="data:image/jpeg;base64,([^"]+)"', made)
    assert source
    assert Image.open(io.BytesIO(base64.b64decode(source[1]))).size == (20, 15)
    (tmp_path / "render.png").write_bytes(b"no picture")
    assert PictureBook(720).errors(tmp_path / "photo.png", tmp_path / "render.png", "error") is None


def test_a_card_has_error_maps_where_they_are_asked_for(finished: MakeRun) -> None:
    runs = compare_runs([finished(name="a"), finished(name="b")]).runs
    found = views_by_name(runs)

    def card(**options: bool) -> str:
        return view_card(runs, found, found.names[0], run_dots(2), PictureBook(720), mark_best=True, **options)

    with_errors = card(errors=True)
    assert with_errors.count('class="error"') + with_errors.count("data-same") >= 2
    assert ERROR_SCALE in with_errors
    assert 'class="error"' not in card()
    assert ERROR_SCALE not in card()
