"""How the dashboard looks: the colours and rules of the report page, on a light or a dark ground."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import panel as pn
import plotly.graph_objects as go
from panel.io.resources import CDN_DIST
from panel.theme.fast import Fast

from toolkit.runs.markup import Content, element
from toolkit.runs.report_style import DARK, LIGHT, RULES

#: Tighter than on a page of paper, for sections in a grid.
_DENSE = """
:host { font-size: 14px; color: var(--text); }
h2 { margin: 22px 0 10px; font-size: 17px; }
.runs { margin-top: 10px; }
.warnings { margin: 8px 0; }
.view:has(figure:only-child) { max-width: 780px; }
progress {
  display: block; appearance: none; width: 100%; height: 10px; margin: 6px 0; border: 0; border-radius: 5px;
  overflow: hidden; background: var(--line);
}
progress::-webkit-progress-bar { background: var(--line); }
progress::-webkit-progress-value { background: var(--accent); }
progress::-moz-progress-bar { background: var(--accent); }
.live { max-width: 1120px; }
.live h3 { margin-bottom: 8px; }
.live img { display: block; width: 100%; height: auto; border-radius: 8px; }
.live figcaption { margin: 6px 2px 0; font-size: 13px; }
.badge.running { background: var(--accent); color: var(--card); }
p.about { max-width: 78ch; margin: 2px 0 4px; }
.said {
  margin: 8px 0; padding: 10px 14px; border-radius: 12px; background: var(--best-ground); color: var(--best);
}
.stage { margin-top: 10px; overflow-wrap: anywhere; }
.log {
  display: flex; flex-direction: column-reverse; max-height: 320px; overflow: auto; border-radius: 12px;
  background: var(--card); border: 1px solid var(--line);
}
.log pre {
  flex: none; max-height: none; margin: 0; padding: 10px 14px; overflow: visible; background: none;
  white-space: pre-wrap; overflow-wrap: anywhere;
}
"""


class LocalFast(Fast):
    """Panel's Fast design without its font, which would come from a server elsewhere."""

    # Panel finds a design's own files by the name of its class: Fast's have to be named in full here.
    _resources: ClassVar[Any] = {
        "js_modules": {**Fast._resources["js_modules"], "fast-design": f"{CDN_DIST}bundled/fast/js/fast_design.js"},
        "bundle": True,
    }


SHEETS = [RULES, _DENSE]
#: Choices are as high as the fields beside them.
SELECT = "select.bk-input { min-height: 40px; }"
#: Of machines, not of a server.
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Noto Sans', sans-serif"


GROUND = {"light": "#f6f7f9", "dark": "#0f1319"}


def page_css(*, dark: bool) -> str:
    """Return the properties that the rules use, for the page's root; shadow roots inherit them."""
    return f":root {{ color-scheme: {'dark' if dark else 'light'}; {DARK if dark else LIGHT} }}"


def html_pane(content: Content = None, **options: Any) -> pn.pane.HTML:
    """Return a pane in the report's style. Texts in ``content`` are escaped unless they are HTML already."""
    pane = pn.pane.HTML("", sizing_mode="stretch_width", stylesheets=SHEETS, margin=0, **options)
    show_html(pane, content)
    return pane


def show_html(pane: pn.pane.HTML, *content: Content) -> None:
    """Show ``content``; a pane without any takes no room."""
    written = element("div", *content) if any(content) else ""
    pane.param.update(object=str(written), visible=bool(written))


def switch(label: str, **options: Any) -> pn.widgets.Toggle:
    """Return a button that stays pressed: Panel's check boxes have no label that a screen reader would find."""
    return pn.widgets.Toggle(
        label=label,
        color="primary",
        variant="outline",
        stylesheets=[".bk-btn.bk-active { background: var(--accent) !important; color: var(--card) !important; }"],
        width=9 * len(label),
        **options,
    )


def notes(texts: Sequence[str]) -> Content:
    """Return remarks as one grey paragraph, nothing for none."""
    return element("p", " ".join(texts), class_="note") if texts else None


def plot_pane() -> pn.pane.Plotly:
    """Return an empty place for a figure; it takes no room until :func:`show_figure` gives it one."""
    return pn.pane.Plotly(
        None,
        sizing_mode="stretch_width",
        visible=False,
        margin=0,
        stylesheets=[":host { background: var(--card); border: 1px solid var(--line); border-radius: 12px; }"],
        config={"displaylogo": False, "responsive": True, "modeBarButtonsToRemove": ["lasso2d", "select2d"]},
    )


def show_figure(pane: pn.pane.Plotly, figure: go.Figure | None, *, dark: bool) -> None:
    """Draw ``figure`` in ``pane``. What a person turned, zoomed or hid stays so when new data come."""
    if figure is None:
        pane.param.update(object=None, visible=False)
        return
    text, ground = ("#e4e9f1", "#171d26") if dark else ("#1b2330", "#ffffff")
    figure.update_layout(
        font_color=text, hoverlabel={"bgcolor": ground, "font": {"color": text}}, uirevision="kept", autosize=True
    )
    pane.param.update(object=figure, height=figure.layout.height, visible=True)
