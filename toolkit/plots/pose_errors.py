"""Errors of camera poses, frame by frame, of several ways to find them."""

from __future__ import annotations

from collections.abc import Mapping

import plotly.graph_objects as go

from toolkit.errors import StageError
from toolkit.metrics.trajectory import Alignment, trajectory_errors
from toolkit.plots.style import colour, figure, shown
from toolkit.scene import Scene

_SYMBOLS = ("circle", "diamond", "square", "x", "triangle-up")


def pose_errors_figure(
    found: Mapping[str, Scene], reference: Scene | None, *, alignment: Alignment = "sim3"
) -> go.Figure:
    """Draw the position and rotation error of every frame, on logarithmic axes; the legend has POS and ROT.

    Poses that cannot be compared are named in the title with the reason.

    Parameters
    ----------
    found:
        Poses by label.
    reference:
        True poses; without them the figure says so and is empty.
    alignment:
        How poses are laid onto the reference before.
    """
    drawn = figure("", 470, margin={"t": 24}, showlegend=True, legend={"y": -0.06})
    drawn.set_subplots(2, 1, shared_xaxes=True, vertical_spacing=0.06)
    remarks = [] if reference is not None else ["The data have no reference poses to compare with."]
    for position, (label, scene) in enumerate(found.items()):
        if reference is None:
            break
        try:
            errors = trajectory_errors(scene, reference, alignment)
        except StageError as error:
            remarks.append(f"{label}: {error}")
            continue
        name = f"{label}: POS {errors.pos:.3g} m, ROT {errors.rot:.3g}° ({errors.registered})"
        names = [shown(each) for each in errors.names]
        for row, values in ((1, errors.position), (2, errors.rotation_deg)):
            drawn.add_scatter(
                x=names,
                y=values,
                name=shown(name),
                legendgroup=label,
                showlegend=row == 1,
                mode="markers",
                marker={"color": colour(position), "size": 8, "symbol": _SYMBOLS[position % len(_SYMBOLS)]},
                row=row,
                col=1,
            )
    for row, title in ((1, "position error [m]"), (2, "rotation error [°]")):
        drawn.update_yaxes(title_text=title, type="log", tickformat="~g", dtick="D2", row=row, col=1)
    drawn.update_xaxes(type="category", showticklabels=False)
    if remarks:
        drawn.update_layout(title={"text": "<br>".join(map(shown, remarks)), "font": {"size": 12}})
        drawn.update_layout(margin={"t": 30 + 18 * len(remarks)})
    return drawn
