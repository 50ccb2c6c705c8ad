"""A match graph in which a slider says how far apart frames may be: what a window keeps, and what it costs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import SettingsError
from toolkit.optional import require
from toolkit.plots.match_heat import match_heat_figure

_PLOTLY = "application/vnd.plotly.v1+json"


def window_figure(
    names: Sequence[str], index: ArrayLike, inliers: ArrayLike, wrong: ArrayLike, window: int
) -> go.Figure:
    """Draw the pairs of frames at most ``window`` apart, and say how many of them are wrong.

    Parameters
    ----------
    names:
        Of the frames, in order of capture.
    index:
        (P, 2) verified pairs, indices of frames.
    inliers:
        (P,) verified matches.
    wrong:
        (K, 2) pairs that are wrong, as far as that is known.
    window:
        Frames.

    Raises
    ------
    SettingsError
        For a window below 1.
    DataError
        For pairs and counts that do not correspond.
    """
    if window < 1:
        raise SettingsError("The window is too small", expected="at least 1 frame", found=str(window))
    pairs, counts = np.asarray(index, dtype=np.int64).reshape(-1, 2), np.asarray(inliers, dtype=np.int64).ravel()
    bad = _within(np.asarray(wrong, dtype=np.int64).reshape(-1, 2), window)
    kept = np.abs(pairs[:, 1] - pairs[:, 0]) <= window
    drawn = match_heat_figure(names, pairs[kept], counts[kept], window=window, outlined={"wrong": bad})
    count = len(names)
    tried = sum(max(0, count - step) for step in range(1, window + 1))
    title = f"{tried:,} pairs to match · {int(kept.sum()):,} verified · {len(bad):,} wrong"
    return drawn.update_layout(title_text=title)


def _within(pairs: NDArray[np.int64], window: int) -> NDArray[np.int64]:
    return pairs[np.abs(pairs[:, 1] - pairs[:, 0]) <= window]


class MatchWindowView:
    """The slider above the match graph; where no kernel answers, the graph as it was drawn last."""

    def __init__(
        self, names: Sequence[str], index: ArrayLike, inliers: ArrayLike, wrong: ArrayLike, *, window: int
    ) -> None:
        widgets = require("ipywidgets")
        require("anywidget")  # Plotly's own message for it does not say how to get it
        self._content = tuple(names), index, inliers, wrong
        self._graph = go.FigureWidget(window_figure(*self._content, window))
        self._slider = widgets.IntSlider(
            window,
            description="window [frames]",
            min=1,
            max=max(len(names) - 1, 1),
            style={"description_width": "120px"},
            layout={"width": "520px"},
            # A picture of the matrix is sent with each step: not while the slider moves.
            continuous_update=False,
        )
        self._slider.observe(self._moved, "value")
        self._box = widgets.VBox([self._slider, self._graph])

    @property
    def figure(self) -> go.Figure:
        """The graph as it is now."""
        return go.Figure(self._graph)

    def move(self, window: int) -> None:
        """Move the slider."""
        self._slider.value = window

    def _moved(self, change: Any) -> None:
        drawn = window_figure(*self._content, self._slider.value)
        with self._graph.batch_update():
            self._graph.data = ()
            self._graph.add_traces(drawn.data)
            self._graph.layout.title = drawn.layout.title

    def _repr_mimebundle_(self, **options: Any) -> dict[str, Any]:
        shown: dict[str, Any] = self._box._repr_mimebundle_(**options) or {}
        # Pairs that were not matched are NaN, which JSON does not know: Plotly writes them as null.
        return {**shown, _PLOTLY: json.loads(self.figure.to_json())}


def match_window_view(
    names: Sequence[str], index: ArrayLike, inliers: ArrayLike, wrong: ArrayLike, *, window: int = 15
) -> MatchWindowView:
    """Return a match graph with a slider for the window, to be shown in a notebook.

    Parameters are those of :func:`window_figure`.

    Raises
    ------
    SettingsError, DataError
        As :func:`window_figure`.
    MissingDependencyError
        Where ipywidgets or anywidget is not installed.
    """
    return MatchWindowView(names, index, inliers, wrong, window=min(window, max(len(names) - 1, 1)))
