"""The page around the dashboard: Panel's template, without the scripts that the first sight does not need."""

from __future__ import annotations

import re
from typing import Final

import panel as pn
from jinja2 import Template

from toolkit.widgets.style import FONT, GROUND, LocalFast, page_css

TITLE: Final = "Sightline Toolkit"

_SCRIPT: Final = re.compile(r'<script[^>]*\bsrc="(?P<source>[^"]*)"[^>]*></script>\s*')
# Panel loads Plotly as soon as a page may have figures, 4.8 MB that a browser reads before it draws anything. This
# is there in its place, and loads Plotly when the first figure is to be drawn.
_PLOTLY_LATER: Final = """<script>
(() => {
  let come;
  const loaded = new Promise((done, failed) => { come = [done, failed]; });
  let asked = false;
  const load = () => {
    if (!asked) {
      asked = true;
      const script = document.createElement("script");
      script.src = "SOURCE";
      script.onload = () => come[0](window.Plotly);
      script.onerror = () => come[1](new Error("Plotly could not be loaded"));
      document.head.append(script);
    }
    return loaded;
  };
  const later = (name) => (...given) => load().then((plotly) => plotly[name](...given));
  const names = ["react", "relayout", "restyle", "extendTraces", "addFrames"];
  window.Plotly = Object.fromEntries(names.map((name) => [name, later(name)]));
  window.Plotly.newPlot = (place, figure, ...more) =>
    // A place without a figure waits for one that comes.
    (figure.data && figure.data.length === 0 ? loaded : load())
      .then((plotly) => plotly.newPlot(place, figure, ...more));
  window.Plotly.purge = () => {};
  window.Plotly.Plots = { resize: (...given) => load().then((plotly) => plotly.Plots.resize(...given)) };
})();
</script>
"""
_LEAN: Final = "{% extends page %}{% block js_resources %}{{ (bokeh_js or '') | lean }}{% endblock %}"


def page_template(content: pn.viewable.Viewer, *, dark: bool, title: str = TITLE) -> pn.template.FastListTemplate:
    """Return a page in the toolkit's looks with nothing but ``content``."""
    page = pn.template.FastListTemplate(
        title=title,
        main_layout=None,
        main=[content],
        raw_css=[page_css(dark=dark)],
        accent="#2563eb",
        design=LocalFast,
        background_color=GROUND["dark" if dark else "light"],
        font=FONT,
        font_url="",
        # It would turn at each look at the disk.
        busy_indicator=None,
        meta_viewport="width=device-width, initial-scale=1",
    )
    page.template = _lean(page.template)
    return page


def lean_scripts(scripts: str) -> str:
    """Return the page's scripts without MathJax, and with Plotly coming with the first figure.

    Bokeh's MathJax comes with every HTML pane; no text here has formulas. Scripts that Panel writes in another way
    than expected stay as they are: the page is slower then, and nothing else.
    """

    def lighter(script: re.Match[str]) -> str:
        source = script["source"]
        if "/bokeh-mathjax" in source:
            return ""
        if "/plotly-" in source:
            return _PLOTLY_LATER.replace("SOURCE", source)
        return script[0]

    return _SCRIPT.sub(lighter, scripts)


def _lean(template: Template) -> Template:
    environment = template.environment.overlay()
    environment.filters = {**environment.filters, "lean": lean_scripts}
    return environment.from_string(_LEAN, globals={"page": template})
