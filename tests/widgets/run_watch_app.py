"""A page with the tabs on which runs are started and followed: ``python run_watch_app.py RUNS DATA PORT``."""

from __future__ import annotations

import sys
from pathlib import Path

import panel as pn
from browsing import serve_app

from toolkit.widgets.dashboard import begin_page, dark_wanted
from toolkit.widgets.page import page_template
from toolkit.widgets.run_page import RunPage
from toolkit.widgets.watch_page import WatchPage

# Milliseconds; a test has less patience than a person.
REFRESH = 500


def page(runs_dir: Path, data_dir: Path) -> pn.template.FastListTemplate:
    """Return the page; the address says which tab is open first and whether the ground is dark."""
    begin_page()
    dark = dark_wanted()

    def show(tab: str, run_id: str) -> None:
        if tab == "watch":
            watch.selected = run_id
            tabs.active = 1

    watch = WatchPage(runs_dir, show=show, dark=dark)
    run = RunPage(runs_dir, [data_dir], show=show, dark=dark)
    tabs = pn.Tabs(("Run", run), ("Watch", watch), dynamic=False, sizing_mode="stretch_width")
    asked = pn.state.session_args.get("run", [b""])[0].decode()
    if asked:
        watch.selected = asked
        tabs.active = 1
    pn.state.add_periodic_callback(lambda: (run, watch)[tabs.active].refresh(), period=REFRESH)
    return page_template(tabs, dark=dark, title="Run and watch")


if __name__ == "__main__":
    runs, data, port = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    serve_app(lambda: page(runs, data), port)
