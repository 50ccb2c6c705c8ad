"""Choose views by hand in a notebook cell: a button for each, and how much of the best spread they reach."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from typing import Any

import plotly.graph_objects as go

from toolkit.errors import DataError
from toolkit.optional import require
from toolkit.plots.view_selection import view_selection_figure
from toolkit.scene import Scene
from toolkit.views.fisher import ViewSelection, select_views
from toolkit.views.scene_views import select_from_scene
from toolkit.views.settings import ViewSelectionSettings

_PLOTLY = "application/vnd.plotly.v1+json"
#: Of as many dimensions as there are, so that a determinant can be above zero.
_FEWEST = 3


class ViewChoice:
    """A button for each view, and the chosen ones as rays; where no kernel answers, the rays as drawn last.

    The title compares the determinant of the Fisher information matrix (satellite paper, section 4.2) with the
    largest that as many views can have.

    Parameters
    ----------
    scene:
        With poses; its training views are offered.
    count:
        How many are pressed at first: those that spread least.

    Attributes
    ----------
    directions:
        (n, 3) unit viewing directions, away from the cameras.
    names:
        (n,) of the views.

    Raises
    ------
    DataError
        For fewer than 3 views: they span nothing.
    StageError
        As :func:`toolkit.views.scene_views.select_from_scene`.
    MissingDependencyError
        Where ipywidgets or anywidget is not installed.
    """

    def __init__(self, scene: Scene, count: int) -> None:
        widgets = require("ipywidgets")
        require("anywidget")  # Plotly's own message for it does not say how to get it
        start = select_from_scene(scene, ViewSelectionSettings(count=count, spread="least"))
        self.directions, self.names = start.views.directions, start.views.names
        self._compass = scene.georeference is not None
        total = len(self.names)
        if total < _FEWEST:
            raise DataError("Too few views to choose from", expected=f"at least {_FEWEST}", found=str(total))
        self._best: dict[int, float] = {}
        self._buttons = [
            widgets.ToggleButton(
                number in start.selection.chosen, description=str(number), tooltip=name, layout={"width": "52px"}
            )
            for number, name in enumerate(self.names)
        ]
        self._filling = False
        self._rays = go.FigureWidget(self._drawn())
        for button in self._buttons:
            button.observe(self._pressed, "value")
        row = widgets.HBox(self._buttons, layout={"flex_flow": "row wrap", "max_width": "900px"})
        self._box = widgets.VBox([row, self._rays])

    @property
    def chosen(self) -> tuple[int, ...]:
        """Numbers of the views that are pressed, ascending; they count from 0 in the order of the buttons."""
        return tuple(number for number, button in enumerate(self._buttons) if button.value)

    @property
    def figure(self) -> go.Figure:
        """The rays as they are now."""
        return go.Figure(self._rays)

    def choose(self, numbers: Sequence[int]) -> None:
        """Press the buttons of these views and no others.

        Raises
        ------
        DataError
            For a view that there is not.
        """
        if any(not 0 <= number < len(self._buttons) for number in numbers):
            raise DataError(
                "There is no such view", expected=f"0 to {len(self._buttons) - 1}", found=f"{sorted(numbers)}"
            )
        self._filling = True
        try:
            for number, button in enumerate(self._buttons):
                button.value = number in numbers
        finally:
            self._filling = False
        self._pressed(None)

    def _pressed(self, change: Any) -> None:
        if self._filling:
            return
        drawn = self._drawn()
        with self._rays.batch_update():
            self._rays.data = ()
            self._rays.add_traces(drawn.data)
            self._rays.layout.title = drawn.layout.title

    def _drawn(self) -> go.Figure:
        """Return the rays, and what the chosen views reach."""
        picked = self.chosen
        # Of no view at all no selection can be asked for.
        shown = self._selection(picked) if picked else dataclasses.replace(self._selection((0,)), chosen=())
        drawn = view_selection_figure(shown, self.directions, self.names, compass=self._compass)
        # The numbers of the buttons, not of the picks.
        drawn.update_traces(text=[str(view) for view in shown.chosen], selector={"mode": "markers+text"})
        rest = {
            "text": [str(view) for view in shown.left_out],
            "mode": "markers+text",
            "textposition": "top center",
        }
        drawn.update_traces(rest, selector={"mode": "markers"})
        # Its camera stays as the reader turned it.
        drawn.update_layout(uirevision="views", height=520)
        return drawn.update_layout(title_text=self._told(shown) if picked else "No view is chosen")

    def _selection(self, numbers: Sequence[int]) -> ViewSelection:
        return select_views(self.directions, len(numbers), include=numbers)

    def _told(self, shown: ViewSelection) -> str:
        count = len(shown.chosen)
        if count < _FEWEST:
            return f"{count} chosen: the determinant is 0 for fewer than {_FEWEST} views"
        if count not in self._best:
            self._best[count] = select_views(self.directions, count).determinant
        share = shown.determinant / self._best[count]
        return f"{count} chosen: determinant {shown.determinant:.3g}, {share:.0%} of the largest for {count} views"

    def _repr_mimebundle_(self, **options: Any) -> dict[str, Any]:
        shown: dict[str, Any] = self._box._repr_mimebundle_(**options) or {}
        return {**shown, _PLOTLY: json.loads(self.figure.to_json())}
