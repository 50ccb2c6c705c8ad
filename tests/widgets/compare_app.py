"""A page with the tab that compares alone: ``python compare_app.py RUNS PORT MILLISECONDS``."""

from __future__ import annotations

import sys
from pathlib import Path

import panel as pn
from browsing import serve_app

from toolkit.widgets.address import Address
from toolkit.widgets.compare_page import ComparePage
from toolkit.widgets.dashboard import begin_page, dark_wanted
from toolkit.widgets.page import page_template


def page(runs_dir: Path, every: int) -> pn.template.FastListTemplate:
    """Return the page for one visitor, which looks at the disk every so many milliseconds."""
    begin_page()
    dark = dark_wanted()
    compare = ComparePage(runs_dir, Address(pn.state.location), dark=dark, wait=True)
    pn.state.onload(compare.open)
    pn.state.add_periodic_callback(compare.refresh, period=every)
    return page_template(compare, dark=dark, title="Compare")


if __name__ == "__main__":
    runs, port, every = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    serve_app(lambda: page(runs, every), port)
