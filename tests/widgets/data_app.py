"""A page with the tab of data alone: ``python data_app.py RUNS DATA PORT``."""

from __future__ import annotations

import sys
from pathlib import Path

import panel as pn
from browsing import serve_app

from toolkit.widgets.dashboard import begin_page, dark_wanted
from toolkit.widgets.data_page import DataPage
from toolkit.widgets.page import page_template
from toolkit.widgets.task import cancel_all

# Milliseconds; a test has less patience than a person.
REFRESH = 500


def page(runs_dir: Path, data_dir: Path) -> pn.template.FastListTemplate:
    """Return the page; the address says whether the ground is dark."""
    begin_page()
    said = pn.pane.HTML("")

    def show(tab: str, capture: str) -> None:
        said.object = f"asked for {tab} of {Path(capture).name}"

    dark = dark_wanted()
    data = DataPage(runs_dir, [data_dir], show=show, dark=dark)
    pn.state.add_periodic_callback(data.refresh, period=REFRESH)
    return page_template(pn.Column(data, said, sizing_mode="stretch_width"), dark=dark, title="Data")


if __name__ == "__main__":
    runs, data, port = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    serve_app(lambda: page(runs, data), port)
    cancel_all()
