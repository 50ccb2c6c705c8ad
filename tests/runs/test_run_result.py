"""What a run leaves behind can always be stored, or the message says what cannot."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.runs.result import plain


@dataclass(frozen=True)
class Report:
    folder: Path
    counts: tuple[int, ...]


def test_values_of_numpy_paths_and_dataclasses_become_plain() -> None:
    not_finite: list[str] = []
    value = {
        "float": np.float32(0.5),
        "int": np.int64(3),
        "bool": np.bool_(True),
        "array": np.array([[1, 2], [3, 4]]),
        "report": Report(Path("a/b"), (1, 2)),
        3: [None, "text", 2.5, True],
    }
    assert plain(value, not_finite) == {
        "float": 0.5,
        "int": 3,
        "bool": True,
        "array": [[1, 2], [3, 4]],
        "report": {"folder": "a/b", "counts": [1, 2]},
        "3": [None, "text", 2.5, True],
    }
    assert not_finite == []


def test_what_is_not_finite_becomes_null_and_is_named() -> None:
    not_finite: list[str] = []
    value = {"a": float("nan"), "b": [1.0, np.float64("inf")], "c": np.array([0.0, -np.inf])}
    assert plain(value, not_finite) == {"a": None, "b": [1.0, None], "c": [0.0, None]}
    assert not_finite == ["result.a", "result.b[1]", "result.c[1]"]


def test_what_cannot_be_stored_is_named() -> None:
    with pytest.raises(DataError, match=r"result\.reports\.made cannot be stored; expected numbers.*found set"):
        plain({"reports": {"made": {1, 2}}}, [])
