"""Table 1 of the blade paper (blade-inspection-sfm, section 4.3): the arc that each camera model gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from toolkit.files import write_text
from toolkit.runs.paper_rows import PaperRow
from toolkit.runs.paper_runs import Attempt
from toolkit.runs.row_cells import by_data, number_cell, seconds_cell

_RECIPE: Final = "blades-sequential"
#: Widths of the picture from which an unknown lens starts: the engine's has 0.64.
START_FOCAL: Final = 0.8


def _row(key: str, title: str, way: str, model: str) -> PaperRow:
    return PaperRow(key, title, _RECIPE, {"lens.way": way, "lens.model": model, "lens.start_focal": START_FOCAL})


#: Rows in the table's order. The first four are the paper's a) to d).
ROWS: Final = (
    _row("a", "SIMPLE_RADIAL, distorted pictures", "one-step", "SIMPLE_RADIAL"),
    _row("b", "SIMPLE_RADIAL, undistorted", "two-step", "SIMPLE_RADIAL"),
    _row("c", "RADIAL, undistorted", "two-step", "RADIAL"),
    _row("d", "OPENCV_FISHEYE, undistorted", "two-step", "OPENCV_FISHEYE"),
    _row("radial", "RADIAL, distorted pictures", "one-step", "RADIAL"),
    _row("fisheye", "OPENCV_FISHEYE, distorted pictures", "one-step", "OPENCV_FISHEYE"),
    PaperRow("known", "lens known and kept", _RECIPE, {"lens.way": "known"}),
)
#: Degrees in the paper's Table 1; its segment covers 98.
PAPER: Final[Mapping[str, float]] = {"a": 290.0, "b": 175.0, "c": 107.0, "d": 102.0}
PAPER_TRUTH: Final = 98.0

_COLUMNS = (
    ("arc (deg)", "circle.arc_deg", 1),
    ("error (deg)", "circle.arc_error_deg", 1),
    ("focal (widths)", "lens.focal_widths", 3),
    ("radius spread", "circle.radius_spread", 4),
    ("out of plane", "circle.out_of_plane", 4),
    ("points", "sfm.points", 0),
    ("reprojection (px)", "sfm.reprojection_error_px", 3),
)


@dataclass(frozen=True, slots=True)
class ArcTable:
    """The arcs of one data set.

    Attributes
    ----------
    data:
        Its name.
    attempts:
        One a row.
    """

    data: str
    attempts: tuple[Attempt, ...]

    def markdown(self) -> str:
        """Return the table with the paper's figures beside ours."""
        more = [title for title, _, _ in _COLUMNS[1:]]
        head = ["", "frames", "arc (deg)", "+- (deg)", *more, "time (s)", "paper"]
        lines = [f"## {self.data}", "", f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
        lines += [self._line(attempt) for attempt in self.attempts]
        lines += ["", *(f"- {note}" for note in self._notes())]
        return "\n".join(lines) + "\n"

    def _line(self, attempt: Attempt) -> str:
        paper = PAPER.get(attempt.row.key)
        told = "" if paper is None else f"{paper:.0f}"
        if attempt.outcome != "finished" or attempt.run is None:
            return f"| {attempt.row.title} | {attempt.brief} |" + " |" * len(_COLUMNS) + f" | | {told} |"
        result = attempt.run.result()
        metrics = result.metrics
        frames = f"{metrics['sfm.registered']:.0f} of {metrics['sfm.images']:.0f}"
        cells = [number_cell(metrics.get(metric), digits) for _, metric, digits in _COLUMNS]
        sigma = number_cell(metrics.get("circle.arc_sigma_deg"), 1)
        row = [attempt.row.title, frames, cells[0], sigma, *cells[1:], seconds_cell(result), told]
        return f"| {' | '.join(row)} |"

    def _notes(self) -> list[str]:
        return [
            f"Paper: Table 1, 990 frames that cover about {PAPER_TRUTH:.0f} degrees of other footage, DISK and "
            "LightGlue: its arcs are to be read beside that, not beside ours.",
            "The second pass of undistorted rows has the fixed PINHOLE of the undistorted pictures; the paper "
            "refines a camera model again there.",
            "+- is one standard deviation from the covariance of the bundle adjustment, of independent residuals, "
            "with the intrinsics among the unknowns; in undistorted rows with the lens as uncertain as the first "
            "pass left it. What residuals have in common comes on top.",
            f"A lens that is not known starts at {START_FOCAL} widths, undistorted, its axis in the middle. "
            "OPENCV_FISHEYE gets its poses from RADIAL_FISHEYE, and is refined from there.",
        ]


def arc_tables(attempts: Sequence[Attempt]) -> list[ArcTable]:
    """Return one table a data set, in the order of the attempts."""
    return [ArcTable(name, of_it) for name, of_it in by_data(attempts).items()]


def write_arc_tables(tables: Sequence[ArcTable], folder: Path) -> Path:
    """Write the tables as Markdown and return the file.

    Raises
    ------
    RunError
        When the disk is full or may not be written.
    """
    path = folder / "table1.md"
    write_text(path, "\n".join(table.markdown() for table in tables))
    return path
