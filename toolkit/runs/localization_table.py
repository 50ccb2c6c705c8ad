"""Tables 1, 2 and 3 of the paper on localisation (uav-splat-localization, section 4), on our data."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from toolkit.files import write_text
from toolkit.runs.localization_rows import (
    EXPECTED,
    MODES,
    NOT_RUN,
    NOTES,
    PAPER_DENSE,
    PAPER_MAPS,
    PAPER_POSES,
    PAPER_RESIDUAL,
    PAPER_SPARSE,
    SCENARIOS,
    PoseFigures,
)
from toolkit.runs.paper_runs import Attempt
from toolkit.runs.result import StoredResult
from toolkit.runs.row_cells import by_data, number_cell

#: How the published figures are called in figures with bars.
PUBLISHED: Final = "paper, published"
#: A way and a scenario; the start's own errors are no way.
_MODE: Final = re.compile(r"localize\.(?!start\.)([^.]+)\.([^.]+)\.mte_m")
_STEPS: Final = "train.steps"
#: How the names of stages begin that do not make the map.
_NOT_MAP: Final = ("measure", "map-geometry", "queries", "localize")

#: Heading, metric, digits.
_MAP: Final = (
    ("GNSS residual (m)", "sfm.position_residual", 2),
    ("sparse points", "sfm.points", 0),
    ("dense points", "fused.points", 0),
    ("dense : sparse", "fused.per_sparse", 1),
    ("Gaussians: start", "splat.initial", 0),
    ("at 7/30", "splat.gaussians.early", 0),
    ("final", "splat.gaussians", 0),
    ("test PSNR at 7/30 (dB)", "test.psnr.early", 2),
    ("test PSNR (dB)", "test.psnr", 2),
    ("training PSNR (dB)", "training.psnr", 2),
    ("training (s)", "train.seconds", 0),
)
_GEOMETRY: Final = (
    ("C2C of centres (m)", "map.c2c_median", 3),
    ("C2C of rendered depth (m)", "map.depth_c2c_median", 3),
    ("displacement: horizontal (m)", "map.moved_horizontal", 3),
    ("vertical (m)", "map.moved_vertical", 3),
    ("depth against truth: bias (m)", "map.depth_bias", 3),
    ("spread (m)", "map.depth_spread", 3),
)
#: Heading, metric below mode and scenario, factor, digits; below the start it is the same.
_POSES: Final = (
    ("found (%)", "found", 100.0, 1),
    ("MTE (m)", "mte_m", 1.0, 3),
    ("against truth (m)", "true_mte_m", 1.0, 3),
    ("RMSE-T (m)", "rmse_t_m", 1.0, 3),
    ("MRE (°)", "mre_deg", 1.0, 3),
    ("RMSE-R (°)", "rmse_r_deg", 1.0, 3),
    ("0.1 m, 0.1° (%)", "recall_01", 100.0, 1),
    ("0.5 m, 1° (%)", "recall_05", 100.0, 1),
    ("5 m, 5° (%)", "recall_5", 100.0, 1),
    ("time (s)", "seconds", 1.0, 2),
)
_START: Final = (("start: MTE (m)", "mte_m", 2), ("MRE (°)", "mre_deg", 2), ("photos", "photos", 0))


@dataclass(frozen=True, slots=True)
class LocalizationTable:
    """The three tables of one data set.

    Attributes
    ----------
    data:
        Its name.
    attempts:
        One a map.
    """

    data: str
    attempts: tuple[Attempt, ...]

    def markdown(self) -> str:
        """Return the tables with the paper's figures beside ours."""
        tables = (
            ("Table 1: the maps", self._maps()),
            ("Table 2: how near the maps are to the surface", self._geometry()),
            ("Table 3: poses of the queries", self._poses()),
        )
        parts = [f"## {self.data}", ""]
        for title, lines in tables:
            parts += [f"### {title}", "", *lines, ""]
        return "\n".join([*parts, *(f"- {note}" for note in NOTES)]) + "\n"

    def _maps(self) -> list[str]:
        head = ["map", *(title for title, _, _ in _MAP), "whole map (s)", "steps", "queries placed"]
        lines = _head(head)
        for attempt in self.attempts:
            result = _result(attempt)
            if result is None:
                lines.append(_failed(attempt, len(head)))
            else:
                cells = [_cell(result.metrics, metric, digits) for _, metric, digits in _MAP]
                lines.append(_line(attempt.row.title, *cells, _seconds(result), _steps(attempt), _placed(result)))
            lines += _published_map(attempt.row.key)
        return lines

    def _geometry(self) -> list[str]:
        head = ["map", *(title for title, _, _ in _GEOMETRY), "paper: C2C (m)"]
        lines = _head(head)
        for attempt in self.attempts:
            paper = PAPER_MAPS.get(attempt.row.key)
            last = "" if paper is None else f"{paper.c2c:.2f}"
            result = _result(attempt)
            if result is None:
                lines.append(_failed(attempt, len(head), last))
                continue
            cells = [_cell(result.metrics, metric, digits) for _, metric, digits in _GEOMETRY]
            lines.append(_line(attempt.row.title, *cells, last))
        return lines

    def _poses(self) -> list[str]:
        head = ["map", "start", "method", *(row[0] for row in (*_POSES, *_START))]
        lines = _head(head)
        for attempt in self.attempts:
            result = _result(attempt)
            if result is None:
                lines.append(_failed(attempt, len(head)))
            known = {} if result is None else _modes(result.metrics)
            paper = PAPER_POSES.get(attempt.row.key, {})
            for scenario in dict.fromkeys((*SCENARIOS, *known)):
                if result is not None:
                    lines += _found(attempt.row.title, scenario, known.get(scenario, ()), result)
                if scenario in paper:
                    lines.append(_published_pose(attempt.row.title, scenario, paper[scenario]))
        return lines

    def mean_errors(self) -> dict[str, dict[str, dict[str, float | None]]]:
        """Return MTE in metres by method, map and scenario, the published ones under :data:`PUBLISHED`.

        This is what :func:`toolkit.plots.localization.mte_bars` draws; None where a way did not run or found
        nothing.
        """
        metrics: dict[str, Mapping[str, float | None]] = {
            attempt.row.title: {} if (result := _result(attempt)) is None else result.metrics
            for attempt in self.attempts
        }
        there = {title: _modes(of_map) for title, of_map in metrics.items()}
        scenarios = _ordered(SCENARIOS, [*SCENARIOS, *(name for of_map in there.values() for name in of_map)])
        modes = _ordered(MODES, [mode for of_map in there.values() for row in of_map.values() for mode in row])
        errors = {
            MODES.get(mode, mode): {
                title: {name: of_map.get(f"localize.{mode}.{name}.mte_m") for name in scenarios}
                for title, of_map in metrics.items()
            }
            for mode in modes
        }
        published: dict[str, dict[str, float | None]] = {
            attempt.row.title: {name: row.mte for name, row in PAPER_POSES[attempt.row.key].items()}
            for attempt in self.attempts
            if attempt.row.key in PAPER_POSES
        }
        return {**errors, PUBLISHED: published} if published else errors


def localization_tables(attempts: Sequence[Attempt]) -> list[LocalizationTable]:
    """Return the tables of each data set, in the order of the attempts."""
    return [LocalizationTable(name, of_it) for name, of_it in by_data(attempts).items()]


def write_localization_tables(tables: Sequence[LocalizationTable], folder: Path) -> Path:
    """Write the tables as Markdown and return the file.

    Raises
    ------
    RunError
        When the disk is full or may not be written.
    """
    path = folder / "tables1to3.md"
    write_text(path, "\n".join(table.markdown() for table in tables))
    return path


def _head(titles: Sequence[str]) -> list[str]:
    return [_line(*titles), "|" + "---|" * len(titles)]


def _line(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _failed(attempt: Attempt, width: int, last: str = "") -> str:
    """Return the line of a map that is not there, with the reason."""
    return _line(attempt.row.title, attempt.brief, *[""] * (width - 3), last)


def _result(attempt: Attempt) -> StoredResult | None:
    """Return what a run measured, None where it did not finish."""
    return attempt.run.result() if attempt.outcome == "finished" and attempt.run is not None else None


def _cell(metrics: Mapping[str, float | None], name: str, digits: int) -> str:
    """Return a measure; whole numbers, which may be millions, with commas."""
    value = metrics.get(name)
    return f"{value:,.0f}" if value is not None and not digits else number_cell(value, digits)


def _steps(attempt: Attempt) -> str:
    steps = attempt.run.record().flat_settings.get(_STEPS) if attempt.run is not None else None
    return number_cell(None) if steps is None else f"{steps:,}"


def _placed(result: StoredResult) -> str:
    """Return how many queries have a true pose, of how many."""
    placed, queries = (_cell(result.metrics, name, 0) for name in ("queries.placed", "queries"))
    return f"{placed} of {queries}"


def _seconds(result: StoredResult) -> str:
    """Return the whole seconds of what makes the map: neither measuring nor the queries."""
    return f"{sum(time.seconds for time in result.times if not time.name.startswith(_NOT_MAP)):,.0f}"


def _modes(metrics: Mapping[str, float | None]) -> dict[str, tuple[str, ...]]:
    """Return by scenario which ways a run has, in the table's order; the paper's scenarios first."""
    there = [(match[1], match[2]) for match in map(_MODE.fullmatch, metrics) if match]
    modes = _ordered(MODES, [mode for mode, _ in there])
    scenarios = _ordered(SCENARIOS, [scenario for _, scenario in there])
    return {name: tuple(mode for mode in modes if (mode, name) in there) for name in scenarios}


def _ordered(known: Iterable[str], there: Sequence[str]) -> list[str]:
    """Return the names that are there, once: those that are known in their order, then the others by name."""
    return [*(name for name in known if name in there), *sorted({*there} - {*known})]


def _found(title: str, scenario: str, there: Sequence[str], result: StoredResult) -> list[str]:
    """Return a line for each way, and for those that are expected and did not run."""
    metrics = result.metrics
    start = [_cell(metrics, f"localize.start.{scenario}.{name}", digits) for _, name, digits in _START]
    lines = []
    for mode in dict.fromkeys((*MODES, *there)):
        method = MODES.get(mode, mode)
        if mode in there:
            cells = [
                number_cell(metrics.get(f"localize.{mode}.{scenario}.{name}"), digits, factor)
                for _, name, factor, digits in _POSES
            ]
            lines.append(_line(title, scenario, method, *cells, *start))
        elif mode in EXPECTED:
            told = _not_run(result, scenario)
            lines.append(_line(title, scenario, method, told, *[""] * (len(_POSES) - 1), *start))
    return lines


def _not_run(result: StoredResult, scenario: str) -> str:
    """Return that a way did not run, with the reason where the whole scenario had none to start from."""
    report = result.reports.get(f"localize.{scenario}")
    reason = report.get("reason") if isinstance(report, Mapping) else None
    return f"{NOT_RUN}: {str(reason).split('; ')[0]}" if reason else NOT_RUN


def _published_map(key: str) -> list[str]:
    paper = PAPER_MAPS.get(key)
    if paper is None:
        return []
    points = (f"{PAPER_SPARSE:,}", f"{PAPER_DENSE:,}", f"{PAPER_DENSE / PAPER_SPARSE:.1f}")
    short = paper.psnr is None
    counts = (f"{paper.start:,}", f"{paper.final:,}" if short else "–", "–" if short else f"{paper.final:,}")
    ratios = (f"{paper.psnr_7000:.2f}", number_cell(paper.psnr, 2), "–")
    times = (f"{paper.seconds:,.0f}", "–", f"{paper.iterations:,}", "–")
    cells = (f"{PAPER_RESIDUAL:.2f}", *points, *counts, *ratios, *times)
    return [_line("*paper*", *(f"*{cell}*" for cell in cells))]


def _published_pose(title: str, scenario: str, paper: PoseFigures) -> str:
    known = {"mte_m": paper.mte, "rmse_t_m": paper.rmse_t, "mre_deg": paper.mre, "rmse_r_deg": paper.rmse_r}
    cells = [f"*{known[name]:.2f}*" if name in known else "" for _, name, _, _ in _POSES]
    start = "" if paper.start_mte is None else f"*{paper.start_mte:.2f}*"
    return _line(f"*{title}*", f"*{scenario}*", f"*{PUBLISHED}*", *cells, start, "", "")
