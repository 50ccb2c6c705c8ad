"""What tie points say of RPCs: how far rays missed each other, and how far each picture had to be shifted."""

from __future__ import annotations

from collections.abc import Sequence

import plotly.graph_objects as go
from numpy.typing import ArrayLike

from toolkit.geometry.rpc_correct import RpcRefinement
from toolkit.metrics.corrections import compare_corrections
from toolkit.plots.geometry import error_histogram
from toolkit.plots.satellite import corrections_figure


def agreement_figures(
    found: RpcRefinement, true: ArrayLike, names: Sequence[str] = ()
) -> tuple[go.Figure, go.Figure]:
    """Draw distances from tie points to their pixels before and after, and the shifts of the pictures.

    The shift of the whole ground, which tie points leave open, is taken off the second figure; its title has it.

    Parameters
    ----------
    found:
        Corrected cameras with their residuals.
    true:
        (C, 6) true corrections, as :attr:`toolkit.geometry.rpc_camera.RpcCamera.correction`.
    names:
        Of the C pictures, shown under the pointer.

    Raises
    ------
    StageError
        As :func:`toolkit.metrics.corrections.compare_corrections`.
    """
    left = {"as delivered": found.residual_before[found.inlier], "corrected": found.residual[found.inlier]}
    shifts = compare_corrections(found.cameras, true)
    east, north, up = shifts.shift
    title = f"Shift of each picture; the ground moved by {east:.1f} m east, {north:.1f} m north, {up:.1f} m up"
    return (
        error_histogram(left, unit="px", title="from tie point to its pixel"),
        corrections_figure(shifts.found, shifts.true, names, title=title),
    )
