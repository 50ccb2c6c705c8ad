"""Test photo against render, with a dividing line between them."""

from __future__ import annotations

from typing import Any

import panel as pn
import param

from toolkit.runs.report_style import VIEW_SCRIPT
from toolkit.widgets.style import SHEETS

_ESM = (
    VIEW_SCRIPT
    + """
export function render({ model, el }) {
  el.style.width = "100%";
  const show = () => { el.innerHTML = model.content; followViews(el); };
  const choose = () => { el.dataset.mode = model.mode; };
  model.on("content", show);
  model.on("mode", choose);
  show();
  choose();
}
"""
)


class PictureCard(pn.custom.JSComponent):
    """A card of :func:`toolkit.runs.report_views.view_card`, brought to life by the report page's script.

    Attributes
    ----------
    content:
        HTML of the card. Its pictures are data URLs: no address leads from the browser to a file.
    mode:
        One of :data:`toolkit.runs.report_html.VIEW_MODES`, or ``error`` for the maps of errors.
    """

    content = param.String(default="")
    mode = param.String(default="slide")

    _esm = _ESM

    def __init__(self, **params: Any) -> None:
        super().__init__(stylesheets=SHEETS, **params)
