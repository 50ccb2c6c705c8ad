"""One self-contained HTML page about one run, or about several side by side. It needs no network."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from plotly.offline import get_plotlyjs

import toolkit
from toolkit.files import write_text
from toolkit.plots.style import colour
from toolkit.progress import Progress, silent
from toolkit.runs.compare import ComparedRun, Comparison
from toolkit.runs.markup import Html, element, joined, table
from toolkit.runs.measures import format_number, format_seconds
from toolkit.runs.report_figures import FigureBook, aligned_figure, curve_places, psnr_figure, times_figure
from toolkit.runs.report_style import CSS, SCRIPT
from toolkit.runs.report_tables import (
    measures_section,
    note,
    paper_section,
    section,
    settings_section,
    text_rows,
    time_table,
)
from toolkit.runs.report_views import view_cards, views_by_name
from toolkit.runs.status import utc_now

#: Nothing may be loaded from anywhere: the browser enforces what the page promises.
_POLICY = "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
#: What cards of test pictures can show, and what the button says.
VIEW_MODES = {"slide": "Slide", "photo": "Photo", "render": "Render", "difference": "Difference"}
_MOST_LOG_LINES = 300
_MOST_REPORT = 20_000


def write_report(
    comparison: Comparison,
    path: Path,
    *,
    most_views: int = 24,
    picture_width: int = 720,
    progress: Progress = silent,
) -> None:
    """Write the page of a comparison (see :func:`toolkit.runs.compare.compare_runs`), or of one run alone.

    Parameters
    ----------
    comparison:
        What to tell.
    path:
        HTML file, replaced in one step.
    most_views:
        Most test pictures shown; those with the lowest PSNR come first.
    picture_width:
        Pictures wider than this are scaled down, in pixels.

    Raises
    ------
    RunError
        When the disk is full or may not be written.
    """
    write_text(path, report_page(comparison, most_views, picture_width, progress))


def report_page(comparison: Comparison, most_views: int, picture_width: int, progress: Progress) -> str:
    """Return the page; the parameters are those of :func:`write_report`."""
    runs = comparison.runs
    title = " · ".join(item.label for item in runs)
    dots = run_dots(len(runs))
    heads = run_heads(runs)
    figures = FigureBook()
    body = [
        _header(runs),
        run_cards(runs),
        warning_list(comparison.warnings),
        measures_section(comparison, heads),
        settings_section(comparison, heads),
        paper_section(comparison),
        _views(comparison, dots, figures, most_views, picture_width, progress),
        _curves(runs, figures),
        _times(comparison, heads, figures),
        _trajectories(runs, figures),
        details_section(comparison, heads),
        element("footer", f"Made by Sightline Toolkit {toolkit.__version__}. This page needs no network."),
    ]
    return "<!DOCTYPE html>\n" + element(
        "html",
        element(
            "head",
            element("meta", charset="utf-8"),
            element("meta", http_equiv="Content-Security-Policy", content=_POLICY),
            element("meta", name="viewport", content="width=device-width, initial-scale=1"),
            element("title", title),
            element("style", Html(CSS)),
        ),
        element(
            "body",
            element("main", body),
            figures.script(),
            element("script", Html(get_plotlyjs())),
            element("script", Html(SCRIPT)),
        ),
        lang="en",
    )


def run_dots(count: int) -> list[Html]:
    """Return a dot in the colour of each of ``count`` runs."""
    return [element("span", class_="dot", style=f"--run:{colour(i)}") for i in range(count)]


def run_heads(runs: Sequence[ComparedRun]) -> list[Html]:
    """Return the headings of the runs' columns."""
    return [joined([dot, item.label]) for dot, item in zip(run_dots(len(runs)), runs, strict=True)]


def run_cards(runs: Sequence[ComparedRun]) -> Html:
    """Return a card for each run with its state and what matters most."""
    dots = run_dots(len(runs))
    return element("div", [_card(item, i, dots[i]) for i, item in enumerate(runs)], class_="runs")


def _choice(label: str, options: dict[str, str]) -> Html:
    """Return a row of buttons of which the first is chosen."""
    buttons = [
        element("button", text, type="button", data_mode=mode, aria_pressed="true" if i == 0 else "false")
        for i, (mode, text) in enumerate(options.items())
    ]
    return element("div", buttons, class_="choice", role="group", aria_label=label)


def _header(runs: Sequence[ComparedRun]) -> Html:
    several = len(runs) > 1
    when = f"{utc_now()[:16].replace('T', ' ')} UTC"
    return element(
        "header",
        element("h1", f"Comparison of {len(runs)} runs" if several else runs[0].label),
        element("p", f"Written {when}" if several else f"Report of a run, written {when}"),
        class_="page",
    )


def _card(item: ComparedRun, position: int, dot: Html) -> Html:
    """Return what matters most about a run."""
    numbers: list[Html] = []
    if item.result is not None:
        for name, title, unit in (("test.psnr", "PSNR", " dB"), ("test.ssim", "SSIM", "")):
            value = item.result.metrics.get(name)
            if value is not None:
                numbers.append(_number(title, format_number(value) + unit))
        numbers.append(_number("time of all stages", format_seconds(item.result.seconds)))
    state = item.status.state
    return element(
        "article",
        element("h3", dot, item.label, element("span", state, class_=f"badge {state}")),
        element("div", f"{item.record.recipe} on {Path(item.record.data).name}", class_="what"),
        element("div", numbers, class_="numbers") if numbers else None,
        element("div", item.status.error, class_="what") if item.status.error else None,
        element("div", item.run.id, class_="what mono"),
        class_="card run",
        style=f"--run:{colour(position)}",
    )


def _number(title: str, value: str) -> Html:
    return element("div", element("b", value), element("span", title))


def warning_list(texts: Sequence[str]) -> Html | None:
    """Return warnings as a list, None for none."""
    return element("ul", [element("li", text) for text in texts], class_="warnings") if texts else None


def _views(
    comparison: Comparison,
    dots: Sequence[Html],
    figures: FigureBook,
    most: int,
    width: int,
    progress: Progress,
) -> Html | None:
    runs = comparison.runs
    found = views_by_name(runs)
    if not found.names:
        return None
    marked = psnr_is_comparable(comparison)
    cards = view_cards(runs, found, dots, most=most, width=width, mark_best=marked, progress=progress)
    shown = min(most, len(found.names))
    count = f"The {shown} worst of {len(found.names)}" if shown < len(found.names) else f"All {shown}"
    chart = figures.place_one(psnr_figure(runs, found))
    return section(
        "Test pictures",
        note([f"{count} pictures that no run was trained on, worst first. Move over a picture to uncover it."]),
        element("div", _choice("What the pictures show", VIEW_MODES), class_="bar"),
        cards,
        element("div", chart, class_="card chart", style="margin-top:16px") if chart is not None else None,
        mode="slide",
    )


def psnr_is_comparable(comparison: Comparison) -> bool:
    """Whether the better of two renders of a picture may be marked."""
    return any(row.best for row in comparison.measures if row.name == "test.psnr")


def _curves(runs: Sequence[ComparedRun], figures: FigureBook) -> Html | None:
    places, remarks = curve_places(runs, figures)
    if not places and not remarks:
        return None
    over = _choice("Horizontal axis", {"step": "by step", "time": "by time"})
    return section(
        "Curves",
        note(remarks),
        [element("div", over, class_="bar"), element("div", places, class_="charts")] if places else None,
    )


def _times(comparison: Comparison, heads: Sequence[Html], figures: FigureBook) -> Html | None:
    place = figures.place_one(times_figure(comparison.runs))
    if place is None:
        return None
    chart = element("div", place, class_="card chart", style="margin-bottom:14px")
    return section("Time by stage", chart, time_table(comparison, heads))


def _trajectories(runs: Sequence[ComparedRun], figures: FigureBook) -> Html | None:
    drawn_paths, remarks = aligned_figure(runs)
    place = figures.place_one(drawn_paths)
    if place is None and not remarks:
        return None
    drawn = element("div", place, class_="card chart") if place is not None else None
    return section("Camera trajectories", note(remarks), drawn)


def details_section(comparison: Comparison, heads: Sequence[Html]) -> Html:
    """Return what is needed to make a run again, folded away."""
    parts: list[Html] = []
    for item in comparison.runs:
        parts.append(_folded(f"Settings of {item.label}", json.dumps(item.record.settings, indent=2)))
        if item.result is not None and item.result.reports:
            text = json.dumps(item.result.reports, indent=1)
            cut = f"\n… cut here; all of it is in {item.run.result_file}" if len(text) > _MOST_REPORT else ""
            parts.append(_folded(f"Reports of the stages of {item.label}", text[:_MOST_REPORT] + cut))
        if item.run.log_file.is_file():
            lines = item.run.log_file.read_text(encoding="utf-8", errors="replace").splitlines()
            parts.append(_folded(f"Log of {item.label}", "\n".join(lines[-_MOST_LOG_LINES:])))
    facts = table(["", *heads], text_rows(comparison.facts), "text")
    return section("How the runs were made" if len(comparison.runs) > 1 else "How the run was made", facts, parts)


def _folded(title: str, text: str) -> Html:
    return element("details", element("summary", title), element("pre", text))
