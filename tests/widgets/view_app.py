"""A page with the tab that shows splats alone, below a prefix: ``python view_app.py RUNS PORT``."""

from __future__ import annotations

import sys
from pathlib import Path

import panel as pn
from browsing import serve_app

from toolkit.widgets.dashboard import begin_page
from toolkit.widgets.page import page_template
from toolkit.widgets.view_page import ViewPage


def page(runs_dir: Path) -> pn.template.FastListTemplate:
    """Return the page."""
    begin_page()
    view = ViewPage(runs_dir)
    view.refresh()
    return page_template(view, dark=False, title="View")


if __name__ == "__main__":
    runs, port = Path(sys.argv[1]), int(sys.argv[2])
    serve_app(lambda: page(runs), port, "/user/a")
