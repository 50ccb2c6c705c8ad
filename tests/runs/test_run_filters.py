"""Words and conditions choose runs; what cannot be understood is said."""

from __future__ import annotations

from pathlib import Path

import pytest

from toolkit.errors import RunError
from toolkit.runs.filters import RunFilter, number_names, parse_filter, row_value
from toolkit.runs.folder import RunFolder
from toolkit.runs.index import RunSummary


def row(number: int, **fields: object) -> RunSummary:
    given: dict[str, object] = {"state": "finished", "recipe": "fake", **fields}
    return RunSummary(RunFolder(Path(f"runs/20260101-00000{number}-fake-0000")), **given)


ROWS = [
    row(
        0, name="Garden", metrics={"test.psnr": 24.0, "test.ssim": 0.7}, settings={"train.steps": 300, "kind": "3d"}
    ),
    row(1, name="garden two", metrics={"test.psnr": 28.5, "test.ssim": None}, settings={"train.steps": 3000}),
    row(2, state="failed", error="No overlap between pictures", data="/data/roof", tags=("odd", "keep")),
    row(3, state="finished", recipe="other", note="a note about <b>", settings={"flag": True}),
]


def kept(text: str, **options: str) -> list[int]:
    wanted = parse_filter(text, number_names(ROWS), **options)
    return [i for i, each in enumerate(ROWS) if wanted.keeps(each)]


@pytest.mark.parametrize(
    ("text", "places"),
    [
        ("", [0, 1, 2, 3]),
        ("GARDEN", [0, 1]),
        ("garden two", [1]),
        ("two garden", [1]),
        ("overlap", [2]),
        ("roof", [2]),
        ("keep", [2]),
        ("<b>", [3]),
        ("000003-fake", [3]),
        ("psnr>25", [1]),
        ("test.psnr>=24", [0, 1]),
        ("psnr<28.5", [0]),
        ("psnr=28,5", [1]),
        ("steps<=300 psnr>0", [0]),
        ("ssim>0", [0]),  # a measure that was not finite is no number
        ("garden train.steps>300", [1]),
        ("psnr>25 psnr<26", []),
    ],
)
def test_words_and_conditions_all_hold(text: str, places: list[int]) -> None:
    assert kept(text) == places


def test_state_recipe_and_tag_are_exact() -> None:
    assert kept("", state="failed") == [2]
    assert kept("", recipe="other") == [3]
    assert kept("", tag="odd") == [2]
    assert kept("", tag="od") == []
    assert kept("garden", state="failed") == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nothing>1", "No run has a measure or setting 'nothing'; expected a name such as test.psnr"),
        ("flag>1", "No run has a measure or setting 'flag'"),
        ("psnr>", "'psnr>' is no condition; expected a number after the sign, such as psnr>25; found ''"),
        ("psnr>x", "is no condition"),
        ("x" * 301, "The filter is too long; expected at most 300 characters; found 301"),
    ],
)
def test_what_cannot_be_understood_is_said(text: str, message: str) -> None:
    with pytest.raises(RunError, match=message):
        parse_filter(text, number_names(ROWS))


def test_an_ending_that_fits_several_is_refused() -> None:
    rows = [row(0, metrics={"test.psnr": 1.0, "test_refined.psnr": 2.0})]
    with pytest.raises(RunError, match=r"'psnr' fits several measures; .*found test.psnr, test_refined.psnr"):
        parse_filter("psnr>0", number_names(rows))
    assert parse_filter("test.psnr>0", number_names(rows)).keeps(rows[0])


def test_words_are_no_patterns() -> None:
    assert kept(".*") == []
    assert kept("(") == []


def test_names_of_numbers_and_values() -> None:
    assert number_names(ROWS) == ["test.psnr", "test.ssim", "train.steps"]
    assert row_value(ROWS[0], "kind") == "3d"
    assert row_value(ROWS[0], "test.psnr") == 24.0
    assert row_value(ROWS[2], "test.psnr") is None
    assert RunFilter().keeps(ROWS[0])
