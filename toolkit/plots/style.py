"""How all figures look: one colour a run, transparent ground, so that light and dark pages both work."""

from __future__ import annotations

import html

import plotly.graph_objects as go

#: Told apart on white and on near-black; the first four also by people who do not see red and green apart.
COLOURS = ("#3b82f6", "#f59e0b", "#14b8a6", "#e0559b", "#8b5cf6", "#84a510", "#ef5a45", "#64748b")
DASHES = ("solid", "dash", "dot", "dashdot")
#: Grid lines and reference marks: grey that shows on either ground.
GRID = "rgba(128,138,156,0.25)"
NEUTRAL = "rgba(128,138,156,0.95)"

_AXIS = {
    "gridcolor": GRID,
    "linecolor": GRID,
    "zeroline": False,
    "automargin": True,
    "title": {"font": {"size": 13}, "standoff": 6},
}
_TEMPLATE = go.layout.Template(
    layout={
        "font": {"family": "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 13},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "margin": {"l": 56, "r": 16, "t": 44, "b": 44},
        "xaxis": _AXIS,
        "yaxis": _AXIS,
        "legend": {"orientation": "h", "yanchor": "top", "y": -0.24, "xanchor": "left", "x": 0},
        "hoverlabel": {"namelength": -1},
    }
)


def colour(position: int) -> str:
    """Return the colour of the run at ``position``; after the last one they begin again."""
    return COLOURS[position % len(COLOURS)]


def dash(position: int) -> str:
    """Return the line style of the run at ``position``: it changes where colours begin again."""
    return DASHES[position // len(COLOURS) % len(DASHES)]


def shown(text: str) -> str:
    """Return ``text`` as Plotly draws it letter by letter: left alone, it takes tags in names for formatting."""
    return html.escape(text, quote=False)


def figure(title: str, height: int, **layout: object) -> go.Figure:
    """Return an empty figure in the common style."""
    made = go.Figure()
    heading = {"text": shown(title), "x": 0, "xref": "paper", "font": {"size": 15}}
    made.update_layout(template=_TEMPLATE, title=heading, height=height)
    made.update_layout(**layout)
    return made
