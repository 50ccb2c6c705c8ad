"""Clouds of points seen from the side: what a map from above does not show."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import plotly.graph_objects as go

from toolkit.plots.curves import thinned
from toolkit.plots.style import figure, shown
from toolkit.scene import Points

#: Most points drawn of one cloud.
MOST_POINTS = 8000
_WIDTH = 900  # pixels of a notebook's page, to which the height of the panels is fitted
_FRAME = 40.0  # most metres of height that are drawn


def elevation_map(clouds: Mapping[str, Points | None]) -> go.Figure:
    """Draw clouds of points from the south, one below the other in about equal scale: x is east, y is up.

    The frame holds the middle of the first cloud that has points; points that lie far off are cut.

    Parameters
    ----------
    clouds:
        By label, in metres east, north and up. A cloud without points has an empty panel.
    """
    sizes = {label: 0 if cloud is None else len(cloud) for label, cloud in clouds.items()}
    titles = [f"{shown(label)}: {size:,} points" for label, size in sizes.items()]
    first = next((cloud.xyz for cloud in clouds.values() if cloud is not None and len(cloud)), np.zeros((1, 3)))
    low, high = np.percentile(first, [2, 98], axis=0)
    side = max(1.0, 0.6 * float(high[0] - low[0]))
    tall = min(_FRAME, side)
    middle = float(np.median(first[:, 2]))
    across = [float((low[0] + high[0]) / 2 - side), float((low[0] + high[0]) / 2 + side)]
    panel = max(120, round(_WIDTH * tall / (2 * side)))
    count = max(len(clouds), 1)
    drawn = figure("", count * (panel + 46) + 50, margin={"t": 40}, showlegend=False)
    drawn.set_subplots(count, 1, shared_xaxes=True, subplot_titles=titles, vertical_spacing=min(0.12, 0.4 / count))
    drawn.update_annotations(font_size=13)
    for row, cloud in enumerate(clouds.values(), start=1):
        if cloud is not None and len(cloud):
            keep = thinned(len(cloud), MOST_POINTS)
            drawn.add_trace(
                go.Scattergl(
                    x=cloud.xyz[keep, 0],
                    y=cloud.xyz[keep, 2],
                    mode="markers",
                    hoverinfo="skip",
                    marker={"size": 3, "color": [f"rgb({r},{g},{b})" for r, g, b in cloud.rgb[keep].tolist()]},
                ),
                row=row,
                col=1,
            )
        drawn.update_yaxes(range=[middle - 0.35 * tall, middle + 0.65 * tall], title_text="up [m]", row=row, col=1)
    drawn.update_xaxes(range=across)
    drawn.update_xaxes(title_text="east [m]", row=count, col=1)
    return drawn
