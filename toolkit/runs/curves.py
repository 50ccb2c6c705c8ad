"""metrics.csv: measurements that grow while a run works.

One measurement a line, ``time_s,stage,step,name,value``; a line counts once it is ended. Where a resumed run
repeats steps after its checkpoint, the last value of a (stage, step, name) is the one that holds.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.runs.lines import LineFile

HEADER = "time_s,stage,step,name,value"
_UNSAFE = re.compile(r'[,"\s]')


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """One measurement over a stage.

    Attributes
    ----------
    stage, name:
        What was measured where.
    steps:
        (N,) int64, ascending.
    seconds:
        (N,) working time of the run when each was measured; pauses between stopping and resuming do not count.
    values:
        (N,) float64.
    """

    stage: str
    name: str
    steps: NDArray[np.int64]
    seconds: NDArray[np.float64]
    values: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Curves:
    """All measurements of a run, in order of first appearance, and the number of lines that could not be read."""

    curves: tuple[Curve, ...]
    damaged_lines: int

    def find(self, stage: str, name: str) -> Curve | None:
        """Return one curve, None where it was not measured."""
        return next((curve for curve in self.curves if (curve.stage, curve.name) == (stage, name)), None)


def read_curves(path: Path) -> Curves:
    """Return what a metrics file holds; an unterminated last line is left out, damaged ones are counted.

    A file whose header is not written to its end yet holds nothing: a run that begins makes the file first.

    Raises
    ------
    DataError
        Where the file is missing or starts with another header.
    """
    try:
        text = path.read_bytes().decode("utf-8", errors="replace")
    except OSError as error:
        raise DataError(f"Cannot read {path}", expected="the measurements of a run", found=str(error)) from error
    if HEADER.startswith(text):
        return Curves((), 0)
    header, *lines = text.split("\n")
    del lines[-1:]
    if header != HEADER:
        raise DataError(f"{path} holds no measurements of a run", expected=HEADER, found=repr(header[:80]))
    table: dict[tuple[str, str], dict[int, tuple[float, float]]] = {}
    damaged = 0
    for line in lines:
        row = parse_row(line)
        if row is None:
            damaged += 1
            continue
        seconds, stage, step, name, value = row
        table.setdefault((stage, name), {})[step] = (seconds, value)
    return Curves(tuple(_curve(stage, name, rows) for (stage, name), rows in table.items()), damaged)


def parse_row(line: str) -> tuple[float, str, int, str, float] | None:
    """Return seconds, stage, step, name and value of a line, None where it is damaged."""
    fields = line.split(",")
    if len(fields) != 5:
        return None
    try:
        seconds, step, value = float(fields[0]), int(fields[2]), float(fields[4])
    except ValueError:
        return None
    return (seconds, fields[1], step, fields[3], value) if math.isfinite(seconds) else None


def _curve(stage: str, name: str, rows: Mapping[int, tuple[float, float]]) -> Curve:
    steps = sorted(rows)
    seconds, values = zip(*(rows[step] for step in steps), strict=True)
    return Curve(stage, name, np.array(steps, np.int64), np.array(seconds, float), np.array(values, float))


class CurveWriter:
    """Appends measurements to a metrics file.

    ``seconds`` is the working time that the file had reached when it was opened: a resumed run counts on from
    there.

    Raises
    ------
    RunError
        When the disk is full or may not be written.
    DataError
        When the file holds something else.
    """

    def __init__(self, path: Path) -> None:
        # Read first: a file that is not ours stays as it is.
        begun = path.is_file() and b"\n" in path.read_bytes()
        curves = read_curves(path).curves if begun else ()
        self.seconds = max((float(curve.seconds.max()) for curve in curves), default=0.0)
        self._lines = LineFile(path)
        if not begun:
            self._lines.append(HEADER + "\n")

    def write(self, seconds: float, stage: str, step: int, values: Mapping[str, float]) -> None:
        """Append the measurements of one step."""
        safe_stage = _UNSAFE.sub("_", stage)
        self._lines.append(
            "".join(
                f"{seconds:.3f},{safe_stage},{step},{_UNSAFE.sub('_', name)},{float(value)!r}\n"
                for name, value in values.items()
            )
        )

    def close(self) -> None:
        """End writing."""
        self._lines.close()
