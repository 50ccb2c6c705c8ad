"""Wall time of stages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import plotly.graph_objects as go

from toolkit.plots.style import colour, figure
from toolkit.recipes.base import StageTime


def time_figure(times: Mapping[str, Sequence[StageTime]]) -> go.Figure:
    """Draw one bar a run, built of its stages in order; reused stages are hatched.

    Parameters
    ----------
    times:
        Stages by the run's label.
    """
    stages = list(dict.fromkeys(time.name for run in times.values() for time in run))
    drawn = figure("", 96 + 44 * max(len(times), 1), barmode="stack", bargap=0.35, margin={"t": 8})
    for position, stage in enumerate(stages):
        of_stage = {label: next((t for t in run if t.name == stage), None) for label, run in times.items()}
        reused = [time is not None and time.reused for time in of_stage.values()]
        drawn.add_bar(
            y=list(of_stage),
            x=[time.seconds if time is not None else None for time in of_stage.values()],
            name=stage,
            orientation="h",
            marker={
                "color": colour(position),
                "pattern": {"shape": ["/" if flag else "" for flag in reused], "fgopacity": 0.7},
            },
            customdata=["reused" if flag else "computed" for flag in reused],
            hovertemplate="%{y}<br>" + stage + ": %{x:.1f} s (%{customdata})<extra></extra>",
        )
    drawn.update_layout(showlegend=True, legend={"traceorder": "normal", "x": 0, "xanchor": "left"})
    drawn.update_xaxes(title_text="seconds")
    drawn.update_yaxes(autorange="reversed", type="category")
    return drawn
