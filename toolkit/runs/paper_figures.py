"""A paper's figures from finished runs: renders of test views side by side, and trajectories against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from toolkit.files import atomic_path
from toolkit.plots.trajectories import trajectory_figure
from toolkit.recipes.base import TestView
from toolkit.runs.paper_runs import Attempt
from toolkit.runs.trajectories import align_trajectories, read_trajectories
from toolkit.scene.pictures import open_picture

Rank = Literal["worst", "median"]

_CELL = 320
_MARGIN, _TITLE, _LABEL = 6, 24, 170
_GROUND, _INK, _EMPTY = (255, 255, 255), (30, 34, 42), (228, 231, 236)


def render_grid(attempts: Sequence[Attempt], path: Path, *, rank: Rank = "median") -> dict[str, str]:
    """Draw a grid as the paper's figures 2 and 3: a column a data set, a row a method, the photos above.

    All pictures of a column are of one test view: that whose mean PSNR over the methods that drew it is the median
    or the worst among the views that most methods drew. Where a method has no render of it, the cell says why.

    Parameters
    ----------
    attempts:
        Methods on data sets.
    path:
        PNG file to write.
    rank:
        Which view is taken.

    Returns
    -------
    dict
        Name of the view by data set; data sets without any render are missing and have empty columns.

    Raises
    ------
    DataError
        Where a run's files are damaged.
    RunError
        When the disk is full or may not be written.
    """
    data = list(dict.fromkeys(attempt.data for attempt in attempts))
    methods = {attempt.row.key: attempt.row.title for attempt in attempts}
    views = {(attempt.row.key, attempt.data): _views(attempt) for attempt in attempts}
    of_data = {name: [drawn for (_, of), drawn in views.items() if of == name] for name in data}
    chosen = {name: view for name, drawn in of_data.items() if (view := _choose(drawn, rank))}
    height = _cell_height(attempts, views, chosen)
    size = _LABEL + len(data) * (_CELL + _MARGIN), _TITLE + (1 + len(methods)) * (height + _MARGIN)
    grid = Image.new("RGB", size, _GROUND)
    draw = ImageDraw.Draw(grid)
    font = ImageFont.load_default(14)
    for row, title in enumerate(["Photo", *methods.values()]):
        _write(draw, title, (6, _TITLE + row * (height + _MARGIN), _LABEL - 12, height), font)
    for column, name in enumerate(data):
        left = _LABEL + column * (_CELL + _MARGIN)
        draw.text((left, 4), f"{name}: {chosen.get(name, 'no render')}", fill=_INK, font=font)
        for attempt in (each for each in attempts if each.data == name):
            shown = views[attempt.row.key, name].get(chosen.get(name, ""))
            place = left, _TITLE + (1 + list(methods).index(attempt.row.key)) * (height + _MARGIN), _CELL, height
            if shown is None or attempt.run is None:
                reason = attempt.brief if attempt.outcome != "finished" else "no pose for this view"
                draw.rectangle((*place[:2], place[0] + _CELL - 1, place[1] + height - 1), fill=_EMPTY)
                _write(draw, reason, (place[0] + 8, place[1] + 8, _CELL - 16, height - 16), font)
                continue
            _paste(grid, attempt.run.artifacts / shown.render, place)
            _paste(grid, attempt.run.artifacts / shown.photo, (left, _TITLE, _CELL, height))
    with atomic_path(path) as temporary:
        grid.save(temporary)
    return chosen


def write_trajectories(attempts: Sequence[Attempt], folder: Path) -> list[Path]:
    """Write one page a data set with all trajectories and the reference, as the paper's figure 1; return the files.

    The pages hold their script and need no network. Data sets on which no method found poses have none.

    Raises
    ------
    DataError
        Where a run's trajectory is damaged.
    RunError
        When the disk is full or may not be written.
    """
    written = []
    for name in dict.fromkeys(attempt.data for attempt in attempts):
        found = {
            attempt.row.title: read_trajectories(attempt.run.trajectory_file)
            for attempt in attempts
            if attempt.data == name and attempt.outcome == "finished" and attempt.run is not None
        }
        found = {title: item for title, item in found.items() if item.found.poses}
        if not found:
            continue
        aligned = align_trajectories(found)
        paths = {title: trajectory.poses for title, trajectory in aligned.paths.items()}
        drawn = trajectory_figure(paths, aligned.reference.poses if aligned.reference is not None else None)
        drawn.update_layout(
            title={"text": f"{name}. {' '.join(aligned.remarks)}", "font": {"size": 13}},
            margin={"t": 40},
            height=760,
            paper_bgcolor="white",
        )
        path = folder / f"trajectories_{name}.html"
        with atomic_path(path) as temporary:
            drawn.write_html(temporary, include_plotlyjs=True)
        written.append(path)
    return written


def _views(attempt: Attempt) -> dict[str, TestView]:
    if attempt.outcome != "finished" or attempt.run is None:
        return {}
    return {view.name: view for view in attempt.run.result().test_views}


def _choose(drawn: Sequence[dict[str, TestView]], rank: Rank) -> str:
    """Return the name of the view to show of one data set, empty where there is none."""
    names = {name for views in drawn for name in views}
    if not names:
        return ""
    counts = {name: sum(name in views for views in drawn) for name in names}
    most = max(counts.values())
    quality = {
        name: float(np.mean([views[name].psnr for views in drawn if name in views]))
        for name, count in counts.items()
        if count == most
    }
    ordered = sorted(quality, key=lambda name: (quality[name], name))
    return ordered[0 if rank == "worst" else (len(ordered) - 1) // 2]


def _cell_height(
    attempts: Sequence[Attempt], views: dict[tuple[str, str], dict[str, TestView]], chosen: dict[str, str]
) -> int:
    """Return the height in which the tallest chosen photo fits."""
    tallest = 0.0
    for attempt in attempts:
        view = views[attempt.row.key, attempt.data].get(chosen.get(attempt.data, ""))
        if view is not None and attempt.run is not None:
            with open_picture(attempt.run.artifacts / view.photo) as picture:
                tallest = max(tallest, picture.height / picture.width)
    return round(_CELL * (tallest or 0.75))


def _paste(grid: Image.Image, path: Path, place: tuple[int, int, int, int]) -> None:
    """Put a picture into the middle of a cell (left, top, width, height), as large as fits."""
    left, top, width, height = place
    with open_picture(path) as picture:
        scale = min(width / picture.width, height / picture.height)
        size = max(1, round(scale * picture.width)), max(1, round(scale * picture.height))
        shown = picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    grid.paste(shown, (left + (width - size[0]) // 2, top + (height - size[1]) // 2))


def _write(
    draw: ImageDraw.ImageDraw,
    text: str,
    place: tuple[int, int, int, int],
    font: ImageFont.ImageFont | ImageFont.FreeTypeFont,
) -> None:
    """Write text into a box (left, top, width, height), broken at spaces, cut at the end."""
    left, top, width, height = place
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and draw.textlength(longer, font=font) > width:
            lines.append(word)
        else:
            lines[-1] = longer
    most = max(1, height // 18)
    if len(lines) > most:
        lines = [*lines[: most - 1], lines[most - 1] + " …"]
    draw.multiline_text((left, top), "\n".join(lines), fill=_INK, font=font)
