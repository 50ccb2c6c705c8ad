"""Thumbnails of a capture; pressing one shows it larger."""

from __future__ import annotations

from collections.abc import Sequence

import panel as pn
import param

from toolkit.runs.markup import element
from toolkit.widgets.style import SHEETS

_ESM = """
export function render({ model, el }) {
  el.style.width = "100%";
  const mark = () => {
    for (const button of el.querySelectorAll("button[data-photo]")) {
      button.setAttribute("aria-pressed", button.dataset.photo === String(model.chosen));
    }
  };
  const show = () => { el.innerHTML = model.content; mark(); };
  el.addEventListener("click", (event) => {
    // Inside a shadow root the target is the host: the path has the button.
    const button = event.composedPath().find((each) => each.dataset && each.dataset.photo !== undefined);
    if (!button) return;
    const photo = Number(button.dataset.photo);
    model.chosen = photo === model.chosen ? -1 : photo;
  });
  model.on("content", show);
  model.on("chosen", mark);
  show();
}
"""
_SHEET = """
.thumbs { display: grid; gap: 8px; grid-template-columns: repeat(auto-fill, minmax(104px, 1fr)); }
.thumbs button {
  border: 2px solid transparent; border-radius: 8px; padding: 0; background: var(--card); cursor: pointer;
  min-width: 0;
  overflow: hidden; color: var(--muted); font: inherit; font-size: 11.5px; position: relative;
}
.thumbs img { width: 100%; aspect-ratio: 4 / 3; object-fit: cover; display: block; }
.thumbs span { display: block; padding: 2px 5px; overflow: hidden; text-overflow: ellipsis; white-space: nowrap; }
.thumbs button.soft::after {
  content: "blur?"; position: absolute; top: 5px; right: 5px; padding: 0 6px; border-radius: 6px;
  background: var(--warn-ground); color: var(--warn); font-weight: 600;
}
.thumbs button[aria-pressed=true] { border-color: var(--accent); color: var(--text); }
"""


class PhotoGrid(pn.custom.JSComponent):
    """A grid of small pictures.

    Attributes
    ----------
    content:
        HTML of the grid.
    chosen:
        Number of the photo that is pressed, -1 for none.
    """

    content = param.String(default="")
    chosen = param.Integer(default=-1)

    _esm = _ESM

    def __init__(self) -> None:
        super().__init__(stylesheets=[*SHEETS, _SHEET], sizing_mode="stretch_width", margin=0)

    def fill(self, photos: Sequence[tuple[int, str, str, bool]]) -> None:
        """Show photos: the number, the name, a data URL and whether it may be blurred, of each."""
        buttons = [
            element(
                "button",
                element("img", src=url, alt="", loading="lazy"),
                element("span", name),
                type="button",
                title=name,
                data_photo=number,
                class_="soft" if soft else None,
            )
            for number, name, url, soft in photos
        ]
        if self.chosen not in {number for number, *_ in photos}:
            self.chosen = -1
        self.content = str(element("div", buttons, class_="thumbs")) if buttons else ""
