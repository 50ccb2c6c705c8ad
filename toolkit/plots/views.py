"""Measures of single test pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import plotly.graph_objects as go

from toolkit.plots.style import colour, figure


def view_figure(measures: Mapping[str, Mapping[str, float]], names: Sequence[str], *, title: str) -> go.Figure:
    """Draw one mark a run and test picture.

    Parameters
    ----------
    measures:
        By the run's label, the measure by picture name; pictures may be missing.
    names:
        Pictures from left to right.
    title:
        What was measured, with its unit.
    """
    drawn = figure(title, 300, showlegend=len(measures) > 1, hovermode="x unified")
    for position, (label, values) in enumerate(measures.items()):
        drawn.add_scatter(
            x=list(names),
            y=[values.get(name) for name in names],
            name=label,
            mode="markers",
            marker={"color": colour(position), "size": 9, "opacity": 0.85},
        )
    drawn.update_xaxes(type="category", showticklabels=len(names) <= 24, tickangle=-40)
    return drawn
