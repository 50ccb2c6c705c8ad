"""Measures of single test pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import plotly.graph_objects as go

from toolkit.plots.style import colour, figure, shown


def view_figure(measures: Mapping[str, Mapping[str, float]], names: Sequence[str], *, measure: str) -> go.Figure:
    """Draw one mark a run and test picture.

    Parameters
    ----------
    measures:
        By the run's label, the measure by picture name; pictures may be missing. A run without any keeps its
        colour.
    names:
        Pictures from left to right.
    measure:
        What was measured, with its unit.
    """
    drawn = figure("", 320, showlegend=len(measures) > 1, hovermode="x unified")
    for position, (label, values) in enumerate(measures.items()):
        if not values:
            continue
        drawn.add_scatter(
            x=[shown(name) for name in names],
            y=[values.get(name) for name in names],
            name=shown(label),
            mode="markers",
            marker={"color": colour(position), "size": 9, "opacity": 0.85},
        )
    # Slanted names need the room below, where the legend is elsewhere.
    drawn.update_layout(margin={"t": 16}, legend={"y": 1.02, "yanchor": "bottom"})
    drawn.update_yaxes(title_text=measure)
    drawn.update_xaxes(type="category", showticklabels=len(names) <= 24, tickangle=-40)
    return drawn
