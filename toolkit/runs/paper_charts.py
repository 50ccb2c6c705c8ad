"""A paper's published times as a picture."""

from __future__ import annotations

from collections.abc import Sequence

import plotly.graph_objects as go

from toolkit.plots.times import time_figure
from toolkit.recipes.base import StageTime
from toolkit.runs.paper_rows import ROWS, PaperRow

_TICK = 1800  # seconds


def published_times_figure(rows: Sequence[PaperRow] = ROWS) -> go.Figure:
    """Draw the times that a paper published: finding poses, training the scene, or both where they are one step.

    The label of a method tells which share of its time goes into poses.
    """
    times: dict[str, list[StageTime]] = {}
    for row in rows:
        paper = row.paper
        if paper is None:
            continue
        if paper.poses is None or paper.scene is None:
            times[row.paper_title] = [StageTime("poses and scene in one", paper.total)]
            continue
        share = f"{row.paper_title}, {100 * paper.poses / paper.total:.0f} % for poses"
        times[share] = [StageTime("poses", paper.poses), StageTime("scene", paper.scene)]
    drawn = time_figure(times)
    longest = max((sum(stage.seconds for stage in stages) for stages in times.values()), default=_TICK)
    ticks = list(range(0, int(longest) + _TICK, _TICK))
    drawn.update_xaxes(title_text="minutes", tickvals=ticks, ticktext=[str(tick // 60) for tick in ticks])
    return drawn
