"""A curve that grows while a run works: the browser is sent what is new and adds it to what it has drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import panel as pn
import param

from toolkit.plots.style import COLOURS
from toolkit.runs.curve_tail import LiveCurve

_ESM = """
const GRID = "rgba(128,138,156,0.25)";

function plotly() {
  return window.Plotly ? Promise.resolve(window.Plotly)
    : new Promise((done) => setTimeout(done, 50)).then(plotly);
}

export function render({ model, el }) {
  el.style.width = "100%";
  const place = document.createElement("div");
  place.className = "place";
  place.setAttribute("role", "img");
  place.setAttribute("aria-label", model.title);
  el.append(place);
  const colour = (name) => getComputedStyle(el).getPropertyValue(name).trim();
  const axis = (title, type) => ({
    title: { text: title, font: { size: 12 }, standoff: 4 }, type, gridcolor: GRID, linecolor: GRID,
    zeroline: false, automargin: true, tickformat: type === "log" ? "~g" : undefined,
  });
  const layout = () => ({
    title: { text: model.title, x: 0, xref: "paper", font: { size: 14 } },
    height: 240, autosize: true, margin: { l: 52, r: 12, t: 36, b: 38 }, showlegend: false, hovermode: "x",
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { family: "system-ui, sans-serif", size: 12, color: colour("--text") },
    hoverlabel: { bgcolor: colour("--card"), font: { color: colour("--text") } },
    xaxis: axis("step", "linear"), yaxis: axis("", model.log ? "log" : "linear"), uirevision: "kept",
  });
  const trace = ({ x, y }) => ({
    x: [...x], y: [...y], mode: x.length > 1 ? "lines" : "markers",
    line: { color: model.colour, width: 2 }, marker: { color: model.colour, size: 7 },
  });
  const count = () => { place.dataset.points = String(place.data ? place.data[0].x.length : 0); };
  let work = plotly();
  const then = (step) => { work = work.then(step).then(count, (error) => console.error(error)); };
  const whole = () => then(() => Plotly.react(place, [trace(model.points)], layout(), { displayModeBar: false }));
  const grow = () => {
    const { x, y } = model.added;
    then(() => {
      if (place.data[0].mode === "markers") Plotly.restyle(place, { mode: "lines" });
      return Plotly.extendTraces(place, { x: [[...x]], y: [[...y]] }, [0]);
    });
  };
  model.on("points", whole);
  model.on("added", grow);
  model.on("log", () => then(() => Plotly.relayout(place, { "yaxis.type": model.log ? "log" : "linear" })));
  whole();
  // What was added since the whole was sent is not in it: a view that comes late asks for all of it.
  if (model.added.serial > model.points.serial) model.send_msg("whole");
  const sizes = new ResizeObserver(() => {
    if (place.offsetWidth > 0 && place.data) then(() => Plotly.Plots.resize(place));
  });
  sizes.observe(el);
  model.on("remove", () => { sizes.disconnect(); if (window.Plotly) Plotly.purge(place); });
}
"""

# Plotly lays its layers over each other by rules in the page's head, which do not reach into a component.
_SHEET = """
:host { background: var(--card); border: 1px solid var(--line); border-radius: 12px; overflow: hidden; }
.place { min-height: 240px; padding: 0 4px; }
.plot-container, .svg-container { position: relative; direction: ltr; }
.main-svg { position: absolute; top: 0; left: 0; pointer-events: none; overflow: hidden; }
.main-svg .draglayer { pointer-events: all; }
.crisp { shape-rendering: crispEdges; }
.js-plotly-plot .plotly .cursor-crosshair { cursor: crosshair; }
"""


class LiveChart(pn.custom.JSComponent):
    """One measurement over steps.

    Attributes
    ----------
    title, colour, log:
        As drawn.
    points:
        ``x``, ``y`` and ``serial`` of the whole curve, sent when what was drawn does not hold any more.
    added:
        ``x``, ``y`` and ``serial`` of what came since the last sending.
    """

    title = param.String(default="")
    colour = param.String(default=COLOURS[0])
    log = param.Boolean(default=False)
    points = param.Dict(default={"x": [], "y": [], "serial": 0})
    added = param.Dict(default={"x": [], "y": [], "serial": 0})

    _esm = _ESM

    def __init__(self, **params: Any) -> None:
        super().__init__(sizing_mode="stretch_width", margin=0, stylesheets=[_SHEET], **params)
        self._curve: LiveCurve | None = None
        self._sent, self._redrawn, self._serial = 0, -1, 0

    def draw(self, curve: LiveCurve) -> None:
        """Send what is new of a curve: all of it where it is another one, or was thinned or cut since."""
        if curve is not self._curve or curve.redrawn != self._redrawn:
            self._curve, self._redrawn = curve, curve.redrawn
            self._send_whole()
        elif len(curve.steps) > self._sent:
            self._serial += 1
            self.added = self._piece(self._sent)
            self._sent = len(curve.steps)

    def _send_whole(self) -> None:
        self._serial += 1
        self.points = self._piece(0)
        self._sent = len(self._curve.steps) if self._curve is not None else 0

    def _piece(self, begin: int) -> dict[str, Any]:
        steps: Sequence[int] = self._curve.steps[begin:] if self._curve is not None else ()
        values: Sequence[float] = self._curve.values[begin:] if self._curve is not None else ()
        # JSON knows no NaN; a missing value is a gap.
        drawn = [value if math.isfinite(value) else None for value in values]
        return {"x": list(steps), "y": drawn, "serial": self._serial}

    def _handle_msg(self, data: Any) -> None:
        """Send the whole curve to a view that came late."""
        if data == "whole":
            self._send_whole()
