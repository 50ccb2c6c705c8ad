"""Wall time of stages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import plotly.graph_objects as go

from toolkit.plots.style import colour, figure, shown


class TimedStage(Protocol):
    """What is drawn of a stage."""

    @property
    def name(self) -> str:
        """Of the stage."""

    @property
    def seconds(self) -> float:
        """Wall time."""

    @property
    def reused(self) -> bool:
        """Whether its output was there already; it counts with the time that it took when it was made."""


def time_figure(times: Mapping[str, Sequence[TimedStage]]) -> go.Figure:
    """Draw one bar a run, built of its stages in order; reused stages are hatched.

    Parameters
    ----------
    times:
        Stages by the run's label.
    """
    stages = list(dict.fromkeys(time.name for run in times.values() for time in run))
    drawn = figure("", 130 + 58 * max(len(times), 1), barmode="stack", bargap=0.55, margin={"t": 12, "l": 12})
    for position, stage in enumerate(stages):
        of_stage = {label: next((t for t in run if t.name == stage), None) for label, run in times.items()}
        reused = [time is not None and time.reused for time in of_stage.values()]
        drawn.add_bar(
            y=[shown(label) for label in of_stage],
            x=[time.seconds if time is not None else None for time in of_stage.values()],
            name=shown(stage),
            orientation="h",
            marker={
                "color": colour(position),
                "pattern": {"shape": ["/" if flag else "" for flag in reused], "fgopacity": 0.7},
            },
            customdata=["reused" if flag else "computed" for flag in reused],
            hovertemplate="%{y}<br>%{fullData.name}: %{x:.1f} s (%{customdata})<extra></extra>",
        )
    for label in times:
        # Above its bar and not beside it: names of runs may be as long as a phone is wide.
        drawn.add_annotation(
            x=0, y=shown(label), text=shown(label), xanchor="left", yanchor="bottom", yshift=12, showarrow=False
        )
    drawn.update_layout(showlegend=True, legend={"traceorder": "normal", "y": -48 / (58 * max(len(times), 1))})
    drawn.update_xaxes(title_text="seconds")
    drawn.update_yaxes(autorange="reversed", type="category", showticklabels=False, showgrid=False)
    return drawn
