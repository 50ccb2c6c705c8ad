"""The address says which runs and which picture, letter by letter."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.widgets.address import read_address, written_address


@given(st.lists(st.text("abc-_019", min_size=1), max_size=4, unique=True), st.text(max_size=30))
def test_what_is_written_is_read(ids: list[str], view: str) -> None:
    assert read_address(written_address("", ids, view)) == (ids, view)


def test_other_fields_stay_and_empty_ones_go() -> None:
    assert written_address("?theme=dark&runs=a&view=x.png", ["a", "b"], "") == "?theme=dark&runs=a,b"
    assert written_address("?runs=a", [], "") == ""


@pytest.mark.parametrize(
    ("search", "said"),
    [
        ("", ([], "")),
        ("?runs=0012,1e5&view=0001", (["0012", "1e5"], "0001")),
        ("?runs=a,,a, b ,", (["a", "b"], "")),
        ("?runs=[1]&view={", (["[1]"], "{")),
        ("?runs=../x&view=%2Fetc%2Fpasswd", (["../x"], "/etc/passwd")),
        ("?runs", ([], "")),
    ],
)
def test_addresses_are_taken_as_text(search: str, said: tuple[list[str], str]) -> None:
    assert read_address(search) == said


def test_endless_addresses_are_cut() -> None:
    assert len(read_address("?runs=" + "a," * 10_000 + "b")[0]) == 1
    assert len(read_address("?view=" + "v" * 100_000)[1]) < 5000
