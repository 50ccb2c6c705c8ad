"""How sharp the photos of a capture are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go

from toolkit.plots.style import COLOURS, NEUTRAL, figure, shown

_SHARP, _SOFT = COLOURS[0], COLOURS[1]


def sharpness_figure(names: Sequence[str], values: Sequence[float | None], soft: Sequence[int]) -> go.Figure:
    """Draw a bar a photo, in the order of the capture; those that fall out are in another colour.

    Parameters
    ----------
    names:
        Of the photos.
    values:
        Sharpness, None where it is not known.
    soft:
        Places of the photos that may be blurred.
    """
    outliers = set(soft)
    title = f"Sharpness, {len(outliers)} of {len(names)} photos fall out" if outliers else "Sharpness"
    drawn = figure(title, 280, showlegend=bool(outliers), bargap=0.1)
    for label, colour, wanted in (("sharp", _SHARP, False), ("may be blurred", _SOFT, True)):
        places = [i for i, value in enumerate(values) if value is not None and (i in outliers) == wanted]
        if not places:
            continue
        drawn.add_bar(
            x=[i + 1 for i in places],
            y=[values[i] for i in places],
            name=label,
            marker={"color": colour, "line": {"width": 0}},
            text=[shown(names[i]) for i in places],
            textposition="none",
            hovertemplate="%{text}: %{y:.0f}<extra>%{fullData.name}</extra>",
        )
    known = [value for value in values if value is not None]
    if known:
        drawn.add_hline(
            y=float(np.median(known)),
            line={"dash": "dot", "width": 1.5, "color": NEUTRAL},
            annotation_text="median",
            annotation_position="top left",
        )
    drawn.update_xaxes(title_text="photo")
    drawn.update_yaxes(title_text="variance of Laplacian", rangemode="tozero")
    return drawn
