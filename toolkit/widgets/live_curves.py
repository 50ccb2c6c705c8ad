"""The measurements of a run as curves that grow."""

from __future__ import annotations

import panel as pn

from toolkit.plots.style import colour
from toolkit.runs.curve_tail import CurveTail
from toolkit.runs.folder import RunFolder
from toolkit.runs.markup import element
from toolkit.widgets.live_chart import LiveChart
from toolkit.widgets.style import html_pane, notes, show_html, switch

#: Measurements in the order in which they are drawn; others come after them.
_ORDER = ("loss", "psnr_live", "psnr_test", "gaussians", "step_ms")
_TITLES = {
    "loss": "Loss",
    "psnr_live": "PSNR of a test view (dB)",
    "psnr_test": "PSNR of a test view (dB)",
    "gaussians": "Gaussians",
    "step_ms": "Time of a step (ms)",
}
_MOST_CHARTS = 8


class LiveCurves(pn.viewable.Viewer):
    """One chart a measurement, the newest stage's first. :meth:`follow` chooses a run, :meth:`refresh` reads on."""

    def __init__(self) -> None:
        super().__init__()
        self._tail: CurveTail | None = None
        self._charts: dict[tuple[str, str], LiveChart] = {}
        self._log = switch("Logarithmic loss", margin=(0, 0, 8, 0))
        self._log.param.watch(lambda event: self._set_log(), "value")
        self._remark = html_pane()
        self._grid = pn.FlexBox(sizing_mode="stretch_width", gap="14px", margin=0)
        self._layout = pn.Column(
            html_pane(element("h2", "Curves")),
            self._remark,
            self._log,
            self._grid,
            sizing_mode="stretch_width",
            margin=0,
            visible=False,
        )

    def __panel__(self) -> pn.viewable.Viewable:
        return self._layout

    @property
    def charts(self) -> dict[tuple[str, str], LiveChart]:
        """The charts by stage and name."""
        return dict(self._charts)

    def follow(self, run: RunFolder | None) -> None:
        """Show the curves of another run, none for None."""
        self._tail = CurveTail(run.metrics_file) if run is not None else None
        self._charts = {}
        self._grid[:] = []
        self._layout.visible = False

    def refresh(self) -> None:
        """Read what was written since the last time. Raises :class:`DataError` where the file is damaged."""
        if self._tail is None or not self._tail.read():
            return
        newest_first = [key for key in reversed(list(self._tail.curves)) if not self._is_told_twice(key)]
        wanted = sorted(newest_first, key=lambda key: _place(key[1]))[:_MOST_CHARTS]
        if wanted != list(self._charts):
            self._charts = {key: self._charts.get(key) or self._chart(key) for key in wanted}
            self._grid[:] = [_half(chart) for chart in self._charts.values()]
        for key, chart in self._charts.items():
            chart.draw(self._tail.curves[key])
        damaged = self._tail.damaged_lines
        show_html(
            self._remark, notes([f"{damaged} damaged lines of metrics.csv were left out."] if damaged else [])
        )
        self._log.visible = any(_is_loss(name) for _, name in self._charts)
        self._layout.visible = bool(self._charts)

    def pace(self, stage: str) -> float | None:
        """Return seconds a step of a stage, None where its curves do not tell."""
        curves = self._tail.curves.values() if self._tail is not None else ()
        paces = [curve.pace() for curve in curves if curve.stage == stage]
        known = [pace for pace in paces if pace is not None]
        return known[0] if known else None

    def latest(self) -> list[tuple[str, float]]:
        """Return names and newest values of the measurements, in their order."""
        if self._tail is None:
            return []
        found = [curve for name in _ORDER if (curve := self._tail.find(name)) is not None]
        return [
            (curve.name, curve.latest[2]) for curve in found if not self._is_told_twice((curve.stage, curve.name))
        ]

    def _is_told_twice(self, key: tuple[str, str]) -> bool:
        """Whether a curve is the same as another one, at fewer steps."""
        stage, name = key
        return name == "psnr_test" and self._tail is not None and (stage, "psnr_live") in self._tail.curves

    def _chart(self, key: tuple[str, str]) -> LiveChart:
        stage, name = key
        title = f"{_TITLES.get(name, name)} · {stage}"
        return LiveChart(title=title, colour=colour(_place(name)), log=_is_loss(name) and self._log.value)

    def _set_log(self) -> None:
        for (_, name), chart in self._charts.items():
            if _is_loss(name):
                chart.log = self._log.value


def _place(name: str) -> int:
    return _ORDER.index(name) if name in _ORDER else len(_ORDER)


def _is_loss(name: str) -> bool:
    return "loss" in name.lower()


def _half(content: pn.viewable.Viewable) -> pn.Column:
    """Return a column that shares its row where there is room for two."""
    return pn.Column(
        content,
        sizing_mode="stretch_width",
        margin=0,
        styles={"flex": "1 1 max(400px, calc(50% - 7px))", "min-width": "0"},
    )
