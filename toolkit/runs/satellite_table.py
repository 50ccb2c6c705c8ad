"""What the satellite paper (satellite-3d, section 4) measures, on our data: methods, and DUSt3R's budgets."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from toolkit.files import write_text
from toolkit.runs.paper_rows import PaperRow
from toolkit.runs.paper_runs import Attempt
from toolkit.runs.row_cells import by_data, number_cell, seconds_cell

#: Rows in the order of the paper's sections; ours after them.
ROWS: Final = (
    PaperRow("colmap", "COLMAP + 3DGS", "sat-colmap-3dgs", {}),
    PaperRow("colmap-depth", "the same, held to predicted depth", "sat-colmap-3dgs", {"depth_loss.weight": 0.03}),
    PaperRow("vggt-ba", "VGGT + bundle adjustment (paper's)", "vggt-ba", {}),
    PaperRow("vggt-tracks", "VGGT + bundle adjustment (tracks)", "vggt-ba", {"adjust.method": "tracks"}),
    PaperRow("dust3r", "DUSt3R, most views that spread most", "dust3r-views", {}),
    PaperRow("heights", "RPCs, heights matched over the ground", "sat-heights", {}),
    PaperRow("splat", "RPCs, 2D splat on these heights", "sat-splat", {}),
)
#: What the paper says of a row.
PAPER: Final = {
    "colmap": "3 of 16 views; training L1 0.0195, 35.61 dB; 11 min",
    "colmap-depth": "training L1 0.0196, 35.59 dB",
    "vggt-ba": "4 views; no figures",
    "dust3r": "times below; no figures",
}
#: The paper's Table 1: seconds by the number of views.
BUDGETS: Final = {2: 6, 4: 24, 8: 58, 16: 6152}
#: Heading, metric, factor, digits.
_COLUMNS = (
    ("training L1", "training.l1", 1.0, 4),
    ("training PSNR (dB)", "training.psnr", 1.0, 2),
    ("held-out PSNR (dB)", "test.psnr", 1.0, 2),
    ("DSM: MAE (m)", "dsm.mae", 1.0, 2),
    ("median (m)", "dsm.median_absolute", 1.0, 2),
    ("within 1 m (%)", "dsm.within_1m", 100.0, 1),
)
_BUDGET = re.compile(r"views\.(\d+)\.(most|least)\.seconds")


@dataclass(frozen=True, slots=True)
class SatelliteTable:
    """Methods on one data set.

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
        """Return the tables with the paper's figures beside ours."""
        head = ["", "views", *(title for title, _, _, _ in _COLUMNS), "time (s)", "paper"]
        lines = [f"## {self.data}", "", f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
        lines += [_line(attempt) for attempt in self.attempts]
        lines += self._budgets()
        return "\n".join([*lines, "", *(f"- {note}" for note in _NOTES)]) + "\n"

    def _budgets(self) -> list[str]:
        """Return the table of views and seconds; nothing where no row is about them."""
        rows = [attempt for attempt in self.attempts if attempt.row.key == "dust3r"]
        if not rows:
            return []
        metrics = rows[0].run.result().metrics if rows[0].outcome == "finished" and rows[0].run else {}
        found = {(int(m[1]), m[2]) for m in map(_BUDGET.fullmatch, metrics) if m}
        lines = ["", "### DUSt3R: how many views, and which", ""]
        head = [
            "views",
            *(f"{spread}: {what}" for spread in ("most", "least") for what in _WHAT),
            "paper: time (s)",
        ]
        lines += [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
        for count in sorted({*BUDGETS, *(count for count, _ in found)}):
            cells = [
                number_cell(metrics.get(f"views.{count}.{spread}.{name}"), digits)
                for spread in ("most", "least")
                for name, digits in _WHAT.values()
            ]
            paper = str(BUDGETS[count]) if count in BUDGETS else ""
            lines.append(f"| {count} | {' | '.join(cells)} | {paper} |")
        return lines


_WHAT: Final = {"time (s)": ("seconds", 0), "DSM MAE (m)": ("dsm_mae", 2)}
_NOTES: Final = (
    "Views: those that have a camera, of those that the method was given. vggt-ba chooses 4 that spread most, as "
    "the paper does; sat-* take all.",
    "Training L1 and PSNR compare training pictures with their own renders, as the paper does: they say how well a "
    "splat fits what it was made from. Held-out PSNR is of pictures that no splat was trained on. Where colours of "
    "each picture are fitted, those of held-out pictures are not: other suns and air count as errors.",
    "DSM: the surface model against the true one, after the best shift; the paper has no such figure. COLMAP's "
    "splat is in no map frame and has none.",
    "Time is that of all stages but measuring, also where a stage was taken from an earlier run. Paper: 10,000 "
    "steps on a Tesla T4 (COLMAP + 3DGS), an RTX 3060 (DUSt3R), other pictures (DFC2019).",
)


def satellite_tables(attempts: Sequence[Attempt]) -> list[SatelliteTable]:
    """Return one table a data set, in the order of the attempts."""
    return [SatelliteTable(name, of_it) for name, of_it in by_data(attempts).items()]


def write_satellite_tables(tables: Sequence[SatelliteTable], folder: Path) -> Path:
    """Write the tables as Markdown and return the file.

    Raises
    ------
    RunError
        When the disk is full or may not be written.
    """
    path = folder / "methods.md"
    write_text(path, "\n".join(table.markdown() for table in tables))
    return path


def _line(attempt: Attempt) -> str:
    paper = PAPER.get(attempt.row.key, "")
    if attempt.outcome != "finished" or attempt.run is None:
        return f"| {attempt.row.title} | {attempt.brief} |" + " |" * (len(_COLUMNS) + 1) + f" {paper} |"
    result = attempt.run.result()
    metrics = result.metrics
    views = f"{number_cell(metrics.get('sfm.registered'))} of {number_cell(metrics.get('sfm.images'))}"
    cells = [number_cell(metrics.get(name), digits, factor) for _, name, factor, digits in _COLUMNS]
    return f"| {' | '.join([attempt.row.title, views, *cells, seconds_cell(result), paper])} |"
