"""The measurements of a working run, read piece by piece as they are written."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from toolkit.errors import DataError
from toolkit.runs.curves import HEADER, parse_row

#: Most points kept of a measurement.
MOST = 2000
_PIECE = 4 * 2**20


@dataclass
class LiveCurve:
    """One measurement, thinned as it grows: every ``stride``-th value is kept, from the first on.

    Attributes
    ----------
    stage, name:
        What was measured where.
    steps, seconds, values:
        What is kept, ascending in steps; ``seconds`` is the working time of the run.
    stride:
        1, 2, 4 ...: doubled, and half of what is kept given up, whenever there are more than ``most``.
    latest:
        Step, seconds and value of the newest one, kept or not.
    redrawn:
        Counts how often what was kept before has changed; in between it only grows.
    """

    stage: str
    name: str
    most: int = MOST
    steps: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    stride: int = 1
    latest: tuple[int, float, float] = (0, 0.0, 0.0)
    redrawn: int = 0
    _skipped: int = 0

    def add(self, step: int, seconds: float, value: float) -> None:
        """Take a measurement. Steps that a resumed run repeats take the place of those there were."""
        if self.steps and step <= self.latest[0]:
            self._forget_from(step)
        self.latest = (step, seconds, value)
        if self._skipped:
            self._skipped -= 1
            return
        self._skipped = self.stride - 1
        self.steps.append(step)
        self.seconds.append(seconds)
        self.values.append(value)
        if len(self.steps) > self.most:
            self.stride *= 2
            self.steps, self.seconds, self.values = self.steps[::2], self.seconds[::2], self.values[::2]
            # An odd number was kept, so the newest one stays; the next in the wider stride is farther off now.
            self._skipped = self.stride - 1 if self.steps[-1] == step else self.stride // 2 - 1
            self.redrawn += 1

    def pace(self, window: int = 200) -> float | None:
        """Return seconds a step over the last ``window`` kept points, None where fewer than two are there."""
        steps, seconds = self.steps[-window:], self.seconds[-window:]
        if len(steps) < 2 or seconds[-1] <= seconds[0]:
            return None
        return (seconds[-1] - seconds[0]) / (steps[-1] - steps[0])

    def _forget_from(self, step: int) -> None:
        kept = sum(known < step for known in self.steps)
        if kept < len(self.steps):
            self.redrawn += 1
        self.steps, self.seconds, self.values = self.steps[:kept], self.seconds[:kept], self.values[:kept]
        self._skipped = 0


class CurveTail:
    """Follows the metrics file of a run.

    Attributes
    ----------
    curves:
        By stage and name, in order of first appearance.
    damaged_lines:
        How many could not be read.
    """

    def __init__(self, path: Path, *, most: int = MOST) -> None:
        self._path, self._most = path, most
        self._begin()

    def _begin(self) -> None:
        self.curves: dict[tuple[str, str], LiveCurve] = {}
        self.damaged_lines = 0
        self._offset = 0
        self._file: int | None = None

    def find(self, name: str) -> LiveCurve | None:
        """Return the measurement of this name that was written last, of any stage; None where there is none."""
        named = [curve for curve in self.curves.values() if curve.name == name]
        return max(named, key=lambda curve: curve.latest[1], default=None)

    def read(self) -> bool:
        """Take what was written since the last time; return whether there was any.

        An unterminated last line waits for its end. A file that took the place of another is read from its start.

        Raises
        ------
        DataError
            Where the file cannot be read or holds something else. One that is not there has no measurements.
        """
        try:
            known = self._path.stat()
        except FileNotFoundError:
            return False
        except OSError as error:
            raise self._unreadable(error) from error
        if known.st_size < self._offset or self._file not in (None, known.st_ino):
            self._begin()
        self._file = known.st_ino
        if known.st_size == self._offset:
            return False
        return self._take()

    def _take(self) -> bool:
        taken = False
        try:
            with self._path.open("rb") as handle:
                handle.seek(self._offset)
                while piece := handle.read(_PIECE):
                    end = piece.rfind(b"\n") + 1
                    if end == 0:
                        break
                    self._take_lines(piece[:end].decode("utf-8", errors="replace"))
                    self._offset += end
                    handle.seek(self._offset)
                    taken = True
        except OSError as error:
            raise self._unreadable(error) from error
        return taken

    def _take_lines(self, text: str) -> None:
        lines = text.split("\n")[:-1]
        if self._offset == 0:
            header = lines.pop(0)
            if header != HEADER:
                raise DataError(
                    f"{self._path} holds no measurements of a run", expected=HEADER, found=repr(header[:80])
                )
        for line in lines:
            row = parse_row(line)
            if row is None:
                self.damaged_lines += 1
                continue
            seconds, stage, step, name, value = row
            curve = self.curves.get((stage, name))
            if curve is None:
                curve = self.curves[stage, name] = LiveCurve(stage, name, self._most)
            curve.add(step, seconds, value)

    def _unreadable(self, error: OSError) -> DataError:
        return DataError(f"Cannot read {self._path}", expected="the measurements of a run", found=str(error))
