"""Tables 2 and 3 of the blade paper (blade-inspection-sfm, section 4.4): NeRF and DS-NeRF on growing segments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from toolkit.files import write_text
from toolkit.runs.paper_rows import PaperRow
from toolkit.runs.paper_runs import Attempt
from toolkit.runs.row_cells import by_data, number_cell, seconds_cell

#: Equal for all rows: true poses, sparse points triangulated from faint features, what does not turn masked.
COMMON: Final[Mapping[str, Any]] = {
    "scene.way": "given",
    "scene.masks.find": True,
    "scene.points.pairs.method": "sequential",
    "scene.points.pairs.quadratic": False,
    "scene.points.sift.peak_threshold": 0.003,
}
#: The longest segment, in frames of the film.
LONGEST: Final = 400


@dataclass(frozen=True, slots=True)
class NerfRow:
    """A row of one of the tables.

    Attributes
    ----------
    row:
        The method.
    frames:
        Of the film, in the segment.
    warm_from:
        Key of the row whose weights it starts from; empty: from chance.
    """

    row: PaperRow
    frames: int
    warm_from: str = ""

    @property
    def key(self) -> str:
        """As on the command line."""
        return self.row.key


@dataclass(frozen=True, slots=True)
class NerfFigures:
    """A row of the paper's Table 2."""

    psnr: float
    ssim: float
    lpips: float


def _nerf(frames: int) -> NerfRow:
    return NerfRow(PaperRow(f"nerf-{frames}", f"NeRF, {frames} frames", "nerf", COMMON), frames)


def _depth(key: str, title: str, frames: int, weight: float, warm_from: str = "") -> NerfRow:
    row = PaperRow(key, f"DS-NeRF, {title}", "ds-nerf", {**COMMON, "train.depth_weight": weight})
    return NerfRow(row, frames, warm_from)


#: Rows of Table 2.
SEGMENTS: Final = tuple(_nerf(frames) for frames in (40, 80, 150, 250, LONGEST))
#: Rows of Table 3. The one of 40 frames is what the last one starts from.
WEIGHTS: Final = (
    _depth("ds-nerf-40", "40 frames, weight 0.1", 40, 0.1),
    *(
        _depth(f"ds-nerf-{weight:g}", f"250 frames, weight {weight:g}", 250, weight)
        for weight in (0, 0.1, 0.4, 0.8)
    ),
    _depth("ds-nerf-warm", "250 frames (40 init), weight 0.1", 250, 0.1, warm_from="ds-nerf-40"),
)
ROWS: Final = (*SEGMENTS, *WEIGHTS)
#: Table 2 of the paper. Our copy of its Table 3 has a caption and no figures.
PAPER: Final[Mapping[str, NerfFigures]] = {
    "nerf-40": NerfFigures(36.2, 0.9414, 0.1321),
    "nerf-80": NerfFigures(34.4, 0.9192, 0.1457),
    "nerf-150": NerfFigures(32.8, 0.8985, 0.1778),
    "nerf-250": NerfFigures(31.3, 0.8619, 0.2857),
    "nerf-400": NerfFigures(26.9, 0.7664, 0.4223),
}
NOT_IN_SOURCE: Final = "not in source"

_MILLI = 1000.0
_LPIPS = "test.lpips"
#: Heading, metric, factor, digits.
_COLUMNS = (
    ("PSNR (dB)", "test.psnr", 1.0, 2),
    ("SSIM", "test.ssim", 1.0, 4),
    ("LPIPS", _LPIPS, 1.0, 4),
    ("depth error: median (mm)", "depth.median", _MILLI, 2),
    ("mean (mm)", "depth.mean", _MILLI, 2),
    ("mesh F-score (%)", "mesh.f_score", 100.0, 1),
    ("at (mm)", "mesh.threshold", _MILLI, 2),
    ("steps", "nerf.steps", 1.0, 0),
)


@dataclass(frozen=True, slots=True)
class NerfTable:
    """Both tables of one film.

    Attributes
    ----------
    data:
        Its name.
    attempts:
        One a row.
    stride:
        Every how many frames of the film one was taken.
    window:
        With how many following pictures each one was matched for the sparse points.
    """

    data: str
    attempts: tuple[Attempt, ...]
    stride: int
    window: int

    def markdown(self) -> str:
        """Return the tables with the paper's figures beside ours, where these have any rows."""
        parts = [f"## {self.data}", ""]
        for title, rows in (
            ("Table 2: segments of growing length", SEGMENTS),
            ("Table 3: weights of the depth, and a warm start", WEIGHTS),
        ):
            keys = {row.key for row in rows}
            here = [attempt for attempt in self.attempts if attempt.row.key in keys]
            if here:
                parts += [f"### {title}", "", *_head(), *(_line(attempt) for attempt in here), ""]
        return "\n".join([*parts, *(f"- {note}" for note in self._notes())]) + "\n"

    def _notes(self) -> list[str]:
        every = "every frame" if self.stride == 1 else f"one frame in {self.stride}"
        notes = [
            f"A segment of n frames is the first n of one film, {every} of it: the column frames has how "
            "many pictures that are, every eighth of them a test picture. So all rows are in one world, as a warm "
            "start needs; the poses are the true ones, where the paper has those of SIMPLE_RADIAL.",
            f"Sparse points are triangulated from each picture and the {self.window} that follow it; every pair "
            "would take blades for each other. What does not turn is masked and counts for no measure but LPIPS.",
            "Depth errors are those of test renders against the true depth, means over the views of a picture's "
            "median and mean. The F-score is that of the mesh against the true surface which the segment's "
            "pictures see, at half a percent of that surface's box: it grows with the segment, so that F-scores "
            "of one segment alone can be compared.",
            "All rows have the same number of steps unless the column steps says otherwise, so that a picture of a "
            "long segment is looked at less often; the paper's steps grew with the segment.",
            "Time is that of all stages but measuring, also where a stage was taken from an earlier run.",
            "Paper: Table 2, 480 x 360 pixels of other footage, nerf_pl for 30 epochs, 8 hours a run on a GPU: "
            f"PSNR, SSIM, LPIPS. Of Table 3 our copy has the caption alone: {NOT_IN_SOURCE}. The caption says: the "
            "less depth is involved, the better the metrics.",
        ]
        if any(attempt.row.key == "ds-nerf-warm" for attempt in self.attempts):
            notes.append(
                "The row with a warm start takes the weights of the row of 40 frames and with them its box: what "
                "the other frames show lies in the shell around it, with less detail."
            )
        return notes


def nerf_tables(attempts: Sequence[Attempt], *, stride: int, window: int) -> list[NerfTable]:
    """Return the tables of each film, in the order of the attempts."""
    return [NerfTable(name, of_it, stride, window) for name, of_it in by_data(attempts).items()]


def write_nerf_tables(tables: Sequence[NerfTable], folder: Path) -> Path:
    """Write the tables as Markdown and return the file.

    Raises
    ------
    RunError
        When the disk is full or may not be written.
    """
    path = folder / "tables2and3.md"
    write_text(path, "\n".join(table.markdown() for table in tables))
    return path


def _head() -> list[str]:
    head = ["", "frames", *(title for title, _, _, _ in _COLUMNS), "time (s)", "paper"]
    return [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]


def _line(attempt: Attempt) -> str:
    figures = PAPER.get(attempt.row.key)
    paper = NOT_IN_SOURCE if figures is None else f"{figures.psnr:g}, {figures.ssim:.4f}, {figures.lpips:.4f}"
    if attempt.outcome != "finished" or attempt.run is None:
        return f"| {attempt.row.title} | {attempt.brief} |" + " |" * (len(_COLUMNS) + 1) + f" {paper} |"
    result = attempt.run.result()
    metrics = result.metrics
    cells = [number_cell(_metric(metrics, name), digits, factor) for _, name, factor, digits in _COLUMNS]
    told = [attempt.row.title, number_cell(metrics.get("sfm.images")), *cells, seconds_cell(result), paper]
    return f"| {' | '.join(told)} |"


def _metric(metrics: Mapping[str, float | None], name: str) -> float | None:
    """Return a metric; the name of LPIPS ends in that of its network."""
    if name != _LPIPS:
        return metrics.get(name)
    return next((value for key, value in metrics.items() if key.startswith(name)), None)
