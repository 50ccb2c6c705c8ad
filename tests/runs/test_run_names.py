"""Names and ids of runs never lead out of the runs folder."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.errors import RunError
from toolkit.runs.names import LONGEST_NAME, check_name, is_run_id, latest_offset, new_id


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("", "an empty name"),
        ("   ", "an empty name"),
        ("a/b", "a path separator"),
        ("a\\b", "a path separator"),
        ("C:name", "a path separator"),
        ("/etc/passwd", "a path separator"),
        ("..", "'..'"),
        ("a..b", "'..'"),
        (".hidden", "a leading '.'"),
        ("-rf", "a leading '-'"),
        ("a\nb", "control characters"),
        ("a\x00b", "control characters"),
        ("\x1b[31mred", "control characters"),
        ("right\u202eleft", "control characters"),
        (" a", "spaces at an end"),
        ("latest", "the reserved word 'latest'"),
        ("latest-3", "the reserved word 'latest'"),
        ("x" * (LONGEST_NAME + 1), "101 characters"),
    ],
)
def test_names_that_could_do_harm_are_refused_with_the_reason(name: str, found: str) -> None:
    with pytest.raises(RunError, match="cannot be used; expected one line") as caught:
        check_name(name)
    assert f"found {found}" in str(caught.value)


@pytest.mark.parametrize("name", ["first try", "größer", "a.b", "run_1-b", "<b>bold", "x" * LONGEST_NAME])
def test_ordinary_names_pass_unchanged(name: str) -> None:
    assert check_name(name) == name


@given(st.text())
def test_no_accepted_name_leaves_the_folder_it_is_put_in(name: str) -> None:
    try:
        check_name(name)
    except RunError:
        return
    folder = Path("/runs")
    assert (folder / name).resolve().parent == folder
    assert "\n" not in name


def test_an_id_says_when_and_what_and_differs_each_time() -> None:
    moment = datetime(2026, 11, 22, 1, 2, 3, tzinfo=UTC)
    made = {new_id("colmap-3dgs", moment) for _ in range(20)}
    assert len(made) > 1
    for one in made:
        assert one.startswith("20261122-010203-colmap-3dgs-")
        assert is_run_id(one)


@pytest.mark.parametrize("recipe", ["", "../x", "Big", "a b", "a/b"])
def test_a_recipe_name_that_cannot_be_in_an_id_is_refused(recipe: str) -> None:
    with pytest.raises(RunError, match="cannot be part of a run's id; expected small letters"):
        new_id(recipe)


@pytest.mark.parametrize(("text", "back"), [("latest", 0), ("latest-0", 0), ("latest-12", 12), ("latest-x", None)])
def test_latest_counts_back(text: str, back: int | None) -> None:
    assert latest_offset(text) == back
